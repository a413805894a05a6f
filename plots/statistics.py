"""Aggregates over tasks (Agarwal et al. 2021): interquartile mean, performance profile, probability of improvement.

Scores are returns divided by the best mean of the task's row in the paper's table (its own batch size): 0 is a return
of zero, 1 the paper's best algorithm on that task. A task counts for an algorithm with at least two finished runs on
it. Intervals are 95 % percentile intervals of SciPy's bootstrap with the tasks as strata: seeds are resampled within
each task.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from plots.grouping import Groups, final_return, place_of_settings
from plots.paper import (
    DEFAULT_BATCH,
    UNCONSTRAINED,
    order_algos,
    order_tasks,
    read_paper,
    same_without_constraint,
)

RESAMPLES = 2_000
CONFIDENCE = 0.95

Scores = dict[str, dict[str, np.ndarray]]
"""Scores of the finished runs, algorithm -> task -> (n,). A failed run has -inf, below all others."""


class Estimate(NamedTuple):
    """A value with its confidence interval."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def reference(task: str) -> float | None:
    """The return that corresponds to a score of 1; None for a task that the paper does not have."""
    means = [stat.mean for (name, batch, _), stat in read_paper().items() if (name, batch) == (task, DEFAULT_BATCH)]
    return max(means, default=None)


def normalised_scores(groups: Groups) -> dict[str, Scores]:
    """Scores by settings. On R+N some algorithms coincide: an algorithm without runs there gets the other's scores."""
    by_settings: dict[str, Scores] = defaultdict(lambda: defaultdict(dict))
    for condition, by_algo in groups.items():
        if (unit := reference(condition.task)) is None:
            continue
        for algo, runs in by_algo.items():
            returns = [value for run in runs if (value := final_return(run)) is not None]
            if len(returns) > 1:
                values = np.asarray(returns) / unit
                by_settings[condition.settings][algo][condition.task] = np.where(np.isfinite(values), values, -np.inf)
    for scores in by_settings.values():
        for algo in scores:
            if UNCONSTRAINED in scores.get(same := same_without_constraint(algo), {}):
                scores[algo].setdefault(UNCONSTRAINED, scores[same][UNCONSTRAINED])
    return {
        settings: {
            algo: {task: scores[algo][task] for task in order_tasks(scores[algo])} for algo in order_algos(scores)
        }
        for settings, scores in sorted(by_settings.items(), key=lambda item: place_of_settings(item[0], len(item[1])))
    }


def comparable(scores: Scores) -> dict[tuple[str, ...], list[str]]:
    """Algorithms grouped by their scored tasks, most tasks first: aggregates compare over the same tasks only."""
    by_tasks: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for algo, by_task in scores.items():
        by_tasks[tuple(by_task)].append(algo)
    return dict(sorted(by_tasks.items(), key=lambda item: -len(item[0])))


def interquartile_mean(by_task: dict[str, np.ndarray]) -> Estimate:
    """Mean of the middle half of all runs on all tasks."""

    def statistic(*samples: np.ndarray, axis: int) -> np.ndarray:
        return stats.trim_mean(np.concatenate(samples, axis), 0.25, axis)

    return _estimate(statistic, list(by_task.values()))


def performance_profile(by_task: dict[str, np.ndarray], thresholds: np.ndarray) -> Estimate:
    """Share of all runs on all tasks whose score is above each of `thresholds` (t,)."""

    def statistic(*samples: np.ndarray, axis: int) -> np.ndarray:
        return np.concatenate(samples, axis).mean(axis)

    return _estimate(statistic, [values > thresholds[:, None] for values in by_task.values()])


def probability_of_improvement(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> Estimate:
    """Probability that a run of `first` beats a run of `second` (ties count half), mean over their common tasks."""
    tasks = [task for task in first if task in second]

    def statistic(*samples: np.ndarray, axis: int) -> np.ndarray:
        pairs = zip(samples[: len(tasks)], samples[len(tasks) :], strict=True)
        return np.mean([_chance_above(x, y) for x, y in pairs], axis=0)

    return _estimate(statistic, [first[task] for task in tasks] + [second[task] for task in tasks])


def _chance_above(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """P(x > y) + P(x = y) / 2 of samples (..., n) and (..., m). SciPy's test would compute p-values too."""
    x, y = x[..., :, None], y[..., None, :]
    return ((x > y).mean((-2, -1)) + (x >= y).mean((-2, -1))) / 2


def _estimate(statistic: Callable[..., np.ndarray], samples: Sequence[np.ndarray]) -> Estimate:
    """The `statistic` of `samples` (..., n_k) with its interval; each sample is resampled separately."""
    with np.errstate(invalid="ignore"):  # the standard error is NaN if runs failed
        interval = stats.bootstrap(
            samples,
            statistic,
            n_resamples=RESAMPLES,
            batch=1000,
            confidence_level=CONFIDENCE,
            method="percentile",
            vectorized=True,
            axis=-1,
            rng=np.random.default_rng(0),
        ).confidence_interval
    return Estimate(statistic(*samples, axis=-1), interval.low, interval.high)
