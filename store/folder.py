"""Run folders: how a run is laid out on disk, and how to read it. store/writer.py writes one.

    results/<task>/<variant>/seed=<n>/
        config.yaml      the resolved configuration
        definition.json  the definitions of the task and the algorithm as text; see store/definition.py
        info.json        versions, git commit, machine, threads, the command that ran, the words of the cell, the user's
                         own sources with their checksums, start time; again for each resumption
        evaluations.csv  step,return_mean,return_1,...,return_k,seconds: one row per evaluation, appended
        training.csv     step, the algorithm's own measures (losses, entropy, ...), and those of core/suggestions.py
        best.pt last.pt  state dicts
        result.json      the final evaluation; written last, so its presence means that the run is finished
        failed.json      instead of result.json if the run diverged: the step, the reason as `quantity`, the last
                         finite evaluation, and as `result` the final evaluation of the best parameters, if any
        checkpoint/      while the run is unfinished: see store/checkpoint.py (tensorboard/, wandb/: store/loggers.py)
    results/<task>/<variant>/seed=<n>.lock
                         while a process trains the run: its process id, host and Slurm job; see store/lock.py
    results/sweep/       logs and records of sweeps: see sweep/cells.py (results/flows/: see sweep/flows.py)

`<variant>` is the algorithm's name followed by `,key=value` for each setting that differs from the paper's
(`DPre+`, `SRad,learning_starts=10000,steps=50000`). If that is longer than a file system allows, the folder is called
`SRad,settings=<checksum>`, and config.yaml has the whole text as `variant`. Folders moved aside are called
`seed=<n>.old-<i>`; readers ignore them, and nothing here deletes a run.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from store.files import one_line, user_path
from store.info import read_info

LONGEST_NAME = 255
"""The most bytes in the name of a folder."""
# libyaml's loader is some ten times faster, which matters for two thousand runs. Not every wheel has it.
_YamlLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def variant_name(algo: str, overrides: Mapping[str, Any]) -> str:
    """The folder name of `algo` with the settings `overrides`, sorted by key."""
    values = {
        key: value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        for key, value in sorted(overrides.items())
    }
    return ",".join([algo, *(f"{key}={value}" for key, value in values.items())])


def variant_folder(variant: str) -> str:
    """The folder of `variant`: its name, or, if that is too long for a file system, a short name with a checksum."""
    if len(os.fsencode(variant)) <= LONGEST_NAME:
        return variant
    digest = hashlib.sha256(variant.encode()).hexdigest()[:12]
    return f"{parse_variant(variant)[0]},settings={digest}"


def parse_variant(variant: str) -> tuple[str, dict[str, str]]:
    """Undo `variant_name`: the algorithm and its overrides, whose values stay text."""
    # A value may hold commas itself (a list), so only a comma before another `key=` separates.
    algo, *settings = re.split(r",(?=\w+=)", variant)
    return algo, dict(setting.split("=", 1) for setting in settings)


def run_folder(root: str | Path, task: str, variant: str, seed: int) -> Path:
    """`root/task/variant/seed=<seed>`. Raises ValueError if a name cannot be a folder's."""
    for name in (task, variant):
        if not name or name.startswith(".") or "/" in name or os.sep in name:
            raise ValueError(
                f"bad name {name!r} for a run's folder: it must not be empty, begin with '.' or contain '/'"
            )
    return user_path(root) / task / variant / f"seed={seed}"


def is_finished(folder: str | Path) -> bool:
    """Whether the run in `folder` has its result."""
    return Path(folder, "result.json").is_file()


def has_failed(folder: str | Path) -> bool:
    """Whether the run in `folder` ended because it diverged."""
    return Path(folder, "failed.json").is_file()


def has_ended(folder: str | Path) -> bool:
    """Whether the run in `folder` is finished or has failed."""
    return is_finished(folder) or has_failed(folder)


def last_evaluated(folder: str | Path) -> int:
    """The step of the last evaluation of the run in `folder`; 0 if there is none."""
    try:
        steps = read_evaluations(folder).step
    except ValueError:
        return 0
    return int(steps[-1]) if len(steps) else 0


def read_settings(folder: str | Path) -> dict[str, Any]:
    """The configuration of the run in `folder`; empty if it cannot be read."""
    try:
        return _parse(Path(folder, "config.yaml"), lambda text: yaml.load(text, _YamlLoader))
    except ValueError:
        return {}


def read_definition(folder: str | Path) -> dict[str, dict[str, str]] | None:
    """The definitions of the task and the algorithm of the run in `folder`; None if it has none."""
    try:
        content = _parse(Path(folder, "definition.json"), json.loads)
        parts = {part: content[part].items() for part in ("task", "algorithm")}
        return {part: {key: str(text) for key, text in items} for part, items in parts.items()}
    except (ValueError, KeyError, AttributeError):
        return None


def lockstep_group(folder: str | Path) -> tuple[int, ...]:
    """The seeds that the run in `folder` started with, from its info.json; empty if they are unknown."""
    try:
        return tuple(read_info(folder)["lockstep"])
    except (KeyError, TypeError):
        return ()


class Evaluations(NamedTuple):
    """The n evaluations of a run, of k episodes each."""

    step: np.ndarray  # (n,) int64, environment steps
    return_mean: np.ndarray  # (n,)
    returns: np.ndarray  # (n, k)
    seconds: np.ndarray  # (n,) since the start of the run


@dataclass(frozen=True)
class Run:
    """One seed's run as read from its folder."""

    folder: Path
    task: str
    algo: str
    variant: str
    overrides: dict[str, str]
    seed: int
    config: dict[str, Any]
    evaluations: Evaluations
    training: dict[str, np.ndarray]
    """Columns of training.csv, each (m,), the first called `step`; empty if the run has none."""
    result: dict[str, Any] | None
    failure: dict[str, Any] | None = None  # of a run that diverged: step, quantity, ...

    @property
    def finished(self) -> bool:
        return self.result is not None


def find_runs(root: str | Path) -> list[Path]:
    """All run folders below `root`, finished or not, without those moved aside."""
    folders = Path(root).glob("*/*/seed=*")
    return sorted(folder for folder in folders if re.fullmatch(r"seed=\d+", folder.name) and folder.is_dir())


def read_run(folder: str | Path) -> Run:
    """Read a run, finished or in progress. Raises a ValueError that names a missing or corrupt file."""
    folder = Path(folder)
    config = _parse(folder / "config.yaml", lambda text: yaml.load(text, _YamlLoader))
    algo, overrides = parse_variant(str(config.get("variant", folder.parent.name)))
    result = None
    if is_finished(folder):
        result = _parse(folder / "result.json", json.loads)
        if not isinstance(result.get("return_mean"), (int, float)):
            raise ValueError(f"{folder / 'result.json'}: no return_mean")
    failure = None
    if has_failed(folder):
        failure = _parse(folder / "failed.json", json.loads)
        if not {"step", "quantity"} <= failure.keys():
            raise ValueError(f"{folder / 'failed.json'}: no step or no quantity")
    return Run(
        folder=folder,
        task=folder.parent.parent.name,
        algo=algo,
        variant=folder.parent.name,
        overrides=overrides,
        seed=int(folder.name.removeprefix("seed=")),
        config=config,
        evaluations=read_evaluations(folder),
        training=_read_training(folder / "training.csv"),
        result=result,
        failure=failure,
    )


def read_results(
    root: str | Path, tasks: Collection[str] | None = None, algos: Collection[str] | None = None
) -> tuple[list[Run], list[str]]:
    """All readable runs below `root`, of the given tasks and algorithms, and a line for each unreadable one."""
    runs, problems = [], []
    for folder in find_runs(root):
        if tasks is not None and folder.parent.parent.name not in tasks:
            continue
        if algos is not None and parse_variant(folder.parent.name)[0] not in algos:
            continue
        try:
            runs.append(read_run(folder))
        except ValueError as error:
            problems.append(str(error))
    return runs, problems


def read_evaluations(folder: str | Path) -> Evaluations:
    """The evaluations of the run in `folder`. Raises a ValueError that names a missing or corrupt file."""
    path = Path(folder, "evaluations.csv")
    columns, table = _read_rows(path)
    if len(columns) < 3 or (columns[0], columns[1], columns[-1]) != ("step", "return_mean", "seconds"):
        raise ValueError(f"{path}: not the header of an evaluations file")
    return Evaluations(table[:, 0].astype(np.int64), table[:, 1], table[:, 2:-1], table[:, -1])


def describe_failure(failure: Mapping[str, Any]) -> str:
    """The content of `failed.json` in one line."""
    result = failure.get("result")
    before = f" (best parameters before: return {result['return_mean']:.2f})" if isinstance(result, dict) else ""
    return f"failed at step {failure['step']}: {failure['quantity']}{before}"


def _parse(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    try:
        content = parse(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: {one_line(error)}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: not a mapping")
    return content


def _read_training(path: Path) -> dict[str, np.ndarray]:
    if not path.exists():
        return {}
    columns, table = _read_rows(path)
    if columns == [""]:  # the writer has not written the header yet
        return {}
    if columns[0] != "step":
        raise ValueError(f"{path}: not the header of a training file")
    return dict(zip(columns, table.T, strict=True))


def _read_rows(path: Path) -> tuple[list[str], np.ndarray]:
    """The header of a CSV file of numbers, and its rows (n, columns)."""
    try:
        header, *lines = path.read_text().split("\n")
        columns = header.split(",")
        # The text after the last line end is empty, or a row that is being written.
        rows = [[float(x) for x in line.split(",")] for line in lines[:-1]]
        if any(len(row) != len(columns) for row in rows):
            raise ValueError("a row does not have the header's number of columns")
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: {one_line(error)}") from error
    return columns, np.array(rows, dtype=np.float64).reshape(-1, len(columns))
