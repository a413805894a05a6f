"""Run folders: the one place that knows how a run is laid out on disk.

    results/<task>/<variant>/seed=<n>/
        config.yaml      the resolved configuration
        definition.json  what the task and the algorithm stood for, as text; see store/definition.py
        info.json        versions, git commit, machine, threads, the command that ran, the words of the cell, the user's
                         own sources with their checksums, start time; again for each resumption
        evaluations.csv  step,return_mean,return_1,...,return_k,seconds: one row an evaluation, appended
        training.csv     step, the algorithm's own measures (losses, entropy, ...), and those of core/suggestions.py
        best.pt last.pt  state dicts
        result.json      the final evaluation; written last, so its presence means that the run is finished
        failed.json      instead of result.json if the run diverged: the step, what was not finite, last evaluation,
                         and as `result` the final evaluation of the best parameters before, where there are any
        checkpoint/      while the run is unfinished: see store/checkpoint.py (tensorboard/, wandb/: store/loggers.py)
    results/<task>/<variant>/seed=<n>.lock
                         while a process trains the run: its process id, host and Slurm job; see store/lock.py
    results/sweep/       logs and records of sweeps: see sweep/cells.py (results/flows/: see sweep/flows.py)

`<variant>` is the algorithm's name followed by `,key=value` for each setting that differs from the paper's
(`DPre+`, `SRad,learning_starts=10000,steps=50000`). Where that is longer than a file system allows, the folder is
called `SRad,settings=<checksum>`, and config.yaml has the whole text as `variant`. Folders moved aside are called
`seed=<n>.old-<i>`; readers ignore them, and nothing here deletes a run.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import methodcaller
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from store.files import one_line, replace_file
from store.loggers import Loggers

LONGEST_NAME = 255
"""Bytes in the name of a folder, at most."""
_TABLES = ("evaluations.csv", "training.csv")
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
    """The folder of `variant`: its name, or where that is too long for a file system, a short name with a checksum."""
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
            raise ValueError(f"{name!r} cannot name a run's folder: empty, or with a leading '.' or a '/'")
    return Path(root, task, variant, f"seed={seed}").expanduser()


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
        steps = _read_evaluations(Path(folder, "evaluations.csv")).step
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
    """The definition of the task and of the algorithm in the run in `folder`; None where it has none."""
    try:
        content = _parse(Path(folder, "definition.json"), json.loads)
        parts = {part: content[part].items() for part in ("task", "algorithm")}
        return {part: {key: str(text) for key, text in items} for part, items in parts.items()}
    except (ValueError, KeyError, AttributeError):
        return None


def lockstep_group(folder: str | Path) -> tuple[int, ...]:
    """The seeds that the run in `folder` started with, from its info.json; empty if they are not there."""
    try:
        return tuple(_parse(Path(folder, "info.json"), json.loads)["lockstep"])
    except (ValueError, KeyError, TypeError):
        return ()


class RunWriter:
    """Writes the folder of one run, one seed.

    An existing folder is moved aside to `<folder>.old-<i>`. For a finished run, that takes `replace_finished`;
    otherwise it raises FileExistsError. `resume` continues an unfinished run instead.
    """

    def __init__(
        self,
        folder: str | Path,
        config: Mapping[str, Any],
        info: Mapping[str, Any],
        eval_episodes: int,
        replace_finished: bool = False,
        definition: Mapping[str, Any] | None = None,
    ):
        self.folder, self.config = Path(folder), dict(config)
        self.eval_episodes, self.loggers = eval_episodes, Loggers(self.folder, self.config)
        if self.folder.exists():
            if is_finished(self.folder) and not replace_finished:
                raise FileExistsError(f"{self.folder} holds a finished run")
            _move_aside(self.folder)
        self.folder.mkdir(parents=True)
        columns = ["step", "return_mean", *(f"return_{i + 1}" for i in range(eval_episodes)), "seconds"]
        (self.folder / "evaluations.csv").write_text(",".join(columns) + "\n")
        self._save_info(info)
        self._save_config()
        self._save_definition(definition)

    @classmethod
    def resume(
        cls,
        folder: str | Path,
        config: Mapping[str, Any],
        info: Mapping[str, Any],
        eval_episodes: int,
        definition: Mapping[str, Any] | None = None,
    ) -> RunWriter:
        """The writer of a run that resumes. Adds `info` to info.json. The trainer calls `restore_tables`."""
        writer = cls.__new__(cls)
        writer.folder, writer.config, writer.eval_episodes = Path(folder), dict(config), eval_episodes
        writer.loggers = Loggers(writer.folder, writer.config)
        try:
            first = _parse(writer.folder / "info.json", json.loads)
        except ValueError:  # info.json informs people; the training does not depend on it
            first = {}
        writer._save_info(first | {"resumed": [*first.get("resumed", []), dict(info)]})
        writer._save_config()
        writer._save_definition(definition)
        return writer

    def tables(self) -> dict[str, str]:
        """The text of evaluations.csv and training.csv as they are now."""
        return {name: path.read_text() for name in _TABLES if (path := self.folder / name).exists()}

    def restore_tables(self, tables: Mapping[str, str]) -> None:
        """Put the text of `tables` back, without the rows written since."""
        for name in _TABLES:
            if name in tables:
                self._replace(name, tables[name])
            else:
                (self.folder / name).unlink(missing_ok=True)
        self.loggers.go_on_after(last_evaluated(self.folder))

    def _save_info(self, info: Mapping[str, Any]) -> None:
        self._replace("info.json", json.dumps(info, indent=2) + "\n")

    def _save_config(self) -> None:
        self._replace("config.yaml", yaml.safe_dump(self.config, sort_keys=False))

    def _save_definition(self, definition: Mapping[str, Any] | None) -> None:
        if definition is not None:
            self._replace("definition.json", json.dumps(definition, indent=2) + "\n")

    def _replace(self, name: str, text: str) -> None:
        replace_file(self.folder / name, lambda file: file.write(text.encode()))

    def append_evaluation(self, step: int, returns: Sequence[float] | np.ndarray, seconds: float) -> None:
        """Append the `returns` (eval_episodes,) at environment step `step`, `seconds` after the start."""
        values = np.asarray(returns, dtype=np.float64)
        if values.shape != (self.eval_episodes,):
            raise ValueError(f"an evaluation has {self.eval_episodes} returns, got shape {values.shape}")
        row = [str(int(step)), *(repr(float(x)) for x in (values.mean(), *values)), f"{seconds:.2f}"]
        self._append("evaluations.csv", row)
        self.loggers.log_evaluation(int(step), float(values.mean()), seconds)

    def append_statistics(self, step: int, values: Mapping[str, float]) -> None:
        """Append the algorithm's measures at environment step `step`. Their names are the same in every call."""
        if not (self.folder / "training.csv").exists():
            self._append("training.csv", ["step", *values])
        self._append("training.csv", [str(int(step)), *(repr(float(value)) for value in values.values())])
        self.loggers.log_training(int(step), values)

    def last_finite_evaluation(self) -> dict[str, float] | None:
        """Step and mean return of the last evaluation with a finite mean; None if there is none."""
        evaluations = _read_evaluations(self.folder / "evaluations.csv")
        finite = np.isfinite(evaluations.return_mean).nonzero()[0]
        if not len(finite):
            return None
        last = finite[-1]
        return {"step": int(evaluations.step[last]), "return_mean": float(evaluations.return_mean[last])}

    def _append(self, name: str, row: Sequence[str]) -> None:
        # One write for one line: a simultaneous reader sees it whole, or without its line end.
        path = self.folder / name
        try:
            with open(path, "a") as file:
                file.write(",".join(row) + "\n")
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from error

    def save_parameters(self, name: str, state_dict: Mapping[str, Any]) -> None:
        """Replace `best.pt` or `last.pt` (`name` "best" or "last") in one step."""
        if name not in ("best", "last"):
            raise ValueError(f"parameters are saved as 'best' or 'last', not {name!r}")
        import torch  # only here: reading results needs no torch

        replace_file(self.folder / f"{name}.pt", lambda file: torch.save(dict(state_dict), file))

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write `result.json`, which marks the run as finished. Arrays become lists of numbers."""
        if self.config.get("quick"):
            result = {**result, "quick": True}
        self._replace("result.json", json.dumps(result, indent=2, default=methodcaller("tolist")) + "\n")
        self.loggers.log_result(float(result["return_mean"]))

    def fail(self, record: Mapping[str, Any]) -> None:
        """Write `failed.json`, which marks the run as one that diverged."""
        self._replace("failed.json", json.dumps(record, indent=2) + "\n")


def _move_aside(folder: Path) -> None:
    number = 1
    while (target := folder.with_name(f"{folder.name}.old-{number}")).exists():
        number += 1
    folder.rename(target)


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
    """Columns of training.csv, each (m,), the first called `step`; empty where the run has none."""
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
        evaluations=_read_evaluations(folder / "evaluations.csv"),
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


def _read_evaluations(path: Path) -> Evaluations:
    columns, table = _read_rows(path)
    if len(columns) < 3 or (columns[0], columns[1], columns[-1]) != ("step", "return_mean", "seconds"):
        raise ValueError(f"{path}: not the header of an evaluations file")
    return Evaluations(table[:, 0].astype(np.int64), table[:, 1], table[:, 2:-1], table[:, -1])


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
