"""Tables and figures of the aggregates over tasks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from plots.grouping import DAGGER, Groups, all_with, count_diverged, settings_without, shared_settings
from plots.paper import first_beyond, order_algos
from plots.statistics import (
    CONFIDENCE,
    Estimate,
    Scores,
    comparable,
    interquartile_mean,
    normalised_scores,
    performance_profile,
    probability_of_improvement,
)
from plots.style import color_of, legend_handles, line_of, plain, save
from tables import MISSING, Table, TableCell, text_cells

INTERVAL = f"{100 * CONFIDENCE:.0f} % interval"


@dataclass(frozen=True)
class Aggregates:
    """The aggregates of one combination of settings."""

    settings: str
    scores: Scores
    means: dict[str, Estimate]
    improvements: dict[tuple[str, str], Estimate]
    """Probability that the first algorithm beats the second, for pairs with common tasks."""
    diverged: set[str]
    """Algorithms with diverged seeds that count with their best parameters before."""

    def label(self, algo: str) -> str:
        """The name of `algo`, with a dagger if seeds diverged."""
        return algo + DAGGER * (algo in self.diverged)


def aggregate(groups: Groups) -> list[Aggregates]:
    """The aggregates of each combination of settings."""
    result = []
    for settings, scores in normalised_scores(groups).items():
        improvements: dict[tuple[str, str], Estimate] = {}
        for first, second in permutations(scores, 2):
            if (second, first) in improvements:
                value, low, high = improvements[second, first]
                improvements[first, second] = Estimate(1 - value, 1 - high, 1 - low)
            elif scores[first].keys() & scores[second].keys():
                improvements[first, second] = probability_of_improvement(scores[first], scores[second])
        means = {algo: interquartile_mean(by_task) for algo, by_task in scores.items()}
        diverged = {
            algo
            for condition, by_algo in groups.items()
            for algo, runs in by_algo.items()
            if condition.settings == settings and condition.task in scores.get(algo, {}) and count_diverged(runs)
        }
        result.append(Aggregates(settings, scores, means, improvements, diverged))
    return result


def mean_table(aggregates: Sequence[Aggregates]) -> Table:
    """Interquartile means. Each section has the algorithms with scores on the same tasks."""
    shared = shared_settings(aggregate.settings for aggregate in aggregates)
    sections, records = [], []
    for aggregate in aggregates:
        for tasks, algos in comparable(aggregate.scores).items():
            rows: list[list[TableCell]] = []
            for algo in algos:
                runs = sum(len(values) for values in aggregate.scores[algo].values())
                value, low, high = (float(x) for x in aggregate.means[algo])
                label = ", ".join(filter(None, (" ".join(tasks), settings_without(aggregate.settings, shared))))
                texts = (
                    label if not rows else "",
                    aggregate.label(algo),
                    str(runs),
                    f"{value:.3f}",
                    f"{low:.3f} to {high:.3f}",
                )
                rows.append(text_cells(*texts))
                record = {"settings": aggregate.settings, "algo": algo, "tasks": " ".join(tasks), "runs": runs}
                records.append(record | {"interquartile_mean": value, "low": low, "high": high})
            sections.append(rows)
    title = "Aggregate over tasks: interquartile mean of the scores (1: best mean of the paper's row, 0: return 0)"
    title += all_with(shared)
    return Table("aggregate", title, ["Tasks", "Algorithm", "Runs", "IQM", INTERVAL], 2, sections, records)


def improvement_table(aggregates: Sequence[Aggregates]) -> Table:
    """The probability that the row's algorithm beats the column's, for each combination of settings."""
    aggregates = [aggregate for aggregate in aggregates if aggregate.improvements]
    algos = order_algos({algo for aggregate in aggregates for algo in aggregate.scores})
    shared = shared_settings(aggregate.settings for aggregate in aggregates)
    sections, records = [], []
    for aggregate in aggregates:
        rows: list[list[TableCell]] = []
        for first in aggregate.scores:
            cells = text_cells("" if rows else settings_without(aggregate.settings, shared), aggregate.label(first))
            for second in algos:
                estimate = aggregate.improvements.get((first, second))
                if estimate is None:
                    cells.append(TableCell((MISSING,), missing=True))
                    continue
                value, low, high = (float(x) for x in estimate)
                cells.append(TableCell((f"{value:.2f}",), bold=low > 0.5))
                tasks = len(aggregate.scores[first].keys() & aggregate.scores[second].keys())
                record: dict[str, Any] = {"settings": aggregate.settings, "algo": first, "over": second}
                records.append(record | {"tasks": tasks, "probability": value, "low": low, "high": high})
            rows.append(cells)
        sections.append(rows)
    title = (
        "Probability of improvement: a run of the row's algorithm is better than a run of the column's algorithm, "
        f"mean over their common tasks; bold if the {INTERVAL} is above 0.5{all_with(shared)}"
    )
    return Table("improvement", title, ["Settings", "Algorithm", *algos], 2, sections, records)


def draw_aggregates(
    aggregates: Sequence[Aggregates], own: Sequence[str], folder: Path, formats: Sequence[str]
) -> list[Path]:
    """Draw two figures for each combination of settings: interquartile means with profiles, and improvements.

    Returns the files. `own` as in `plots.style.color_of`.
    """
    written = []
    for aggregate in aggregates:
        suffix = f",{aggregate.settings.replace(', ', ',')}" if aggregate.settings else ""
        written += save(_mean_figure(aggregate, own), folder, f"aggregate{suffix}", formats)
        if aggregate.improvements:
            written += save(_improvement_figure(aggregate), folder, f"improvement{suffix}", formats)
    return written


def _mean_figure(aggregate: Aggregates, own: Sequence[str]) -> Figure:
    """A row of two panels for each set of tasks."""
    blocks = comparable(aggregate.scores)
    heights = [max(2.6, 1.2 + 0.28 * len(algos)) for algos in blocks.values()]
    figure = Figure(figsize=(10.0, sum(heights) + 0.4), layout="constrained")
    parts = figure.subfigures(len(blocks), 1, height_ratios=heights, squeeze=False)[:, 0]
    for part, (tasks, algos) in zip(parts, blocks.items(), strict=True):
        part.suptitle(" ".join(tasks), fontsize="medium")
        left, right = part.subplots(1, 2)
        finite = np.concatenate([values for algo in algos for values in aggregate.scores[algo].values()])
        finite = finite[np.isfinite(finite)]
        thresholds = np.linspace(finite.min(initial=0.0), finite.max(initial=1.0), 201)
        for i, algo in enumerate(algos):
            value, low, high = (float(x) for x in aggregate.means[algo])
            left.plot([low, high], [i, i], color=color_of(algo, own), linewidth=7, alpha=0.35, solid_capstyle="butt")
            left.plot(value, i, marker="|", markersize=13, markeredgewidth=2.5, color=color_of(algo, own))
            profile = performance_profile(aggregate.scores[algo], thresholds)
            right.plot(thresholds, profile.value, label=aggregate.label(algo), **line_of(algo, own, len(thresholds)))
            right.fill_between(thresholds, profile.low, profile.high, color=color_of(algo, own), alpha=0.12, lw=0)
        if place := first_beyond(algos):
            left.axhline(place - 0.5, color="gray", linewidth=0.8)
        left.set_yticks(range(len(algos)), [aggregate.label(algo) for algo in algos])
        left.set_ylim(len(algos) - 0.5, -0.5)
        left.set_xlabel(f"Interquartile mean of the scores, {INTERVAL}")
        right.set_xlabel("Score")
        right.set_ylabel("Runs above the score")
        right.set_ylim(0.0, 1.02)
        right.yaxis.set_major_formatter(PercentFormatter(1.0))
        handles = legend_handles(right, algos)
        right.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
        for axes in (left, right):
            plain(axes)
    figure.suptitle(", ".join(filter(None, ("Aggregate over tasks", aggregate.settings))))
    return figure


def _improvement_figure(aggregate: Aggregates) -> Figure:
    algos = list(aggregate.scores)
    size = 2.2 + 0.52 * len(algos)
    figure = Figure(figsize=(size + 0.8, size), layout="constrained")
    axes = figure.add_subplot()
    values = np.full((len(algos), len(algos)), math.nan)
    for i, first in enumerate(algos):
        for j, second in enumerate(algos):
            if (estimate := aggregate.improvements.get((first, second))) is None:
                continue
            values[i, j] = estimate.value
            weight = "bold" if estimate.low > 0.5 else "normal"
            dark = abs(estimate.value - 0.5) > 0.35
            axes.text(
                j,
                i,
                f"{estimate.value:.2f}",
                ha="center",
                va="center",
                fontsize="small",
                weight=weight,
                color="white" if dark else "black",
            )
    image = axes.imshow(values, vmin=0.0, vmax=1.0, cmap="RdBu")
    labels = [aggregate.label(algo) for algo in algos]
    axes.set_xticks(range(len(algos)), labels, rotation=90)
    axes.set_yticks(range(len(algos)), labels)
    axes.set_ylabel("a run of this algorithm ...")
    axes.set_xlabel("... is better than one of this")
    axes.spines[:].set_visible(False)
    figure.colorbar(image, shrink=0.7, label="Probability")
    figure.suptitle(", ".join(filter(None, ("Probability of improvement", aggregate.settings))))
    return figure
