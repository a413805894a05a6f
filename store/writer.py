"""Writes the folder of one run while it trains. store/folder.py describes the files in it."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from store.files import replace_file
from store.folder import is_finished, last_evaluated, read_evaluations
from store.info import read_info
from store.loggers import Loggers

TABLES = ("evaluations.csv", "training.csv")
"""The files that grow with the training."""


class RunWriter:
    """Writes the folder of one run, that is, of one seed.

    An existing folder is moved aside to `<folder>.old-<i>`. If it holds a finished run, FileExistsError is raised
    unless `replace_finished` is true. `resume` continues an unfinished run instead.
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
        first = read_info(writer.folder)  # empty if it is lost: the training does not depend on it
        writer._save_info(first | {"resumed": [*first.get("resumed", []), dict(info)]})
        writer._save_config()
        writer._save_definition(definition)
        return writer

    def tables(self) -> dict[str, str]:
        """The text of evaluations.csv and training.csv as they are now."""
        return {name: path.read_text() for name in TABLES if (path := self.folder / name).exists()}

    def restore_tables(self, tables: Mapping[str, str]) -> None:
        """Put the text of `tables` back, without the rows written since."""
        for name in TABLES:
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
        evaluations = read_evaluations(self.folder)
        finite = np.isfinite(evaluations.return_mean).nonzero()[0]
        if not len(finite):
            return None
        last = finite[-1]
        return {"step": int(evaluations.step[last]), "return_mean": float(evaluations.return_mean[last])}

    def _append(self, name: str, row: Sequence[str]) -> None:
        # One write per line: a simultaneous reader sees the whole line, or a part of it without the line end.
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

        body = io.BytesIO()  # on a full disk, torch.save would hide the OSError behind one of its own
        torch.save(dict(state_dict), body)
        replace_file(self.folder / f"{name}.pt", lambda file: file.write(body.getbuffer()))

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
