"""Estimates of a cell's time and memory, before it is trained.

`bench/rates.py` measures the rates of every cell of the paper's table, ten seeds in lockstep on one core, and writes
them to sweep/rates.csv. The times of finished runs in the folder of results correct the estimates.
"""

from __future__ import annotations

import csv
import heapq
import statistics
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from algos import ALGORITHMS, saved_config
from core.config import Config
from envs import TASKS
from store.folder import Run
from sweep.cells import paper_config

RATES = Path(__file__).with_name("rates.csv")
COLUMNS = ("task", "algo", "update_ms", "step_ms")
SEEDS = 10
"""Seeds in lockstep when the rates were measured."""

# Fixed overheads: of a batch in transitions, of a gradient step and of a simulated step in seeds. The first is fitted
# to gradient steps with 100 and 256 transitions, the others to cells of one seed and of ten.
BATCH_OVERHEAD = 90
UPDATE_OVERHEAD = 0.5
STEP_OVERHEAD = 2.0

# Memory, fitted to the peaks of short runs with one seed and with ten.
PROCESS_BYTES = 380e6  # libraries
SEED_BYTES = 15e6  # networks and optimisers of one seed

TELLING_STEPS = 10_000
"""Runs with fewer gradient steps do not correct the estimates."""


class Rate(NamedTuple):
    """Milliseconds, for SEEDS seeds together, of a gradient step at the paper's batch size and of a simulated step."""

    update_ms: float
    step_ms: float


@cache
def _rates() -> dict[tuple[str, str], Rate]:
    with open(RATES, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {(row["task"], row["algo"]): Rate(float(row["update_ms"]), float(row["step_ms"])) for row in rows}


def is_measured(task: str, algo: str) -> bool:
    """Whether the task was measured, and the algorithm or another one of its family.

    The time of your own task depends most on its constraint, which can take a hundred times as long as another.
    """
    families = {ALGORITHMS[name].agent.family for _, name in _rates() if name in ALGORITHMS}
    return task in {name for name, _ in _rates()} and ALGORITHMS[algo].agent.family in families


@cache
def _rate(task: str, algo: str) -> Rate:
    """The measured rate of a cell. Without one: the mean over cells of the same robot and family of algorithms."""
    if (task, algo) in _rates():
        return _rates()[task, algo]
    family = ALGORITHMS[algo].agent.family
    same_robot = {key: rate for key, rate in _rates().items() if TASKS[key[0]].robot == TASKS[task].robot}
    near = [rate for key, rate in same_robot.items() if ALGORITHMS[key[1]].agent.family == family]
    return Rate(*map(statistics.mean, zip(*(near or same_robot.values() or _rates().values()), strict=True)))


def seconds(config: Config, paper: Config, seeds: int, start: int = 0) -> float:
    """Estimated seconds of training `seeds` seeds in lockstep from step `start` to the end, on one core.

    `paper` is the paper's configuration of the same cell, whose rate was measured.
    """
    rate, robot = _rate(config.env, config.algo), _robot(config)
    step = 1e-3 * rate.step_ms * (seeds + STEP_OVERHEAD) / (SEEDS + STEP_OVERHEAD)
    update = 1e-3 * rate.update_ms * (seeds + UPDATE_OVERHEAD) / (SEEDS + UPDATE_OVERHEAD)
    update *= (config.batch_size + BATCH_OVERHEAD) / (paper.batch_size + BATCH_OVERHEAD)
    rollout = config.train_freq if isinstance(config.train_freq, int) else robot.max_episode_steps
    per_step = 1.0 if config.gradient_steps == -1 else config.gradient_steps / rollout
    updates = per_step * (config.steps - max(start, config.learning_starts))
    evaluations = config.steps // config.eval_every - start // config.eval_every
    episodes = evaluations * config.eval_episodes + config.final_episodes
    # The episodes of an evaluation run side by side, but the simulator computes the steps of each.
    return step * (config.steps - start + episodes * robot.max_episode_steps) + update * max(0.0, updates)


def memory(config: Config, seeds: int) -> float:
    """Estimated memory in bytes, with the replay buffer as full as it gets."""
    robot = _robot(config)
    centers = 2 if ALGORITHMS[config.algo].map.replays_center(TASKS[config.env].constraint) else 0
    width = 2 * robot.obs_dim + (1 + centers) * robot.action_dim + 2
    rejections = getattr(config, "rejected_kept", 0) * (robot.obs_dim + robot.action_dim)  # ARAM's second buffer
    return PROCESS_BYTES + seeds * (SEED_BYTES + 4.0 * (width * min(config.buffer_size, config.steps) + rejections))


def _robot(config: Config) -> Any:
    return TASKS[config.env].robot


def corrections(runs: Iterable[Run], device: str) -> dict[tuple[str, str], float]:
    """Actual time over estimated time of finished runs: the median by (task, algorithm), and at ("", "") that of all.

    Ignores runs on another kind of `device`, with other layers, with few gradient steps, or without a recorded time.
    """
    ratios: dict[tuple[str, str], list[float]] = {}
    for run in runs:
        if run.result is None or run.task not in TASKS or run.algo not in ALGORITHMS:
            continue
        try:
            # Old runs without a device ran on the CPU.
            config = saved_config({"device": "cpu"} | run.config | {"env": run.task, "algo": run.algo})
            took, seeds = float(run.result["seconds"]["total"]), int(run.result["seeds_in_lockstep"])
            steps = int(run.result["gradient_steps"])
        except (KeyError, TypeError, ValueError):
            continue
        same_device = config.device.partition(":")[0] == device.partition(":")[0]
        paper = paper_config(run.algo, run.task)
        if same_device and config.hidden == paper.hidden and steps >= TELLING_STEPS:
            ratio = took / seconds(config, paper, seeds)
            ratios.setdefault((run.task, run.algo), []).append(ratio)
            ratios.setdefault(("", ""), []).append(ratio)
    return {key: statistics.median(values) for key, values in ratios.items()}


def correct(corrections: Mapping[tuple[str, str], float], task: str, algo: str) -> float:
    """The correction from the cell's own finished runs; without any, the median over all finished runs."""
    return corrections.get((task, algo), corrections.get(("", ""), 1.0))


def makespan(durations: Sequence[float], jobs: int) -> float:
    """The time when the last of `durations` ends, if they run in this order, `jobs` at a time."""
    ends = [0.0] * max(1, min(jobs, len(durations)))
    for duration in durations:
        heapq.heapreplace(ends, ends[0] + duration)
    return max(ends)


def in_words(duration: float) -> str:
    """A number of seconds as text: 45 s, 12 min, 3.5 h, 12 d."""
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if duration >= 1.5 * size:
            return f"{duration / size:.{1 if duration < 10 * size else 0}f} {unit}"
    return f"{duration:.0f} s"
