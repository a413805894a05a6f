"""Figures of a folder of results: learning curves and training measures."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogFormatter

from core.results import Run
from plots.grouping import Condition, Groups, order_conditions
from plots.paper import PAPER_SEEDS, order_algos
from plots.style import color_of, line_of, plain, save

LOGARITHMIC = ("temperature",)
"""Training measures that change by orders of magnitude."""
MANY = 8


def mean_curve(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps, mean and standard error (NaN with one seed), each (n,), of seeds' curves (steps, values).

    The mean is over the seeds that have a value at the step, for those in progress lag behind.
    """
    steps = np.unique(np.concatenate([at for at, _ in curves]))
    # Masked where a seed has no value (yet); one of NaN stays NaN and breaks the line.
    values = np.ma.array(np.zeros((len(curves), len(steps))), mask=True)
    for row, (at, value) in zip(values, curves, strict=True):
        row[np.searchsorted(steps, at)] = value
    error = values.std(axis=0, ddof=1) / np.sqrt(values.count(axis=0))
    return steps, values.mean(axis=0).filled(math.nan), error.filled(math.nan)


def learning_curve(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`mean_curve` of the evaluations of `runs`."""
    return mean_curve([(run.evaluations.step, run.evaluations.return_mean) for run in runs])


def draw_conditions(groups: Groups, folder: Path, formats: Sequence[str]) -> list[Path]:
    """A figure of learning curves for each condition, and one of training measures where there are any."""
    conditions = list(chain.from_iterable(order_conditions(groups)))
    draw = partial(_draw_condition, folder=folder, formats=formats)
    arguments = conditions, [groups[condition] for condition in conditions]
    # A figure takes up to a second: many are worth the start of a process for each processor.
    if len(conditions) < MANY:
        return list(chain.from_iterable(map(draw, *arguments)))
    with ProcessPoolExecutor(max_workers=min(os.cpu_count() or 1, len(conditions))) as pool:
        return list(chain.from_iterable(pool.map(draw, *arguments)))


def _draw_condition(
    condition: Condition, by_algo: dict[str, list[Run]], folder: Path, formats: Sequence[str]
) -> list[Path]:
    evaluated = {
        algo: by_algo[algo] for algo in order_algos(by_algo) if any(len(run.evaluations.step) for run in by_algo[algo])
    }
    if not evaluated:
        return []
    written = save(_learning_figure(condition, evaluated), folder, _file_name(condition), formats)
    measured = {algo: runs for algo, runs in evaluated.items() if any(run.training for run in runs)}
    if measured:
        written += save(_training_figure(condition, measured), folder, f"{_file_name(condition)}-training", formats)
    return written


def _file_name(condition: Condition) -> str:
    return condition.label.replace(", ", ",")


def _learning_figure(condition: Condition, by_algo: dict[str, list[Run]]) -> Figure:
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    _draw_returns(axes, by_algo)
    axes.set_title(condition.label)
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def _training_figure(condition: Condition, by_algo: dict[str, list[Run]]) -> Figure:
    """Returns and training measures of the algorithms that have such, side by side."""
    columns = dict.fromkeys(name for runs in by_algo.values() for run in runs for name in run.training)
    measures = [name for name in columns if name != "step"]
    figure = Figure(figsize=(2.0 + 3.6 * (1 + len(measures)), 3.6), layout="constrained")
    first, *others = figure.subplots(1, 1 + len(measures), sharex=True)
    _draw_returns(first, by_algo)
    for axes, measure in zip(others, measures, strict=True):
        for algo, runs in by_algo.items():
            curves = [(run.training["step"], run.training[measure]) for run in runs if measure in run.training]
            if curves:
                _draw_curve(axes, algo, mean_curve(curves), "")
        _label_steps(axes, f"{measure.capitalize()} (mean ± standard error)")
        if measure in LOGARITHMIC:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(LogFormatter())
            axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.5)))
    figure.suptitle(condition.label)
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def _draw_returns(axes: Axes, by_algo: dict[str, list[Run]]) -> None:
    for algo, runs in by_algo.items():
        _draw_curve(axes, algo, learning_curve(runs), _legend(algo, runs))
    _label_steps(axes, "Evaluation return (mean ± standard error)")


def _draw_curve(axes: Axes, algo: str, curve: tuple[np.ndarray, np.ndarray, np.ndarray], label: str) -> None:
    steps, mean, error = curve
    axes.plot(steps, mean, label=label, **line_of(algo, len(steps)))
    axes.fill_between(steps, mean - error, mean + error, color=color_of(algo), alpha=0.15, lw=0)


def _label_steps(axes: Axes, quantity: str) -> None:
    axes.set_xlabel("Environment steps")
    axes.set_ylabel(quantity)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    plain(axes)


def _legend(algo: str, runs: Sequence[Run]) -> str:
    finished = sum(run.finished for run in runs)
    if finished < len(runs):
        return f"{algo} ({finished} of {len(runs)} seed{'s' * (len(runs) > 1)} finished)"
    return algo if len(runs) == PAPER_SEEDS else f"{algo} (n={len(runs)})"
