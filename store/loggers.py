"""Loggers that receive a run's numbers besides its own files: TensorBoard and Weights & Biases.

    results/<task>/<variant>/seed=<n>/
        tensorboard/     event files, one more for each resumption
        wandb/           files of Weights & Biases; with WANDB_MODE=offline, the whole run
        wandb-id.txt     the run's id at Weights & Biases, which a resumption uses again

The trainer passes a run's numbers to its writer (store/writer.py), which passes them to the loggers. Loggers return
nothing. A logger that fails is reported once and left out, and the training continues.
"""

from __future__ import annotations

import math
import os
import sys
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from store.files import one_line, replace_file

CSV = "csv"
"""The run's own files, which are always written."""
PROJECT = "action-constrained-rl"
"""The project on Weights & Biases, unless WANDB_PROJECT names another."""


class LoggerError(Exception):
    """A logger cannot start: its package or a login is missing. The message is one line with the remedy."""


class Logger(Protocol):
    """Logs the numbers of one run. Steps never decrease. A method may raise any error."""

    @staticmethod
    def check() -> None:
        """Raise ImportError or LoggerError if it cannot start."""

    def log(self, step: int, values: Mapping[str, float]) -> None: ...

    def close(self) -> None: ...


class TensorBoard:
    """Writes event files. TensorBoard hides events of earlier processes from `first_step` on.

    PyTorch writes the files with the package `tensorboard`, which also shows them.
    """

    @staticmethod
    def check() -> None:
        import torch.utils.tensorboard  # noqa: F401

    def __init__(self, folder: Path, config: Mapping[str, Any], first_step: int):
        from torch.utils.tensorboard import SummaryWriter

        self.writer = SummaryWriter(folder / "tensorboard", purge_step=first_step)

    def log(self, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)
        self.writer.flush()

    def close(self) -> None:
        self.writer.close()


class WeightsAndBiases:
    """Logs each seed as a separate run. Weights & Biases itself ignores steps that it already has."""

    @staticmethod
    def check() -> None:
        import wandb

        try:
            wandb.login()  # may ask for the key in a terminal: before the training, not during it
        except wandb.Error as error:
            raise LoggerError(f"log=wandb: {one_line(error)} (WANDB_MODE=offline needs no login)") from error

    def __init__(self, folder: Path, config: Mapping[str, Any], first_step: int):
        import wandb

        path = folder / "wandb-id.txt"
        if not path.exists():
            replace_file(path, lambda file: file.write(uuid.uuid4().hex[:12].encode()))
        task, variant, seed = folder.absolute().parts[-3:]
        self.run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            id=path.read_text(),
            resume="allow",
            name=f"{task} {variant} {seed}",
            group=f"{task} {variant}",
            config=dict(config),
            dir=folder,
            reinit="create_new",  # several runs of one process are open together, one per seed
            settings=wandb.Settings(console="off", silent=True),
        )

    def log(self, step: int, values: Mapping[str, float]) -> None:
        self.run.log(dict(values), step=step)

    def close(self) -> None:
        self.run.finish()


LOGGERS: dict[str, Any] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}
"""Logger classes by the name of their package, which is also their name in `log`. The constructor takes the folder, the
settings and the first step of a run."""


def logger_names(text: str) -> list[str]:
    """The names of the loggers in a value of `log`, such as `csv,wandb`, without `csv`."""
    return [name for name in dict.fromkeys(text.split(",")) if name != CSV]


def check_loggers(names: Iterable[str]) -> None:
    """Raise LoggerError if a logger cannot start."""
    for name in names:
        try:
            LOGGERS[name].check()
        except ImportError as error:
            raise LoggerError(f"log={name} needs the package {name} ({one_line(error)}): pip install {name}") from error


class Loggers:
    """The loggers of the run in `folder`, whose settings are `config`. None of its methods raises an Exception."""

    def __init__(self, folder: Path, config: Mapping[str, Any]):
        self.folder, self.config = folder, config
        self.names = logger_names(config.get("log", CSV))
        self.open: dict[str, Logger] = {}
        self.first_step = 0
        self.last = 0, 0.0  # step and seconds of the last evaluation

    def go_on_after(self, step: int) -> None:
        """Continue the run after its last evaluation, which was at `step`."""
        self.first_step, self.last = step + 1, (step, math.nan)

    def log_evaluation(self, step: int, mean: float, seconds: float) -> None:
        """Log the mean return of an evaluation, and the speed since the previous evaluation in this process.

        `seconds` is the duration of the training so far.
        """
        before, self.last = self.last, (step, seconds)
        values = {"evaluation/return": mean}
        if seconds > before[1]:  # not for the first evaluation after a resumption
            values["speed/steps_per_second"] = (step - before[0]) / (seconds - before[1])
        self._log(step, values)

    def log_training(self, step: int, values: Mapping[str, float]) -> None:
        """Log the columns of training.csv."""
        self._log(step, {f"training/{name}": value for name, value in values.items()})

    def log_result(self, mean: float) -> None:
        """Log the mean return of the final evaluation."""
        self._log(self.last[0], {"result/return": mean})

    def _log(self, step: int, values: Mapping[str, float]) -> None:
        for name in list(self.names):
            try:
                if name not in self.open:
                    self.open[name] = LOGGERS[name](self.folder, self.config, self.first_step)
                self.open[name].log(step, values)
            except Exception as error:  # a full disk, a lost network, a fault of the package
                self._give_up(name, error)

    def close(self) -> None:
        """Close every logger."""
        for name in list(self.open):
            try:
                self.open.pop(name).close()
            except Exception as error:
                self._give_up(name, error)

    def _give_up(self, name: str, error: Exception) -> None:
        self.names.remove(name)
        self.open.pop(name, None)
        print(
            f"{self.folder}: log={name} stops after step {self.last[0]}: {one_line(error) or type(error).__name__}"
            " (the training continues, and the run's own files are complete)",
            file=sys.stderr,
        )
