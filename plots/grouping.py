"""Groups runs whose configurations differ only in the seed."""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from core.config import RUN_KEYS
from plots.paper import Statistic, order_algos, order_tasks
from store.folder import Run, describe_failure


class Condition(NamedTuple):
    """A row of the tables: a task and the settings that differ from the paper's, as `key=value, ...`."""

    task: str
    settings: str

    @property
    def label(self) -> str:
        return self.label_without(())

    def label_without(self, shared: Collection[str]) -> str:
        """The label without the settings in `shared`."""
        return ", ".join(filter(None, (self.task, settings_without(self.settings, shared))))


DAGGER = "†"
"""Marks results that include diverged seeds. Such a seed counts with its best parameters before it diverged."""

Groups = dict[Condition, dict[str, list[Run]]]
"""Runs by condition and algorithm: the runs of a group differ only in the seed."""


@dataclass
class _Group:
    """Runs of one configuration by seed; `settings` are those that the label names."""

    task: str
    algo: str
    config: dict[str, str]
    settings: dict[str, str]
    runs: dict[int, Run]


def group_runs(runs: Iterable[Run]) -> tuple[Groups, list[str]]:
    """Group the runs that differ only in the seed, and list the runs that repeat another run's configuration and seed.

    Usually a run's folder name has all settings that differ from the paper's. If configurations with the same label
    differ in other settings (for example because a default changed between the runs), the labels name these too.
    """
    groups: dict[tuple, _Group] = {}
    repeated = []
    for run in runs:
        # A setting that the algorithm does not have is None, or missing if the run is older than the setting.
        settings = run.config.items()
        config = {key: setting_text(value) for key, value in settings if key not in RUN_KEYS and value is not None}
        key = run.task, run.algo, tuple(sorted(config.items()))
        group = groups.setdefault(key, _Group(run.task, run.algo, config, dict(run.overrides), {}))
        first = group.runs.setdefault(run.seed, run)
        if first is not run:
            repeated.append(f"{run.folder}: the same configuration and seed as {first.folder}")
    _tell_apart(list(groups.values()))
    result: Groups = defaultdict(dict)
    for group in groups.values():
        label = ", ".join(f"{key}={value}" for key, value in sorted(group.settings.items()))
        result[Condition(group.task, label)][group.algo] = [group.runs[seed] for seed in sorted(group.runs)]
    return dict(result), repeated


def _tell_apart(groups: Sequence[_Group]) -> None:
    """Add settings to groups of the same label until no two labels are the same."""
    while True:
        same_label = defaultdict(list)
        for group in groups:
            same_label[group.task, group.algo, tuple(sorted(group.settings.items()))].append(group)
        alike = [members for members in same_label.values() if len(members) > 1]
        if not alike:
            return
        for members in alike:
            for key in {key for member in members for key in member.config}:
                values = [member.config.get(key, setting_text(None)) for member in members]
                if len(set(values)) > 1:
                    for member, value in zip(members, values, strict=True):
                        member.settings[key] = value


def setting_text(value: Any) -> str:
    """The text of a setting's value in a label."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"), default=str)


def order_conditions(cells: Mapping[Condition, Collection[str]]) -> list[list[Condition]]:
    """Sections of rows, one for each combination of settings, in the order of `place_of_settings`.

    `cells` has the algorithms of each row.
    """
    by_settings: dict[str, list[str]] = defaultdict(list)
    count: Counter[str] = Counter()
    for (task, settings), algos in cells.items():
        by_settings[settings].append(task)
        count[settings] += len(algos)
    ordered = sorted(by_settings, key=lambda settings: place_of_settings(settings, count[settings]))
    return [[Condition(task, settings) for task in order_tasks(by_settings[settings])] for settings in ordered]


def place_of_settings(settings: str, cells: int) -> tuple[int, int, str]:
    """The sort key of a combination of settings: fewest settings first, then most cells."""
    return len(_split_settings(settings)), -cells, settings


def shared_settings(combinations: Iterable[str]) -> list[str]:
    """The settings that all of `combinations` have, sorted. A table names them once, in its title."""
    sets = [set(_split_settings(settings)) for settings in combinations]
    return sorted(set.intersection(*sets)) if sets else []


def settings_without(settings: str, shared: Collection[str]) -> str:
    """`settings` without those in `shared`."""
    return ", ".join(setting for setting in _split_settings(settings) if setting not in shared)


def all_with(shared: Sequence[str]) -> str:
    """The end of the title of a table whose runs all have the settings in `shared`."""
    return f"; all runs with {', '.join(shared)}" if shared else ""


def _split_settings(settings: str) -> list[str]:
    return settings.split(", ") if settings else []


def final_return(run: Run) -> float | None:
    """The final mean return of a run; None while it is unfinished.

    For a run that diverged, this is the return of its best parameters before, or NaN if it has no such parameters.
    """
    if run.failure:
        result = run.failure.get("result")
        return float(result["return_mean"]) if isinstance(result, dict) else math.nan
    return None if run.result is None else float(run.result["return_mean"])


def statistic(values: Sequence[float]) -> Statistic:
    array = np.asarray(values, dtype=np.float64)
    n = len(array)
    return Statistic(float(array.mean()), float(array.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan, n)


def reward_statistics(groups: Groups) -> dict[Condition, dict[str, Statistic]]:
    """Statistics over the finite results of each cell, without empty cells and rows."""
    statistics: dict[Condition, dict[str, Statistic]] = {}
    for condition, by_algo in groups.items():
        for algo, runs in by_algo.items():
            returns = [value for run in runs if (value := final_return(run)) is not None and math.isfinite(value)]
            if returns:
                statistics.setdefault(condition, {})[algo] = statistic(returns)
    return statistics


def list_left_out(groups: Groups) -> list[str]:
    """A line for each cell with runs that are in progress, were interrupted, or failed."""
    lines = []
    for condition in chain.from_iterable(order_conditions(groups)):
        for algo in order_algos(groups[condition]):
            runs = groups[condition][algo]
            if unfinished := [run for run in runs if final_return(run) is None]:
                reached = [run.evaluations.step.max(initial=0) for run in unfinished]
                span = " to ".join(f"{step:,}" for step in sorted({min(reached), max(reached)}))
                total = unfinished[0].config.get("steps")
                of = f" of {total:,}" if isinstance(total, int) else ""
                lines.append(f"{condition.label} {algo}: seed {_seeds(unfinished)}, evaluated to step {span}{of}")
            for run in runs:
                if run.failure and not math.isfinite(final_return(run)):
                    lines.append(f"{condition.label} {algo}: seed {run.seed} {describe_failure(run.failure)}")
            if failed := [run for run in runs if run.finished and not math.isfinite(final_return(run))]:
                lines.append(f"{condition.label} {algo}: seed {_seeds(failed)} failed, its return is not a number")
    return lines


def list_diverged(groups: Groups) -> list[str]:
    """A line for each cell with diverged seeds that count with their best parameters before."""
    lines = []
    for condition in chain.from_iterable(order_conditions(groups)):
        for algo in order_algos(groups[condition]):
            runs = groups[condition][algo]
            if count := count_diverged(runs):
                diverged = [run for run in runs if run.failure and math.isfinite(final_return(run))]
                which = "; ".join(f"seed {run.seed} {describe_failure(run.failure)}" for run in diverged)
                said = f"{count} of {len(runs)} seeds diverged and count with their best parameters before"
                lines.append(f"{condition.label} {algo}: {said}: {which}")
    return lines


def count_diverged(runs: Iterable[Run]) -> int:
    """How many of `runs` diverged but count, with their best parameters before."""
    return sum(bool(run.failure) and math.isfinite(final_return(run)) for run in runs)


def count_failed(runs: Iterable[Run]) -> int:
    """How many of `runs` have ended without a finite return."""
    returns = [final_return(run) for run in runs]
    return sum(value is not None and not math.isfinite(value) for value in returns)


def _seeds(runs: Iterable[Run]) -> str:
    return ", ".join(str(run.seed) for run in runs)
