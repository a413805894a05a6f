"""Where a run's numbers go beside its own files: TensorBoard and Weights & Biases.

    results/<task>/<variant>/seed=<n>/
        tensorboard/     event files, one more for each resumption
        wandb/           what Weights & Biases keeps, with WANDB_MODE=offline the whole run
        wandb-id.txt     its id of the run; a resumption has the same

The trainer tells a run's numbers to its writer (store/writer.py), and the writer tells the loggers. Nothing comes back.
A logger that fails is named once and left out, and the training goes on.
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
    """Takes the numbers of one run; steps never descend. It may raise any error."""

    @staticmethod
    def check() -> None:
        """Raise ImportError or LoggerError if it cannot start."""

    def log(self, step: int, values: Mapping[str, float]) -> None: ...

    def close(self) -> None: ...


class TensorBoard:
    """Writes event files. Those of an earlier process count below `first_step` only.

    PyTorch writes them with the package `tensorboard`, which also shows them.
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
    """Logs a run of its own for each seed. Steps that it has already are ignored by Weights & Biases itself."""

    @staticmethod
    def check() -> None:
        import wandb

        try:
            wandb.login()  # asks for the key in a terminal: now, and not in the middle of the training
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
            reinit="create_new",  # the seeds of a process have a run each, at the same time
            settings=wandb.Settings(console="off", silent=True),
        )

    def log(self, step: int, values: Mapping[str, float]) -> None:
        self.run.log(dict(values), step=step)

    def close(self) -> None:
        self.run.finish()


LOGGERS: dict[str, Any] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}
"""By the name of the package and in `log`: made with folder, settings and first step of a run."""


def logger_names(text: str) -> list[str]:
    """The loggers that a value of `log` asks for, without the run's own files; text like `csv,wandb`."""
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
        """The run resumes; its last evaluation was at `step`."""
        self.first_step, self.last = step + 1, (step, math.nan)

    def log_evaluation(self, step: int, mean: float, seconds: float) -> None:
        """Log the mean return of an evaluation, and the rate since the one before in this process.

        `seconds` are those of the training since its start.
        """
        before, self.last = self.last, (step, seconds)
        values = {"evaluation/return": mean}
        if seconds > before[1]:  # not for the first one of a resumption
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
        """Let every logger finish."""
        for name in list(self.open):
            try:
                self.open.pop(name).close()
            except Exception as error:
                self._give_up(name, error)

    def _give_up(self, name: str, error: Exception) -> None:
        self.names.remove(name)
        self.open.pop(name, None)
        print(
            f"{self.folder}: log={name} ends after step {self.last[0]}: {one_line(error) or type(error).__name__}"
            " (the training goes on, and the run's own files have everything)",
            file=sys.stderr,
        )
