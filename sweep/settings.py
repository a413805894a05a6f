"""The settings of a sweep: how cells are run, not what they learn. They are not part of the names of runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

from algos import setting_keys
from core.config import parse_value
from core.words import ConfigError, known_name, parse_words
from sweep.plugins import KEY

SLURM_PREFIX = "slurm."
LAUNCHERS = ("local", "slurm")
SIGNAL_DELAY = 120
"""Seconds between Slurm's signal and the time limit: enough for a checkpoint of many seeds on a slow disk."""


@dataclass
class SlurmSettings:
    """The resources that each job of a sweep requests from Slurm."""

    partition: str | None = field(default=None, metadata={"help": "partition (default: the cluster's)"})
    gpus: int = field(default=0, metadata={"help": "GPUs per cell"})
    cpus: int = field(default=1, metadata={"help": "CPUs per cell, and its threads if threads= is not given"})
    hours: float = field(
        default=24.0, metadata={"help": "time limit; a cell that needs longer is requeued and resumes"}
    )
    parallel: int = field(default=256, metadata={"help": "most cells that run at the same time"})


@dataclass
class SweepSettings:
    """How the cells of a command are run. Without `jobs`, the local launcher trains them in this process."""

    jobs: int | None = field(default=None, metadata={"help": "cells that run at the same time, one process each"})
    launcher: str = field(default="local", metadata={"help": "'local' (this machine) or 'slurm' (a job array)"})
    dry: bool = field(default=False, metadata={"help": "only print the plan: states, time, memory"})


@dataclass(frozen=True)
class Sweep:
    """The sweep settings of a command; `sbatch` has further parameters of sbatch by name."""

    settings: SweepSettings
    slurm: SlurmSettings
    sbatch: dict[str, str]

    @property
    def wanted(self) -> bool:
        """Whether the command asks for more than training the cells in this process, one after the other."""
        return self.settings.jobs is not None or self.settings.dry or self.settings.launcher == "slurm"


def parse_sweep(words: Sequence[str]) -> tuple[Sweep, dict[str, str]]:
    """The settings of the sweep, and those of its cells.

    Raises ConfigError for an unknown key, a key that is given twice, and a value that does not fit.
    """
    own = [f.name for f in fields(SweepSettings)]
    slurm_names = [f.name for f in fields(SlurmSettings)]
    settings, slurm = SweepSettings(), SlurmSettings()
    sbatch: dict[str, str] = {}
    cells: dict[str, str] = {}
    keys = [*setting_keys(), KEY, *own, *(SLURM_PREFIX + name for name in slurm_names)]
    given = parse_words(words, keys, free=SLURM_PREFIX)
    for key, text in given.items():
        name = key.removeprefix(SLURM_PREFIX)
        if key in own:
            setattr(settings, key, parse_value(SweepSettings, key, text))
        elif not key.startswith(SLURM_PREFIX):
            cells[key] = text
        elif name in slurm_names:
            setattr(slurm, name, parse_value(SlurmSettings, name, text, SLURM_PREFIX))
        else:
            sbatch[name.replace("_", "-")] = text
    sweep = Sweep(settings, slurm, sbatch)
    _check_values(sweep, [key for key in given if key.startswith(SLURM_PREFIX)])
    return sweep, cells


def _check_values(sweep: Sweep, slurm_keys: Sequence[str]) -> None:
    settings, slurm = sweep.settings, sweep.slurm
    if settings.launcher not in LAUNCHERS:
        known_name("launcher", settings.launcher, LAUNCHERS)
    if settings.jobs is not None and settings.jobs < 1:
        raise ConfigError(f"bad value {settings.jobs} for jobs: must be at least 1")
    if settings.jobs is not None and settings.launcher == "slurm":
        raise ConfigError("jobs= is for launcher=local; with launcher=slurm, slurm.parallel= limits the jobs")
    if slurm_keys and settings.launcher != "slurm":
        raise ConfigError(f"{slurm_keys[0]}= needs launcher=slurm")
    for name, least in (("gpus", 0), ("cpus", 1), ("parallel", 1)):
        if getattr(slurm, name) < least:
            raise ConfigError(f"bad value {getattr(slurm, name)} for slurm.{name}: must be at least {least}")
    if not 0 < slurm.hours < float("inf"):
        raise ConfigError(f"bad value {slurm.hours} for slurm.hours: must be positive and finite")
    if 3600 * slurm.hours <= 2 * SIGNAL_DELAY and "signal" not in sweep.sbatch:
        # The signal would come before the training has made progress, again and again.
        raise ConfigError(
            f"bad value {slurm.hours} for slurm.hours: must be more than {2 * SIGNAL_DELAY} s (the checkpoint is"
            f" written {SIGNAL_DELAY} s before the end; slurm.signal= changes that)"
        )
