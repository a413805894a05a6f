"""Published runs: the runs of a task in three files that people can read, without parameters and checkpoints.

    docs/data/<task>/
        runs.csv            one row per run: algo, variant, seed, state, return_mean, best_step, commit, and, as JSON,
                            the content of config.yaml, info.json and result.json (or failed.json) in its folder
        evaluations.csv.gz  algo, variant, seed, then the columns of the runs' evaluations.csv
        training.csv.gz     algo, variant, seed, then the columns of the runs' training.csv; missing if no run has one

`variant` is the name of the run's folder in results/ (store/folder.py). `state` is "finished", "failed" for a run that
diverged, or "stopped" for one that was not trained to its end. A run without a value in some column has an empty
field there. Numbers have all their digits, so that a published run equals its folder in every bit.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import math
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from store.files import one_line, replace_file
from store.folder import Evaluations, Run, parse_variant

RUNS, EVALUATIONS, TRAINING = "runs.csv", "evaluations.csv.gz", "training.csv.gz"
KEY = ("algo", "variant", "seed")
"""The first columns of each file, which identify a run of a task."""

Key = tuple[str, str, int]
T = TypeVar("T")


@dataclass(frozen=True)
class PublishedRun:
    """A run with its provenance."""

    run: Run
    info: Mapping[str, Any]
    """The content of its info.json."""

    @property
    def key(self) -> Key:
        return self.run.algo, self.run.variant, self.run.seed

    @property
    def state(self) -> str:
        return "finished" if self.run.result else "failed" if self.run.failure else "stopped"

    def row(self) -> dict[str, Any]:
        """Its row of runs.csv."""
        end = self.run.result or self.run.failure or {}
        # A run that diverged has the result of its best parameters, unless that evaluation failed too.
        result = end.get("result") if self.run.failure else end
        result = result if isinstance(result, dict) else {}
        return {
            **dict(zip(KEY, self.key, strict=True)),
            "state": self.state,
            "return_mean": result.get("return_mean"),
            "best_step": result.get("best_step"),
            "commit": self.info.get("commit"),
            "config": json.dumps(self.run.config),
            "info": json.dumps(dict(self.info)),
            "end": json.dumps(end),
        }


def published_cells(root: str | Path) -> list[tuple[str, str]]:
    """Task and algorithm of every run in `root`."""
    cells = ((folder.name, row["algo"]) for folder in _task_folders(root) for row in _read_table(folder / RUNS))
    return list(dict.fromkeys(cells))


def read_published(
    root: str | Path, tasks: Collection[str] | None = None, algos: Collection[str] | None = None
) -> list[PublishedRun]:
    """The runs in `root`, of the given tasks and algorithms. Raises a ValueError that names a corrupt file."""
    runs = []
    for folder in _task_folders(root):
        if tasks is None or folder.name in tasks:
            runs += [run for run in _read_task(folder) if algos is None or run.run.algo in algos]
    return runs


def write_published(folder: str | Path, runs: Iterable[PublishedRun]) -> None:
    """Replace the files in a task's `folder` by the files of `runs`."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    runs = sorted(runs, key=lambda run: run.key)
    # runs.csv comes last: it lists what the other files must hold.
    _write_table(folder / EVALUATIONS, [row for run in runs for row in _evaluation_rows(run)])
    if training := [row for run in runs for row in _training_rows(run)]:
        _write_table(folder / TRAINING, training)
    else:
        (folder / TRAINING).unlink(missing_ok=True)
    _write_table(folder / RUNS, [run.row() for run in runs])


def _evaluation_rows(run: PublishedRun) -> list[dict[str, Any]]:
    table = run.run.evaluations
    return [
        dict(zip(KEY, run.key, strict=True))
        | {"step": int(step), "return_mean": float(mean)}
        | {f"return_{k + 1}": float(value) for k, value in enumerate(returns)}
        | {"seconds": float(seconds)}
        for step, mean, returns, seconds in zip(*table, strict=True)
    ]


def _training_rows(run: PublishedRun) -> list[dict[str, Any]]:
    columns = run.run.training
    return [
        dict(zip(KEY, run.key, strict=True))
        | {"step": int(values[0])}
        | dict(zip(list(columns)[1:], map(float, values[1:]), strict=True))
        for values in zip(*columns.values(), strict=True)
    ]


def _task_folders(root: str | Path) -> list[Path]:
    """The folders in `root` with published runs, even if a file is missing; reading then raises an error."""
    names = (RUNS, EVALUATIONS, TRAINING)
    return sorted({path.parent for name in names for path in Path(root).glob(f"*/{name}")})


def _read_task(folder: Path) -> list[PublishedRun]:
    evaluations = _by_run(folder / EVALUATIONS, _evaluations)
    training = _by_run(folder / TRAINING, _columns)
    runs: dict[Key, PublishedRun] = {}
    for row in _read_table(folder / RUNS):
        key = algo, variant, seed = _key(row)
        with _named(f"{folder / RUNS}: {' '.join(map(str, key))}"):
            if key in runs:
                raise ValueError("it has two rows")
            config, info, end = (json.loads(row[column]) for column in ("config", "info", "end"))
            run = Run(
                folder=folder / variant / f"seed={seed}",
                task=folder.name,
                algo=algo,
                variant=variant,
                overrides=parse_variant(str(config.get("variant", variant)))[1],
                seed=seed,
                config=config,
                evaluations=evaluations.get(key) or _evaluations([]),
                training=training.get(key, {}),
                result=end if end and "quantity" not in end else None,
                failure=end if "quantity" in end else None,
            )
            runs[key] = PublishedRun(run, info)
            derived = runs[key].row()
            for name in ("state", "return_mean", "best_step", "commit"):
                if row[name] != (text := str(_text(derived[name]))):
                    raise ValueError(f"{name} is {row[name]!r}, but the columns info and end say {text!r}")
            if config["env"] != folder.name:
                raise ValueError(f"its task is {config['env']}")
        with _named(f"{folder / EVALUATIONS}: {' '.join(map(str, key))}"):
            check_evaluations(run)
    for name, by_run in ((EVALUATIONS, evaluations), (TRAINING, training)):
        for key in by_run:
            if key not in runs:
                raise ValueError(f"{folder / name}: {' '.join(map(str, key))} is not in {RUNS}")
    return list(runs.values())


def check_evaluations(run: Run) -> None:
    """Raise a ValueError if the evaluations of a finished run do not reach the end of its training."""
    steps = run.evaluations.step
    if run.result and (not len(steps) or steps[-1] != run.result["steps"]):
        raise ValueError(f"its evaluations do not reach step {run.result['steps']}")


@contextmanager
def _named(place: str) -> Iterator[None]:
    """Turn an error that a corrupt file causes into a ValueError that names the `place`."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{place}: no column {error.args[0]}") from error
    except (OSError, EOFError, zlib.error, csv.Error, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{place}: {one_line(error)}") from error


def _key(row: Mapping[str, str]) -> Key:
    return row["algo"], row["variant"], int(row["seed"])


def _by_run(path: Path, parse: Callable[[list[dict[str, str]]], T]) -> dict[Key, T]:
    """Apply `parse` to the rows of each run in the file `path`. A missing file counts as empty."""
    by_run: dict[Key, list[dict[str, str]]] = defaultdict(list)
    for row in _read_table(path) if path.exists() else []:
        by_run[_key(row)].append(row)
    with _named(str(path)):
        return {key: parse(rows) for key, rows in by_run.items()}


def _columns(rows: Sequence[Mapping[str, str]]) -> dict[str, np.ndarray]:
    """The columns of a run's rows, without `KEY` and columns that are empty in the first row."""
    names = [name for name, text in rows[0].items() if text and name not in KEY] if rows else []
    return {name: np.array([float(row[name]) for row in rows]) for name in names}


def _evaluations(rows: Sequence[Mapping[str, str]]) -> Evaluations:
    columns = _columns(rows)
    if not columns:
        return Evaluations(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 0)), np.zeros(0))
    returns = [values for name, values in columns.items() if name.startswith("return_") and name != "return_mean"]
    return Evaluations(
        columns["step"].astype(np.int64), columns["return_mean"], np.stack(returns, -1), columns["seconds"]
    )


def _read_table(path: Path) -> list[dict[str, str]]:
    with _named(str(path)):
        text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        reader = csv.DictReader(io.StringIO(text.decode(), newline=""))
        if not reader.fieldnames:
            raise ValueError("it has no header")
        rows = []
        for row in reader:
            if None in row or None in row.values():
                raise ValueError(f"line {reader.line_num} does not have as many fields as the header")
            _key(row)
            rows.append(row)
    return rows


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    columns = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(columns), lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows({name: _text(value) for name, value in row.items()} for row in rows)
    content = text.getvalue().encode()
    # Without a time in the header, the same runs give the same file.
    replace_file(path, lambda file: file.write(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content))


def _text(value: Any) -> Any:
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(value)
    return "" if value is None else value
