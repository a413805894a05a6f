"""Figures of a folder of results: learning curves and training measures."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import chain, cycle
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullLocator

from plots.grouping import Condition, Groups, order_conditions
from plots.paper import PAPER_SEEDS, order_algos
from plots.style import color_of, line_of, plain, save
from store.folder import Run

LOGARITHMIC = ("temperature",)
"""Training measures that change by orders of magnitude."""
LINE_STYLES = ("dashed", "solid", "dotted", "dashdot")
MANY = 8


def mean_curve(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps, mean and standard error (NaN with one seed), each (n,), of seeds' curves (steps, values).

    The mean at a step is over the seeds that have reached it.
    """
    steps = np.unique(np.concatenate([at for at, _ in curves]))
    # A missing value is masked. A NaN stays NaN and breaks the line.
    values = np.ma.array(np.zeros((len(curves), len(steps))), mask=True)
    for row, (at, value) in zip(values, curves, strict=True):
        row[np.searchsorted(steps, at)] = value
    error = values.std(axis=0, ddof=1) / np.sqrt(values.count(axis=0))
    return steps, values.mean(axis=0).filled(math.nan), error.filled(math.nan)


def learning_curve(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`mean_curve` of the evaluations of `runs`."""
    return mean_curve([(run.evaluations.step, run.evaluations.return_mean) for run in runs])


def draw_curves(groups: Groups, folder: Path, formats: Sequence[str]) -> list[Path]:
    """A figure of learning curves for each condition, and one of training measures for each task that has any."""
    conditions = list(chain.from_iterable(order_conditions(groups)))
    jobs = [partial(_draw_condition, condition, groups[condition]) for condition in conditions]
    for task in dict.fromkeys(condition.task for condition in conditions):
        of_task = {condition.settings: groups[condition] for condition in conditions if condition.task == task}
        jobs.append(partial(_draw_training, task, of_task))
    # A figure takes up to a second, so many figures are worth the start of several processes.
    if len(jobs) < MANY:
        return [path for job in jobs for path in job(folder, formats)]
    with ProcessPoolExecutor(max_workers=min(os.cpu_count() or 1, len(jobs))) as pool:
        futures = [pool.submit(job, folder, formats) for job in jobs]
        return [path for future in futures for path in future.result()]


def _draw_condition(
    condition: Condition, by_algo: dict[str, list[Run]], folder: Path, formats: Sequence[str]
) -> list[Path]:
    evaluated = [algo for algo in order_algos(by_algo) if any(len(run.evaluations.step) for run in by_algo[algo])]
    if not evaluated:
        return []
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for algo in evaluated:
        _draw_curve(axes, algo, learning_curve(by_algo[algo]), label=_legend(algo, by_algo[algo]))
    _label_axes(axes, "Evaluation return (mean ± standard error)")
    axes.set_title(fill(condition.label, 60))
    figure.legend(loc="outside right upper", frameon=False)
    return save(figure, folder, condition.label.replace(", ", ","), formats)


def _draw_training(
    task: str, by_settings: dict[str, dict[str, list[Run]]], folder: Path, formats: Sequence[str]
) -> list[Path]:
    """Returns and training measures side by side, of the runs that have measures; a line style for each setting."""
    words = {settings: dict.fromkeys(filter(None, settings.split(", "))) for settings in by_settings}
    common = [word for word in next(iter(words.values())) if all(word in others for others in words.values())]
    curves = [
        (
            algo,
            style,
            ", ".join([_legend(algo, by_algo[algo]), *(word for word in words[settings] if word not in common)]),
            by_algo[algo],
        )
        for (settings, by_algo), style in zip(by_settings.items(), cycle(LINE_STYLES), strict=False)
        for algo in order_algos(by_algo)
        if any(run.training for run in by_algo[algo])
    ]
    columns = dict.fromkeys(name for *_, runs in curves for run in runs for name in run.training)
    measures = [name for name in columns if name != "step"]
    if not measures:
        return []
    figure = Figure(figsize=(1.5 + 3.6 * (1 + len(measures)), 4.2), layout="constrained")
    first, *others = figure.subplots(1, 1 + len(measures), sharex=True)
    for algo, style, label, runs in curves:
        _draw_curve(first, algo, learning_curve(runs), label=label, linestyle=style)
        for axes, measure in zip(others, measures, strict=True):
            points = [(run.training["step"], run.training[measure]) for run in runs if measure in run.training]
            if points:
                _draw_curve(axes, algo, mean_curve(points), linestyle=style)
    _label_axes(first, "Evaluation return")
    for axes, measure in zip(others, measures, strict=True):
        _label_axes(axes, measure.capitalize())
        if measure in LOGARITHMIC:
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_major_formatter("{x:g}")
    figure.suptitle(fill(", ".join([f"{task} (mean ± standard error)", *common]), 110))
    longest = max(len(label) for _, _, label, _ in curves)
    figure.legend(loc="outside lower center", ncols=max(1, min(len(curves), 100 // (longest + 8))), frameon=False)
    return save(figure, folder, f"{task}-training", formats)


def _draw_curve(axes: Axes, algo: str, curve: tuple[np.ndarray, np.ndarray, np.ndarray], **line: Any) -> None:
    steps, mean, error = curve
    axes.plot(steps, mean, **(line_of(algo, len(steps)) | line))
    axes.fill_between(steps, mean - error, mean + error, color=color_of(algo), alpha=0.15, lw=0)


def _label_axes(axes: Axes, quantity: str) -> None:
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
