"""Results from several sources side by side: folders of results, published runs, and CSV files of other programs.

A CSV file has a row for each evaluation of a run, with at least these columns:

    task,algorithm,seed,step,return
    R+L2,Mine,0,5000,3.25
    R+L2,Mine,0,10000,7.5

`step` counts environment steps, `return` is the mean return of the evaluation. The return at a run's last step is its
result in the tables. Other columns are ignored. Any names are allowed. Results with the name of one of the project's
tasks or the paper's algorithms appear beside the project's and the paper's own.

If a source has a label, its algorithms are named `<algorithm> (<label>)`.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from core.words import ConfigError
from plots.paper import labelled
from store.files import one_line, user_path
from store.folder import Evaluations, Run, find_runs, parse_variant, read_results
from store.published import published_cells, read_published

COLUMNS = ("task", "algorithm", "seed", "step", "return")
T = TypeVar("T")
RESERVED = "paper"
"""The label of the paper's own columns."""


class Source(NamedTuple):
    """A folder or a CSV file with runs. Without a label, the names of algorithms stay as they are."""

    path: Path
    label: str


def parse_sources(words: Sequence[str]) -> list[Source]:
    """The sources that words `PATH` or `PATH=LABEL` name.

    Every source but the first has a label: the given one or, by default, the name of the folder or file. Raises
    ConfigError for an invalid label and for two equal labels.
    """
    sources: list[Source] = []
    for word in words:
        path, label = user_path(word), None
        if "=" in word and not path.exists():  # the path of a run contains "=", too
            text, _, label = word.rpartition("=")
            path = user_path(text)
        elif sources:
            label = path.resolve().stem if path.is_file() else path.resolve().name
        if label is not None and (label == RESERVED or not re.fullmatch(r"[^\s()]([^()]*[^\s()])?", label)):
            raise ConfigError(
                f"bad label {label!r} for {path}: expected PATH=LABEL with a label that is not empty, has no"
                f" parentheses and no spaces at its ends, and is not {RESERVED!r}"
            )
        if label and label in (source.label for source in sources):
            raise ConfigError(f"two folders have the label {label!r}: give {path} another one with {path}=LABEL")
        sources.append(Source(path, label or ""))
    return sources


def cells_in(path: Path) -> list[tuple[str, str]]:
    """Task and algorithm (without label) of every run in a folder or CSV file. Raises ConfigError if there is none."""
    cells = [(folder.parent.parent.name, parse_variant(folder.parent.name)[0]) for folder in find_runs(path)]
    cells += _published(lambda: published_cells(path))
    runs, problems = _read_files(path)
    cells += [(run.task, run.algo) for run in runs]
    if not cells:
        looked = f"<task>/<algorithm>/seed=<n>, <task>/runs.csv and *.csv with {','.join(COLUMNS)}"
        raise ConfigError(next(iter(problems), f"no runs in {path} (looked for {looked})"))
    return cells


def read_source(source: Source, tasks: Collection[str], algos: Collection[str]) -> tuple[list[Run], list[str]]:
    """The runs of these tasks and algorithms (without label) in a source, and a line for each unreadable one."""
    runs, problems = read_results(source.path, tasks, algos)
    runs += [published.run for published in _published(lambda: read_published(source.path, tasks, algos))]
    more, unreadable = _read_files(source.path)
    runs += [run for run in more if run.task in tasks and run.algo in algos]
    return [replace(run, algo=labelled(run.algo, source.label)) for run in runs], problems + unreadable


def _published(read: Callable[[], list[T]]) -> list[T]:
    """Return what `read` returns. Raises ConfigError for a corrupt file."""
    try:
        return read()
    except ValueError as error:
        raise ConfigError(one_line(error)) from error


def _read_files(path: Path) -> tuple[list[Run], list[str]]:
    """The runs in a CSV file, or in all CSV files of a folder, and a line for each file that cannot be read."""
    runs, problems = [], []
    for file in sorted(path.glob("*.csv")) if path.is_dir() else [path]:
        try:
            runs += read_csv(file)
        except ValueError as error:
            problems.append(str(error))
    return runs, problems


def read_csv(path: Path) -> list[Run]:
    """The runs in a CSV file. Raises a ValueError that names the file, the line and the bad value."""
    evaluations: dict[tuple[str, str, int], dict[int, float]] = {}
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if missing := [name for name in COLUMNS if name not in (reader.fieldnames or ())]:
                raise ValueError(f"no column {', '.join(missing)} (expected {','.join(COLUMNS)})")
            for row in reader:
                task, algo, seed, step, value = _parse(row, reader.line_num)
                run = evaluations.setdefault((task, algo, seed), {})
                if step in run:
                    raise ValueError(f"line {reader.line_num}: {algo} on {task}, seed {seed}, has step {step} twice")
                run[step] = value
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{path}: {one_line(error)}") from error
    return [_run(path, *key, returns) for key, returns in evaluations.items()]


def _parse(row: dict[str, str | None], line: int) -> tuple[str, str, int, int, float]:
    """The values of a row in the columns COLUMNS. Raises ValueError for a bad value."""
    task, algo, *numbers = ((row[name] or "").strip() for name in COLUMNS)
    for name, text in (("task", task), ("algorithm", algo)):
        if not text:
            raise ValueError(f"line {line}: {name} is empty")
    for name, text in zip(COLUMNS[2:4], numbers[:2], strict=True):
        if not re.fullmatch(r"\d{1,15}", text, re.ASCII):
            raise ValueError(f"line {line}: bad value {text!r} for {name}: expected a whole number of at least 0")
    try:
        value = float(numbers[2])
    except ValueError:
        raise ValueError(f"line {line}: bad value {numbers[2]!r} for return: expected a number") from None
    return task, algo, int(numbers[0]), int(numbers[1]), value


def _run(path: Path, task: str, algo: str, seed: int, returns: dict[int, float]) -> Run:
    steps = np.array(sorted(returns), dtype=np.int64)
    means = np.array([returns[step] for step in steps.tolist()])
    return Run(
        folder=path,
        task=task,
        algo=algo,
        variant=algo,
        overrides={},
        seed=seed,
        config={},
        evaluations=Evaluations(steps, means, means[:, None], np.full(len(steps), np.nan)),
        training={},
        result={"return_mean": float(means[-1])},
    )
