"""The configuration: one typed dataclass, the paper's hyperparameter table, and the parsing of values."""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from core.words import ConfigError

THREADS = min(torch.get_num_threads(), 4)
"""The threads of a cell that is alone on the machine: all physical cores (or OMP_NUM_THREADS), but no more than 4, as
the networks are small."""


@dataclass
class Config:
    """Every setting of one run. `None` marks a setting that the chosen algorithm does not have."""

    algo: str
    env: str
    seed: str = field(default="0", metadata={"help": "seeds trained in lockstep: 3, 0-9 or 1,4,7"})
    steps: int = field(default=0, metadata={"help": "environment steps of each seed"})
    # Hyperparameters of the paper's table "Hyperparameters used in the experiments".
    gamma: float = field(default=0.99, metadata={"help": "discount factor"})
    hidden: list[int] = field(default_factory=lambda: [400, 300], metadata={"help": "hidden layer widths"})
    batch_size: int = field(default=100, metadata={"help": "transitions in a gradient step"})
    learning_rate: float = field(default=1e-3, metadata={"help": "Adam's, for every network"})
    buffer_size: int = field(default=1_000_000, metadata={"help": "transitions kept for replay, a seed"})
    tau: float = field(default=0.005, metadata={"help": "target update ratio"})
    action_noise: float | None = field(default=None, metadata={"help": "TD3, NFW: std of exploration noise"})
    fw_learning_rate: float | None = field(default=None, metadata={"help": "NFW: Frank-Wolfe step"})
    learning_starts: int = field(default=100_000, metadata={"help": "random warm-up steps"})
    gsde: bool | None = field(default=None, metadata={"help": "SAC: state-dependent exploration"})
    train_freq: str = field(default="1", metadata={"help": "steps in a rollout, or 'episode'"})
    gradient_steps: int = field(default=1, metadata={"help": "after each rollout; -1: as many as its steps"})
    # Constants of TD3 and of the penalty term, which the paper takes from their sources.
    policy_delay: int | None = field(default=None, metadata={"help": "TD3, NFW: critic steps an actor step"})
    target_noise: float | None = field(default=None, metadata={"help": "TD3, NFW: std of target smoothing"})
    target_noise_clip: float | None = field(default=None, metadata={"help": "TD3, NFW: bound of that noise"})
    penalty: float | None = field(default=None, metadata={"help": "names with +: weight of the penalty"})
    # Choices that the paper leaves open or makes without naming them; its own are the defaults.
    entropy: str | None = field(
        default=None,
        metadata={"help": "SAlpha, SRad: entropy of actions as in the 'paper', or in unit-'ball' coordinates"},
    )
    boundary_weight: float | None = field(
        default=None, metadata={"help": "SAlpha: weight of the boundary's measure in the entropy"}
    )
    log_det_floor: float | None = field(
        default=None, metadata={"help": "SRad: added to the determinant in the density (released code: 1e-6)"}
    )
    # Protocol.
    eval_every: int = field(default=5_000, metadata={"help": "environment steps between evaluations"})
    eval_episodes: int = field(default=5, metadata={"help": "episodes of an evaluation"})
    final_episodes: int = field(default=50, metadata={"help": "episodes of the final result"})
    # The run itself; none of these changes what is learned, beyond float rounding.
    results: str = field(default="results", metadata={"help": "folder that results go to"})
    overwrite: bool = field(default=False, metadata={"help": "start again in any case; the old run is kept"})
    simulator: str | None = field(
        default=None, metadata={"help": "Reacher: 'closed-form', or 'pybullet', its reference, where that is installed"}
    )
    device: str = field(
        default="cpu",
        metadata={"help": "of networks and replay buffer: cpu, cuda or cuda:1"},
    )
    threads: int = field(
        default=THREADS, metadata={"help": "CPU threads (default: a cell alone up to 4, in a sweep 1)"}
    )
    checkpoint_every: int = field(default=10_000, metadata={"help": "environment steps of a seed between checkpoints"})


KEYS = tuple(f.name for f in fields(Config))
"""The keys of a command line that trains."""

RUN_KEYS = ("algo", "env", "seed", "results", "overwrite", "simulator", "device", "threads", "checkpoint_every")
"""Settings that do not make a run another experiment: they never show in a run's name."""

TD3_CONSTANTS = {"policy_delay": 2, "target_noise": 0.2, "target_noise_clip": 0.5}

ENTROPY_CHOICES: dict[str, dict] = {  # of SAC, by the map that its density has to follow
    "alpha": {"entropy": "paper", "boundary_weight": 1.0},
    "radial": {"entropy": "paper", "log_det_floor": 0.0},
}

HYPERPARAMETERS: dict[tuple[str, str], dict] = {
    # (robot, base algorithm): the paper's Table "Hyperparameters used in the experiments".
    ("Reacher", "TD3"): {
        "gamma": 0.98, "hidden": [400, 300], "batch_size": 100, "learning_rate": 1e-3,
        "buffer_size": 200_000, "tau": 0.005, "action_noise": 0.1, "fw_learning_rate": 0.05,
        "learning_starts": 100_000, "train_freq": "episode", "gradient_steps": -1,
    },
    ("Reacher", "SAC"): {
        "gamma": 0.98, "hidden": [400, 300], "batch_size": 256, "learning_rate": 7.3e-4,
        "buffer_size": 300_000, "tau": 0.02, "gsde": True,
        "learning_starts": 100_000, "train_freq": "8", "gradient_steps": 8,
    },
    ("Hopper", "TD3"): {
        "gamma": 0.99, "hidden": [400, 300], "batch_size": 256, "learning_rate": 3e-4,
        "buffer_size": 1_000_000, "tau": 0.005, "action_noise": 0.1, "fw_learning_rate": 0.01,
        "learning_starts": 100_000, "train_freq": "1", "gradient_steps": 1,
    },
    ("Hopper", "SAC"): {
        "gamma": 0.99, "hidden": [256, 256], "batch_size": 256, "learning_rate": 3e-4,
        "buffer_size": 1_000_000, "tau": 0.005, "gsde": False,
        "learning_starts": 100_000, "train_freq": "1", "gradient_steps": 1,
    },
    ("Others", "TD3"): {
        "gamma": 0.99, "hidden": [400, 300], "batch_size": 100, "learning_rate": 1e-3,
        "buffer_size": 1_000_000, "tau": 0.005, "action_noise": 0.1, "fw_learning_rate": 0.01,
        "learning_starts": 100_000, "train_freq": "episode", "gradient_steps": -1,
    },
    ("Others", "SAC"): {
        "gamma": 0.99, "hidden": [256, 256], "batch_size": 256, "learning_rate": 3e-4,
        "buffer_size": 1_000_000, "tau": 0.005, "gsde": False,
        "learning_starts": 100_000, "train_freq": "1", "gradient_steps": 1,
    },
}  # fmt: skip


def defaults(
    algo: str,
    env: str,
    robot: str,
    base: str,
    mapping: str,
    frank_wolfe: bool,
    penalty: bool,
    steps: int,
    simulator: str | None = None,
) -> Config:
    """The paper's configuration of one cell.

    `robot` is the task's robot, `base` is "TD3" or "SAC", `mapping` the algorithm's map; `frank_wolfe` and `penalty`
    say whether the algorithm takes Frank-Wolfe steps and has the penalty term; `steps` is the task's length of
    training and `simulator` the one that it runs on, where there is a choice.
    """
    group = robot if robot in ("Reacher", "Hopper") else "Others"
    table = dict(HYPERPARAMETERS[group, base])
    if base == "TD3":
        table |= TD3_CONSTANTS
    else:
        table |= ENTROPY_CHOICES.get(mapping, {})
    if not frank_wolfe:
        table.pop("fw_learning_rate", None)
    if penalty:
        table["penalty"] = 1.0
    return Config(algo=algo, env=env, steps=steps, simulator=simulator, **table)


def parse_seeds(text: str) -> list[int]:
    """Seeds of `3`, `0-9`, `1,4,7` or a mixture, ascending and without repetition."""
    seeds: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ConfigError(f"bad seed {text!r} (examples: seed=3, seed=0-9, seed=1,4,7)")
        low, high = int(first), int(last or first)
        if high < low:
            raise ConfigError(f"bad seed {text!r}: the range {part!r} is empty")
        if high - low >= 1000 or high >= 2**31:
            raise ConfigError(f"bad seed {text!r}: at most 1000 seeds a range, each below 2^31")
        seeds.update(range(low, high + 1))
    return sorted(seeds)


def override(config: DictConfig, schema: type, key: str, text: str, prefix: str = "") -> None:
    """Set one key of a structured config, the dataclass `schema`; ConfigError where `text` is not of its type.

    `prefix` stands before the key on the command line.
    """
    if text in ("null", "None", "~"):
        raise ConfigError(f"bad value {text!r} for {prefix}{key}: a value is needed")
    try:
        OmegaConf.update(config, key, _typed(schema, key, text))
    except OmegaConfBaseException:
        kind = next(f.type for f in fields(schema) if f.name == key).replace(" | None", "")
        raise ConfigError(f"bad value {text!r} for {prefix}{key}: expected {kind}") from None


def _typed(schema: type, key: str, text: str) -> object:
    """The text of one override, made ready for the type check of its field."""
    kind = typing.get_type_hints(schema)[key]
    if typing.get_origin(kind) is list:
        return [_whole(part) for part in text.removeprefix("[").removesuffix("]").split(",")]
    if int in (kind, *typing.get_args(kind)):
        return _whole(text)
    return str(int(text)) if key == "train_freq" and text.isdecimal() else text


def _whole(text: str) -> int | str:
    """3e5 is a whole number to a person; what is none is left to the type check."""
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() else text


def resolve(base: Config, overrides: Mapping[str, str]) -> Config:
    """`base` with the overrides, type-checked by OmegaConf and range-checked; ConfigError for what does not fit."""
    config = OmegaConf.structured(base)
    for key, text in overrides.items():
        if key in ("algo", "env"):
            continue
        if getattr(base, key) is None:
            raise ConfigError(f"{key} does not apply to {base.env if key == 'simulator' else base.algo}")
        override(config, Config, key, text)
    resolved = typing.cast(Config, OmegaConf.to_object(config))
    _check_ranges(resolved)
    return resolved


def _check_ranges(config: Config) -> None:
    def demand(key: str, ok: bool, what: str) -> None:
        if not ok:
            raise ConfigError(f"bad value {getattr(config, key)!r} for {key}: {what}")

    for key, value in asdict(config).items():
        if isinstance(value, float):
            demand(key, math.isfinite(value), "must be finite")
    counts = ("steps", "batch_size", "buffer_size", "eval_every", "eval_episodes", "final_episodes")
    for key in (*counts, "threads", "checkpoint_every"):
        demand(key, getattr(config, key) >= 1, "must be at least 1")
    for key in ("learning_starts", "action_noise", "target_noise", "target_noise_clip", "penalty", "log_det_floor"):
        demand(key, (getattr(config, key) or 0) >= 0, "must not be negative")
    demand("gamma", 0 <= config.gamma <= 1, "must be in [0, 1]")
    demand("tau", 0 < config.tau <= 1, "must be in (0, 1]")
    demand("learning_rate", config.learning_rate > 0, "must be positive")
    demand("fw_learning_rate", config.fw_learning_rate is None or 0 < config.fw_learning_rate <= 1, "must be in (0, 1]")
    demand("policy_delay", config.policy_delay is None or config.policy_delay >= 1, "must be at least 1")
    demand("entropy", config.entropy in (None, "paper", "ball"), "must be 'paper' or 'ball'")
    demand("boundary_weight", config.boundary_weight is None or config.boundary_weight > 0, "must be positive")
    demand("hidden", min(config.hidden) >= 1, "must list positive widths")
    demand("gradient_steps", config.gradient_steps == -1 or config.gradient_steps >= 1, "must be -1 or at least 1")
    # Whether there is such a GPU, only the machine that trains can tell.
    demand("device", bool(re.fullmatch(r"cpu|cuda(:[0-9]+)?", config.device)), "must be cpu, cuda or cuda:N")
    freq = config.train_freq
    demand("train_freq", freq == "episode" or (freq.isdecimal() and int(freq) >= 1), "must be steps or 'episode'")


def differences(config: Config, base: Config) -> dict[str, object]:
    """The settings of `config` that make it another experiment than `base`, seeds apart."""
    names = [f.name for f in fields(Config) if f.name not in RUN_KEYS]
    return {name: getattr(config, name) for name in names if getattr(config, name) != getattr(base, name)}


def saved_settings(config: Config, seed: int) -> dict[str, object]:
    """The configuration of one seed as its run folder keeps it."""
    settings = asdict(config) | {"seed": str(seed)}
    return {key: value for key, value in settings.items() if key not in ("results", "overwrite")}
