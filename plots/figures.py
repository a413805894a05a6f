"""Figures of a folder of results: learning curves and training measures."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain, cycle
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, NullLocator

from plots.grouping import DAGGER, Condition, Groups, count_diverged, order_conditions, setting_text
from plots.paper import PAPER_SEEDS, order_algos
from plots.style import legend_handles, line_of, plain, save
from store.folder import Run

LOGARITHMIC = ("temperature", "critic_loss")
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


def draw_curves(groups: Groups, own: Sequence[str], folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw the learning curves of each condition and the training measures of each task; return the files.

    A figure of training measures also shows the returns of algorithms without measures, if they have runs of several
    settings. `own` as in `plots.style.color_of`.
    """
    conditions = list(chain.from_iterable(order_conditions(groups)))
    jobs = [partial(_draw_condition, condition, groups[condition], own) for condition in conditions]
    for task in dict.fromkeys(condition.task for condition in conditions):
        of_task = {condition.settings: groups[condition] for condition in conditions if condition.task == task}
        jobs.append(partial(_draw_training, task, of_task, own))
    # A figure takes up to a second, so many figures are worth the start of several processes.
    if len(jobs) < MANY:
        return [path for job in jobs for path in job(folder, formats)]
    with ProcessPoolExecutor(max_workers=min(os.cpu_count() or 1, len(jobs))) as pool:
        futures = [pool.submit(job, folder, formats) for job in jobs]
        return [path for future in futures for path in future.result()]


def _draw_condition(
    condition: Condition, by_algo: dict[str, list[Run]], own: Sequence[str], folder: Path, formats: Sequence[str]
) -> list[Path]:
    evaluated = [algo for algo in order_algos(by_algo) if any(len(run.evaluations.step) for run in by_algo[algo])]
    if not evaluated:
        return []
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for algo in evaluated:
        line = line_of(algo, own, max(len(run.evaluations.step) for run in by_algo[algo]))
        _draw_curve(axes, learning_curve(by_algo[algo]), line | {"label": _legend(algo, by_algo[algo])})
    _label_axes(axes, "Evaluation return (mean ± standard error)")
    axes.set_title(fill(condition.label, 60))
    figure.legend(handles=legend_handles(axes, evaluated), loc="outside right upper", frameon=False)
    return save(figure, folder, condition.label.replace(", ", ","), formats)


@dataclass(frozen=True)
class _Curves:
    """The runs of one algorithm with the same settings, in a figure of training measures."""

    algo: str
    runs: list[Run]
    label: str
    style: str  # line style

    @property
    def measures(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for run in self.runs for name in run.training if name != "step"))


def _draw_training(
    task: str, by_settings: dict[str, dict[str, list[Run]]], own: Sequence[str], folder: Path, formats: Sequence[str]
) -> list[Path]:
    """Returns and training measures side by side: a row for each set of measures, a line style for each setting."""
    curves, common = _label_settings(by_settings)
    several = {curve.algo for curve in curves if sum(other.algo == curve.algo for other in curves) > 1}
    curves = [curve for curve in curves if curve.measures or curve.algo in several]
    # The order of the measures may differ: published runs have the order of their file.
    rows = list({frozenset(curve.measures): curve.measures for curve in curves}.values())
    if not rows:
        return []
    columns = 1 + max(map(len, rows))
    figure = Figure(figsize=(1.5 + 3.6 * columns, 1.0 + 3.2 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), columns, sharex=True, squeeze=False)
    for measures, (first, *others) in zip(rows, panels, strict=True):
        for curve in (curve for curve in curves if set(curve.measures) == set(measures)):
            points = max(len(run.evaluations.step) for run in curve.runs)
            line = line_of(curve.algo, own, points) | {"linestyle": curve.style}
            _draw_curve(first, learning_curve(curve.runs), line | {"label": curve.label})
            for axes, measure in zip(others, measures, strict=False):
                points_of = [
                    (run.training["step"], run.training[measure]) for run in curve.runs if measure in run.training
                ]
                _draw_curve(axes, mean_curve(points_of), line)
        _label_axes(first, "Evaluation return")
        for axes, measure in zip(others, measures, strict=False):
            _label_measure(axes, measure)
        for axes in others[len(measures) :]:
            axes.remove()
        for axes in (first, *others[: len(measures)]):
            axes.tick_params(labelbottom=True)  # sharex labels only the last row, which may lack a panel
    panels[0][0].autoscale(axis="x")  # all panels share this axis, but only the first row had set its end
    panels[0][0].set_xlim(left=0)
    figure.suptitle(fill(", ".join([f"{task} (mean ± standard error)", *common]), 110))
    longest = max(len(curve.label) for curve in curves)
    figure.legend(loc="outside lower center", ncols=max(1, min(len(curves), 100 // (longest + 8))), frameon=False)
    return save(figure, folder, f"{task}-training", formats)


def _label_settings(by_settings: dict[str, dict[str, list[Run]]]) -> tuple[list[_Curves], list[str]]:
    """The curves of a task, and the settings that all of them share.

    A label names the settings that not all curves share. If an algorithm has runs with several values of a setting, the
    label names the default value too.
    """
    words = {settings: dict.fromkeys(filter(None, settings.split(", "))) for settings in by_settings}
    common = [word for word in next(iter(words.values())) if all(word in others for others in words.values())]
    curves = []
    for (settings, by_algo), style in zip(by_settings.items(), cycle(LINE_STYLES), strict=False):
        for algo in order_algos(by_algo):
            runs = by_algo[algo]
            own_words = [word for word in words[settings] if word not in common]
            varied = {word.partition("=")[0] for other in words if algo in by_settings[other] for word in words[other]}
            named = {word.partition("=")[0] for word in words[settings]}
            default = [key for key in sorted(varied - named) if key in runs[0].config]
            own_words += [f"{key}={setting_text(runs[0].config[key])}" for key in default]
            curves.append(_Curves(algo, runs, ", ".join([_legend(algo, runs), *own_words]), style))
    return curves, common


def _draw_curve(axes: Axes, curve: tuple[np.ndarray, np.ndarray, np.ndarray], line: Mapping[str, Any]) -> None:
    steps, mean, error = curve
    axes.plot(steps, mean, **line)
    axes.fill_between(steps, mean - error, mean + error, color=line["color"], alpha=0.15, lw=0)


def _label_measure(axes: Axes, measure: str) -> None:
    _label_axes(axes, measure.replace("_", " ").capitalize())
    if measure in LOGARITHMIC:
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter("{x:g}")


def _label_axes(axes: Axes, quantity: str) -> None:
    axes.set_xlabel("Environment steps")
    axes.set_ylabel(quantity)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    plain(axes)


def _legend(algo: str, runs: Sequence[Run]) -> str:
    """The name of `algo`, with a dagger as in the tables and with notes on unfinished and diverged seeds."""
    finished, failed = sum(run.finished for run in runs), sum(bool(run.failure) for run in runs)
    name, notes = algo + DAGGER * bool(count_diverged(runs)), []
    if finished + failed < len(runs):
        notes.append(f"{finished} of {len(runs)} seed{'s' * (len(runs) > 1)} finished")
    elif len(runs) != PAPER_SEEDS:
        notes.append(f"n={len(runs)}")
    if failed:
        notes.append(f"{failed} of {len(runs)} diverged")
    return f"{name} ({', '.join(notes)})" if notes else name
