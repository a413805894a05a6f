"""What a cell takes, before it is trained: seconds and memory.

The rates are measured, by `bench/rates.py`, which writes them to sweep/rates.csv: each cell of the table, ten seeds in
lockstep, one core. Where the folder of results has runs that are finished, the times that those took correct them.
"""

from __future__ import annotations

import csv
import heapq
import statistics
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from algos import ALGORITHMS
from core.config import Config
from envs import TASKS
from store.folder import Run

RATES = Path(__file__).with_name("rates.csv")
COLUMNS = ("task", "algo", "update_ms", "step_ms")
SEEDS = 10
"""Seeds in lockstep when the rates were measured."""

# Overheads that do not grow with the batch, or with the seeds, in units of them. The batch: fitted to gradient steps of
# 100 and 256 transitions. The seeds: to cells of one and of ten.
BATCH_OVERHEAD = 90
UPDATE_OVERHEAD = 0.5
STEP_OVERHEAD = 2.0

# Memory, measured as the peaks of short runs with one seed and with ten.
PROCESS_BYTES = 380e6  # libraries
SEED_BYTES = 15e6  # networks and optimisers of one seed
SIMULATOR_BYTES = {"Reacher": 35e6}  # PyBullet's; MuJoCo's are too small to matter


class Rate(NamedTuple):
    """Milliseconds, for SEEDS seeds together, of a gradient step at the paper's batch size and of a simulated step."""

    update_ms: float
    step_ms: float


@cache
def _rates() -> dict[tuple[str, str], Rate]:
    with open(RATES, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {(row["task"], row["algo"]): Rate(float(row["update_ms"]), float(row["step_ms"])) for row in rows}


@cache
def _rate(task: str, algo: str) -> Rate:
    """The measured rate of this cell. For an unknown cell: the mean over those with the same robot and family."""
    if (task, algo) in _rates():
        return _rates()[task, algo]

    families = {name: algorithm.agent.family for name, algorithm in ALGORITHMS.items()}

    def alike(other_task: str, other_algo: str) -> bool:
        return TASKS[other_task].robot == TASKS[task].robot and families[other_algo] == families[algo]

    near = [rate for key, rate in _rates().items() if alike(*key)] or list(_rates().values())
    return Rate(*map(statistics.mean, zip(*near, strict=True)))


def seconds(config: Config, base: Config, seeds: int, start: int = 0) -> float:
    """What is left of the training of `seeds` seeds from step `start` on, on one core; `base` is the paper's cell."""
    rate = _rate(config.env, config.algo)
    robot: Any = TASKS[config.env].robot
    step = 1e-3 * rate.step_ms * (seeds + STEP_OVERHEAD) / (SEEDS + STEP_OVERHEAD)
    update = 1e-3 * rate.update_ms * (seeds + UPDATE_OVERHEAD) / (SEEDS + UPDATE_OVERHEAD)
    update *= (config.batch_size + BATCH_OVERHEAD) / (base.batch_size + BATCH_OVERHEAD)
    rollout = config.train_freq if isinstance(config.train_freq, int) else robot.max_episode_steps
    per_step = 1.0 if config.gradient_steps == -1 else config.gradient_steps / rollout
    updates = per_step * (config.steps - max(start, config.learning_starts))
    evaluations = config.steps // config.eval_every - start // config.eval_every
    episodes = evaluations * config.eval_episodes + config.final_episodes
    # The episodes of an evaluation run side by side, but each takes its own steps of the simulator.
    return step * (config.steps - start + episodes * robot.max_episode_steps) + update * max(0.0, updates)


def memory(config: Config, seeds: int) -> float:
    """Bytes, with the replay buffer as full as it gets."""
    task, algorithm = TASKS[config.env], ALGORITHMS[config.algo]
    robot: Any = task.robot
    centers = 2 if algorithm.map.stores_centers(task.constraint) else 0
    width = 2 * robot.obs_dim + (1 + centers) * robot.action_dim + 2
    simulators = (1 + config.eval_episodes) * SIMULATOR_BYTES.get(robot.__name__, 0.0)
    return PROCESS_BYTES + seeds * (SEED_BYTES + simulators + 4.0 * width * min(config.buffer_size, config.steps))


TELLING_STEPS = 10_000
"""Gradient steps from which on a run's time says something of the rates."""


def corrections(runs: Iterable[tuple[Run, Config, Config]], device: str) -> dict[tuple[str, str], float]:
    """By (task, algorithm), how many times as long as estimated finished runs took; ("", "") has the median of all.

    Each run comes with its configuration and the paper's of the same cell. Left out are those on another kind of
    `device`, with other layers, or too short to tell, and those whose result does not have its time.
    """
    ratios: dict[tuple[str, str], list[float]] = {}
    for run, config, base in runs:
        if run.result is None or config.device.partition(":")[0] != device.partition(":")[0]:
            continue
        try:
            took, seeds = float(run.result["seconds"]["total"]), int(run.result["seeds_in_lockstep"])
            steps = int(run.result["gradient_steps"])
        except (KeyError, TypeError, ValueError):
            continue
        if config.hidden != base.hidden or steps < TELLING_STEPS:
            continue
        ratio = took / seconds(config, base, seeds)
        ratios.setdefault((run.task, run.algo), []).append(ratio)
        ratios.setdefault(("", ""), []).append(ratio)
    return {key: statistics.median(values) for key, values in ratios.items()}


def correct(corrections: Mapping[tuple[str, str], float], task: str, algo: str) -> float:
    """The factor for a cell: that of its own runs, else that of all."""
    return corrections.get((task, algo), corrections.get(("", ""), 1.0))


def makespan(durations: Sequence[float], jobs: int) -> float:
    """When the last of `durations` ends, where `jobs` at a time start in this order."""
    ends = [0.0] * jobs
    for duration in durations:
        heapq.heapreplace(ends, ends[0] + duration)
    return max(ends)


def in_words(duration: float) -> str:
    """Seconds as a person says them: 45 s, 12 min, 3.5 h, 12 d."""
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if duration >= 1.5 * size:
            return f"{duration / size:.{1 if duration < 10 * size else 0}f} {unit}"
    return f"{duration:.0f} s"
