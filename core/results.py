"""Run folders: the one place that knows how a run is laid out on disk.

    results/<task>/<variant>/seed=<n>/
        config.yaml      the resolved configuration
        info.json        versions, git commit, command line, start time
        evaluations.csv  step,return_mean,return_1,...,return_k,seconds: one row an evaluation, appended
        training.csv     step and the algorithm's own measures (SAC: temperature, entropy), from the first update on
        best.pt last.pt  state dicts
        result.json      the final evaluation; written last, so its presence means that the run is finished

`<variant>` is the algorithm's name followed by `,key=value` for each setting that differs from the paper's
(`DPre+`, `SRad,learning_starts=10000,steps=50000`). Folders moved aside are called `seed=<n>.old-<i>`;
readers ignore them, and nothing here deletes a run.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib import metadata
from operator import methodcaller
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import yaml

_PACKAGES = ("torch", "numpy", "scipy", "gymnasium", "mujoco", "pybullet", "omegaconf")
# libyaml's loader is some ten times faster, which counts with two thousand runs; not every wheel has it.
_YamlLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def variant_name(algo: str, overrides: Mapping[str, Any]) -> str:
    """The folder name of `algo` with the settings `overrides`, sorted by key."""
    values = {
        key: value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        for key, value in sorted(overrides.items())
    }
    return ",".join([algo, *(f"{key}={value}" for key, value in values.items())])


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
    """Whether the run in `folder` came to its end and has its result."""
    return Path(folder, "result.json").is_file()


def describe_environment(command: Sequence[str]) -> dict[str, Any]:
    """What `info.json` says: versions, git commit, command line, start time; no path of this machine."""
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    described = _git_describe()
    return {
        "versions": versions,
        "commit": described and described.removesuffix("-dirty"),
        "dirty": described and described.endswith("-dirty"),
        # Absolute paths, alone or after `key=`, are cut to their last part.
        "command": shlex.join(re.sub(r"(^|=)/.*/(?=.)", r"\1", word) for word in command),
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }


def _git_describe() -> str | None:
    """The commit of this code, plus `-dirty` if tracked files are changed; None outside a repository."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.strip()

    try:
        # Installed into an environment that lies in another repository, this file is not that repository's.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return None


class RunWriter:
    """Writes the folder of one run, one seed.

    A folder already there is moved aside to `<folder>.old-<i>`; a finished run only with `replace_finished`,
    FileExistsError otherwise.
    """

    def __init__(
        self,
        folder: str | Path,
        config: Mapping[str, Any],
        info: Mapping[str, Any],
        eval_episodes: int,
        replace_finished: bool = False,
    ):
        self.folder = Path(folder)
        self.eval_episodes = eval_episodes
        if self.folder.exists():
            if is_finished(self.folder) and not replace_finished:
                raise FileExistsError(f"{self.folder} holds a finished run")
            _move_aside(self.folder)
        self.folder.mkdir(parents=True)
        columns = ["step", "return_mean", *(f"return_{i + 1}" for i in range(eval_episodes)), "seconds"]
        (self.folder / "evaluations.csv").write_text(",".join(columns) + "\n")
        (self.folder / "info.json").write_text(json.dumps(info, indent=2) + "\n")
        (self.folder / "config.yaml").write_text(yaml.safe_dump(dict(config), sort_keys=False))

    def append_evaluation(self, step: int, returns: Sequence[float] | np.ndarray, seconds: float) -> None:
        """Append the `returns` (eval_episodes,) at environment step `step`, `seconds` after the start."""
        values = np.asarray(returns, dtype=np.float64)
        if values.shape != (self.eval_episodes,):
            raise ValueError(f"an evaluation has {self.eval_episodes} returns, got shape {values.shape}")
        row = [str(int(step)), *(repr(float(x)) for x in (values.mean(), *values)), f"{seconds:.2f}"]
        self._append("evaluations.csv", row)

    def append_statistics(self, step: int, values: Mapping[str, float]) -> None:
        """Append the algorithm's measures at environment step `step`; their names are the same at every call."""
        if not (self.folder / "training.csv").exists():
            self._append("training.csv", ["step", *values])
        self._append("training.csv", [str(int(step)), *(repr(float(value)) for value in values.values())])

    def _append(self, name: str, row: Sequence[str]) -> None:
        # One write of one line: a reader meanwhile sees it whole, or without its line end.
        with open(self.folder / name, "a") as file:
            file.write(",".join(row) + "\n")

    def save_parameters(self, name: str, state_dict: Mapping[str, Any]) -> None:
        """Replace `best.pt` or `last.pt` (`name` "best" or "last") in one step."""
        if name not in ("best", "last"):
            raise ValueError(f"parameters are saved as 'best' or 'last', not {name!r}")
        import torch  # here alone: reading results needs no torch

        _replace(self.folder / f"{name}.pt", lambda file: torch.save(dict(state_dict), file))

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write `result.json`, which marks the run as finished. Arrays become lists of numbers."""
        text = json.dumps(result, indent=2, default=methodcaller("tolist")) + "\n"
        _replace(self.folder / "result.json", lambda file: file.write(text.encode()))


def _move_aside(folder: Path) -> None:
    number = 1
    while (target := folder.with_name(f"{folder.name}.old-{number}")).exists():
        number += 1
    folder.rename(target)


def _replace(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write a file so that `path` holds the old content or all of the new, whenever the process dies."""
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


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

    @property
    def finished(self) -> bool:
        return self.result is not None


def find_runs(root: str | Path) -> list[Path]:
    """All run folders below `root`, finished or not, without those moved aside."""
    folders = Path(root).glob("*/*/seed=*")
    return sorted(folder for folder in folders if re.fullmatch(r"seed=\d+", folder.name) and folder.is_dir())


def read_run(folder: str | Path) -> Run:
    """Read a run, also one in progress. Raises ValueError that names the file which is missing or corrupt."""
    folder = Path(folder)
    variant = folder.parent.name
    algo, overrides = parse_variant(variant)
    result = None
    if is_finished(folder):
        result = _parse(folder / "result.json", json.loads)
        if not isinstance(result.get("return_mean"), (int, float)):
            raise ValueError(f"{folder / 'result.json'}: no return_mean")
    return Run(
        folder=folder,
        task=folder.parent.parent.name,
        algo=algo,
        variant=variant,
        overrides=overrides,
        seed=int(folder.name.removeprefix("seed=")),
        config=_parse(folder / "config.yaml", lambda text: yaml.load(text, _YamlLoader)),
        evaluations=_read_evaluations(folder / "evaluations.csv"),
        training=_read_training(folder / "training.csv"),
        result=result,
    )


def read_results(
    root: str | Path, tasks: Collection[str] | None = None, algos: Collection[str] | None = None
) -> tuple[list[Run], list[str]]:
    """All readable runs below `root` (of the given tasks and algorithms), and a line for each that is not."""
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


def _parse(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    try:
        content = parse(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: {_reason(error)}") from error
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
    if columns == [""]:  # made at this moment, its header not written yet
        return {}
    if columns[0] != "step":
        raise ValueError(f"{path}: not the header of a training file")
    return dict(zip(columns, table.T, strict=True))


def _read_rows(path: Path) -> tuple[list[str], np.ndarray]:
    """The header of a CSV file of numbers, and its rows (n, columns)."""
    try:
        header, *lines = path.read_text().split("\n")
        columns = header.split(",")
        # What follows the last line end is empty, or a row being written at this moment.
        rows = [[float(x) for x in line.split(",")] for line in lines[:-1]]
        if any(len(row) != len(columns) for row in rows):
            raise ValueError("a row does not have the header's number of columns")
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: {_reason(error)}") from error
    return columns, np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def _reason(error: Exception) -> str:
    """One line for the user."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return " ".join(str(error).split())
