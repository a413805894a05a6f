"""Settings: the dataclass that all algorithms share, the declaration of its fields, and the parsing of values.

An algorithm declares its own settings in a subclass of `Config`, and a map in its own fields (`core.maps.Map`).
"""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, field, fields, make_dataclass
from typing import Any, NamedTuple

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from core.words import ConfigError
from store.loggers import CSV, LOGGERS

CORES = torch.get_num_threads()
"""PyTorch's default number of threads: the physical cores, or OMP_NUM_THREADS."""
THREADS = {"cpu": min(CORES, 4), "cuda": min(CORES, 8)}
"""The value of threads=auto, by device, for a cell that is alone on the machine. Its small networks use at most 4
threads. Beside a GPU, the threads simulate MuJoCo's robots."""
MOST_THREADS = 1024
AUTO = "auto"
"""Stands for the fastest choice on the machine that trains."""


QUICK_EPISODES = (1, 2)
"""Episodes of an evaluation and of the final result with quick=true, which does not change the training."""


# ---------------------------------------------------------------- how a setting is declared


class Rule(NamedTuple):
    """The condition that a setting's value must meet, and its error message."""

    holds: Callable[[Any], bool]
    words: str


POSITIVE = Rule(lambda value: value > 0, "must be positive")
NOT_NEGATIVE = Rule(lambda value: value >= 0, "must not be negative")
AT_LEAST_ONE = Rule(lambda value: value >= 1, "must be at least 1")
SHARE = Rule(lambda value: 0 <= value <= 1, "must be in [0, 1]")
POSITIVE_SHARE = Rule(lambda value: 0 < value <= 1, "must be in (0, 1]")


def one_of(*choices: str) -> Rule:
    return Rule(lambda value: value in choices, f"must be {' or '.join(map(repr, choices))}")


def setting(default: Any, help: str, rule: Rule | None = None, **metadata: Any) -> Any:
    """Declare a dataclass field that is a key of the command line.

    `help` is one line for the usage text. Metadata: `key` is the name on the command line and in config.yaml, if it
    differs from the field's; `of_density` marks a map's setting that only algorithms with a log-density have;
    `only_with` is a pair (field, value): the setting applies only if that field has that value.
    """
    metadata |= {"help": help, "rule": rule}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def keys_of(schema: Any) -> dict[str, Field]:
    """The fields of a dataclass by their names on the command line and in config.yaml."""
    return {f.metadata.get("key", f.name): f for f in fields(schema)}


# ---------------------------------------------------------------- the settings of every algorithm


@dataclass
class Config:
    """The settings of one run that every algorithm has."""

    algo: str
    env: str
    seeds: tuple[int, ...] = setting((0,), "seeds trained in lockstep: 3, 0-9 or 1,4,7", key="seed")
    steps: int = setting(0, "environment steps of each seed", AT_LEAST_ONE)
    # Hyperparameters of the paper's table "Hyperparameters used in the experiments".
    gamma: float = setting(0.99, "discount factor", SHARE)
    hidden: list[int] = setting(
        [400, 300], "hidden layer widths", Rule(lambda value: min(value) >= 1, "must list positive widths")
    )
    batch_size: int = setting(100, "transitions per gradient step", AT_LEAST_ONE)
    learning_rate: float = setting(1e-3, "learning rate of Adam, for every network", POSITIVE)
    buffer_size: int = setting(1_000_000, "transitions kept for replay per seed", AT_LEAST_ONE)
    tau: float = setting(0.005, "target update ratio", POSITIVE_SHARE)
    learning_starts: int = setting(100_000, "random warm-up steps", NOT_NEGATIVE)
    train_freq: int | str = setting(
        1,
        "environment steps per rollout, or 'episode'",
        Rule(lambda value: value == "episode" or (isinstance(value, int) and value >= 1), "must be >= 1 or 'episode'"),
    )
    gradient_steps: int = setting(
        1,
        "gradient steps after each rollout; -1: one per step of the rollout",
        Rule(lambda value: value == -1 or value >= 1, "must be -1 or at least 1"),
    )
    # Protocol.
    eval_every: int = setting(5_000, "environment steps between evaluations", AT_LEAST_ONE)
    eval_episodes: int = setting(5, "episodes per evaluation", AT_LEAST_ONE)
    final_episodes: int = setting(50, "episodes of the final evaluation", AT_LEAST_ONE)
    quick: bool = setting(False, "few evaluation episodes, for a first try; the run's name shows it")
    # The run itself. None of these settings changes the training beyond float rounding.
    results: str = setting("results", "folder of the results")
    overwrite: str = setting(
        "false",
        "true: start again; changed: only if the task or algorithm has changed; the old run is kept",
        Rule(lambda value: value in ("false", "true", "changed"), "must be false, true or changed"),
    )
    simulator: str | None = setting(None, "simulator of the robot, if it has several (Reacher: closed-form, pybullet)")
    device: str = setting(
        AUTO,
        "device of networks and replay buffer: auto (a GPU if there is one), cpu, cuda or cuda:1",
        # Only the machine that trains can tell whether there is such a GPU.
        Rule(lambda value: bool(re.fullmatch(r"auto|cpu|cuda(:[0-9]+)?", value)), "must be auto, cpu, cuda or cuda:N"),
    )
    threads: int | str = setting(
        AUTO,
        "CPU threads per cell; auto: 1 in a sweep, otherwise up to 4 (with a GPU up to 8)",
        # (PyTorch crashes with a million)
        Rule(
            lambda value: value == AUTO or (isinstance(value, int) and 1 <= value <= MOST_THREADS),
            f"must be auto or from 1 to {MOST_THREADS}",
        ),
    )
    checkpoint_every: int = setting(10_000, "environment steps per seed between checkpoints", AT_LEAST_ONE)
    log: str = setting(
        CSV,
        "loggers: csv (the run's own files, always on), tensorboard, wandb, or both: tensorboard,wandb",
        Rule(
            lambda value: set(value.split(",")) <= {CSV, *LOGGERS},
            f"must be one or several of {', '.join((CSV, *LOGGERS))}, comma separated",
        ),
    )


@dataclass
class PenaltyConfig(Config):
    """The settings of an algorithm whose name ends in +, with the weight of the penalty."""

    penalty: float = setting(1.0, "names that end in +: weight of the penalty", NOT_NEGATIVE)


RUN_KEYS = ("algo", "env", "seed", "results", "overwrite", "simulator", "device", "threads", "checkpoint_every", "log")
"""Settings that do not make a run a different experiment. They never appear in its name."""


def keys_that_apply(config: Config) -> list[str]:
    """The keys that a user can set for the cell of `config`, without those that have no choice (value None)."""
    return [key for key, f in keys_of(config).items() if getattr(config, f.name) is not None]


# ---------------------------------------------------------------- values on the command line


def parse_seeds(text: str) -> tuple[int, ...]:
    """Parse `3`, `0-9`, `1,4,7` or a mixture into ascending seeds without repetition. Raises ConfigError."""
    seeds: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise ConfigError(f"bad seed {text!r} (examples: seed=3, seed=0-9, seed=1,4,7)")
        low, high = int(first), int(last or first)
        if high < low:
            raise ConfigError(f"bad seed {text!r}: the range {part!r} is empty")
        if high - low >= 1000 or high >= 2**31:
            raise ConfigError(f"bad seed {text!r}: a range has at most 1000 seeds, each below 2^31")
        seeds.update(range(low, high + 1))
    return tuple(sorted(seeds))


def split_values(schema: type, key: str, text: str) -> list[str]:
    """Split a comma list of values of one key of the dataclass `schema`: `1e-3,3e-4`, or `[64,64],[128,128]` for lists.

    A list without brackets is one value. Keys in `RUN_KEYS` have one value. Repeated values are dropped. Raises
    ConfigError for an empty value and for malformed brackets.
    """
    kind = typing.get_type_hints(schema)[keys_of(schema)[key].name]
    if key in RUN_KEYS:
        return [text]
    if typing.get_origin(kind) is not list:
        values = text.split(",")
    elif "[" not in text and "]" not in text:
        return [text]
    elif re.fullmatch(r"\[[^][]*\](,\[[^][]*\])*", text):
        values = re.findall(r"\[[^][]*\]", text)
    else:
        raise ConfigError(f"bad value {text!r} for {key}: expected one list (64,64) or several ([64,64],[128])")
    if not all(values):
        raise ConfigError(f"bad value {text!r} for {key}: a value between commas is empty")
    return list(dict.fromkeys(values))


def parse_value(schema: type, key: str, text: str, prefix: str = "") -> Any:
    """Parse the value of one key of the dataclass `schema`. Raises ConfigError if `text` does not fit the key's type.

    The message shows the key as on the command line, with `prefix` before it.
    """
    if text in ("null", "None", "~"):
        raise ConfigError(f"bad value {text!r} for {prefix}{key}: a value is needed")
    kind = typing.get_type_hints(schema)[keys_of(schema)[key].name]
    kinds = [k for k in typing.get_args(kind) or [kind] if k is not type(None)]
    if kinds == [str]:
        return text
    typed = _typed(kind, text)
    if typing.get_origin(kind) is tuple:
        return typed
    try:
        # OmegaConf would substitute ${...} and treat ??? as missing.
        if "${" not in text and "???" not in text:
            checked = OmegaConf.structured(make_dataclass("Checked", [("value", kind)]))
            OmegaConf.update(checked, "value", typed)
            return vars(OmegaConf.to_object(checked))["value"]
    except OmegaConfBaseException:
        pass
    expected = str(kind) if typing.get_origin(kind) is list else " or ".join(k.__name__ for k in kinds)
    raise ConfigError(f"bad value {text!r} for {prefix}{key}: expected {expected}")


def _typed(kind: Any, text: str) -> object:
    """Prepare the text of one override for the type check of a field of the type `kind`."""
    if typing.get_origin(kind) is tuple:
        return parse_seeds(text)
    if typing.get_origin(kind) is list:
        return [_whole(part) for part in text.removeprefix("[").removesuffix("]").split(",")]
    return _whole(text) if int in (kind, *typing.get_args(kind)) else text


def _whole(text: str) -> int | str:
    """Convert a whole number, such as 3 or 3e5, to an int. Other text stays text, for the type check to judge."""
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() else text


def resolve(base: Config, overrides: Mapping[str, str]) -> Config:
    """Return `base` with the overrides, checked for type and range. Raises ConfigError for a bad key or value."""
    config = typing.cast(Config, OmegaConf.to_object(OmegaConf.structured(base)))
    config.seeds = tuple(config.seeds)  # OmegaConf makes a list of it
    if parse_value(type(base), "quick", overrides.get("quick", "false")):
        config.eval_episodes, config.final_episodes = QUICK_EPISODES
    for key, text in overrides.items():
        if key in ("algo", "env"):
            continue
        if key not in keys_that_apply(base):
            raise ConfigError(f"{key} does not apply to {base.algo} on {base.env}")
        setattr(config, keys_of(config)[key].name, parse_value(type(base), key, text))
    _check_company(config, overrides)
    _check_ranges(config)
    return config


def _check_company(config: Config, overrides: Iterable[str]) -> None:
    """Raise ConfigError for an override whose condition `only_with` does not hold."""
    for key, f in keys_of(config).items():
        if key in overrides and (needed := f.metadata.get("only_with")):
            other, value = needed
            if (found := getattr(config, other)) != value:
                raise ConfigError(f"{key} applies only with {other}={value}, not with {other}={found}")


def _check_ranges(config: Config) -> None:
    """Raise ConfigError for a number that is not finite or a value that breaks the rule of its field."""
    for key, f in keys_of(config).items():
        value, rule = getattr(config, f.name), f.metadata.get("rule")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"bad value {value!r} for {key}: must be finite")
        if rule and not rule.holds(value):
            raise ConfigError(f"bad value {value!r} for {key}: {rule.words}")


# ---------------------------------------------------------------- what a run's name and folder hold


def differences(config: Config, base: Config) -> dict[str, object]:
    """The settings of `config`, by key, that differ from `base`, without the keys in `RUN_KEYS`."""
    both = {key: (getattr(config, f.name), getattr(base, f.name)) for key, f in keys_of(config).items()}
    return {key: value for key, (value, paper) in both.items() if key not in RUN_KEYS and value != paper}


def saved_settings(config: Config, seed: int) -> dict[str, object]:
    """The configuration of one seed, by key, as its run folder stores it."""
    settings = {key: getattr(config, f.name) for key, f in keys_of(config).items()}
    settings |= {"seed": str(seed), "train_freq": str(config.train_freq)}
    # Without quick=true the key is left out, as in runs that are older than this setting.
    left_out = {"results", "overwrite", *(() if config.quick else ("quick",))}
    return {key: value for key, value in settings.items() if key not in left_out}


def restore_settings(schema: type[Config], saved: Mapping[str, Any]) -> Config:
    """Undo `saved_settings`: build a configuration of the dataclass `schema`.

    Ignores keys that the schema lacks and keys without a value. Raises TypeError if the algorithm or the task is
    missing, and ConfigError for a bad seed.
    """
    values = {f.name: saved[key] for key, f in keys_of(schema).items() if saved.get(key) is not None}
    if "seeds" in values:
        values["seeds"] = parse_seeds(str(values["seeds"]))
    if "train_freq" in values:
        values["train_freq"] = _whole(str(values["train_freq"]))
    return schema(**values)
