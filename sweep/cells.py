"""Cells: an algorithm on a task with its seeds, which one process trains in lockstep; where they are and how far.

    results/sweep/<task>/<variant>/
        seed=<seeds>.log     what the cell's processes on this machine said, one after the other
        seed=<seeds>.job     the Slurm job that has the cell, its cluster and its log
        seed=<seeds>.end     how the last process of the cell ended, where that was not well: exit code and log

The runs themselves, their results and checkpoints are where they always are; a cell's state follows from them.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from core.config import Config, differences
from store import slurm
from store.checkpoint import saved_step
from store.files import replace_file
from store.folder import (
    describe_failure,
    has_ended,
    has_failed,
    last_evaluated,
    parse_variant,
    read_run,
    run_folder,
    variant_name,
)
from store.lock import lock_owner

RECORDS = "sweep"
"""The folder of logs and records in that of results."""
UNKNOWN = "UNKNOWN"
"""In place of the state of a job of a cluster that is not the one that Slurm's programs ask here."""
NO_ANSWER = "NO_ANSWER"
"""In place of the state of a job where squeue does not answer."""


@dataclass(frozen=True)
class Cell:
    """Where a cell's runs and records are. `root` is the folder of results, `seeds` ascend."""

    root: Path
    task: str
    variant: str
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        return f"{parse_variant(self.variant)[0]} {self.task}"

    @property
    def folders(self) -> list[Path]:
        return [run_folder(self.root, self.task, self.variant, seed) for seed in self.seeds]

    def record(self, kind: str) -> Path:
        """The file `kind`: log, job or end."""
        return self.root / RECORDS / self.task / self.variant / f"seed={format_seeds(self.seeds)}.{kind}"

    def read(self, kind: str) -> dict[str, Any]:
        """The record `kind`; empty where there is none."""
        try:
            record = json.loads(self.record(kind).read_text())
        except (OSError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}

    @property
    def job(self) -> str:
        """The Slurm job that has or had the cell, with its cluster, as two clusters may use a number; or empty."""
        record = self.read("job")
        return f"{record['job']} of cluster {record['cluster']}" if record.get("cluster") else record.get("job", "")

    def write(self, kind: str, content: Mapping[str, Any]) -> None:
        path = self.record(kind)
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, lambda file: file.write(json.dumps(content).encode() + b"\n"))

    def note_end(self, code: int, log: Path, reason: str = "") -> None:
        """Keep how a process of this cell ended, for `state_of`; nothing of a process that did well.

        The `reason` is in the log where it is not given.
        """
        if code in (0, 3):
            self.record("end").unlink(missing_ok=True)
        else:
            self.write("end", {"exit_code": code, "log": str(log), "reason": reason})


def cell_of(config: Config, base: Config) -> Cell:
    """The cell of a configuration; `base` is the paper's of the same algorithm and task."""
    variant = variant_name(config.algo, differences(config, base))
    return Cell(Path(config.results).expanduser(), config.env, variant, config.seeds)


def command_words(config: Config, base: Config) -> list[str]:
    """The words after `run.py` that train this cell alone."""
    cell = cell_of(config, base)
    words = {"algo": config.algo, "env": config.env, "seed": format_seeds(cell.seeds)}
    words |= parse_variant(cell.variant)[1]
    words |= {"results": str(cell.root.absolute()), "overwrite": json.dumps(config.overwrite)}
    words |= {"device": config.device, "threads": str(config.threads)}
    words["checkpoint_every"] = str(config.checkpoint_every)
    return [f"{key}={value}" for key, value in words.items()]


def shorten(cells: Sequence[Cell]) -> tuple[list[str], str]:
    """The cells' variants without the settings that all of them share, and these."""
    variants = [parse_variant(cell.variant) for cell in cells]
    shared = set.intersection(*(set(settings.items()) for _, settings in variants))
    names = [variant_name(algo, dict(settings.items() - shared)) for algo, settings in variants]
    return names, " ".join(f"{key}={value}" for key, value in sorted(shared))


def format_seeds(seeds: tuple[int, ...]) -> str:
    """What `parse_seeds` reads: ranges where there are some."""
    parts: list[list[int]] = []
    for seed in seeds:
        if parts and seed == parts[-1][-1] + 1:
            parts[-1][1:] = [seed]
        else:
            parts.append([seed])
    return ",".join("-".join(map(str, part)) for part in parts)


@dataclass(frozen=True)
class State:
    """How a cell stands.

    `name` is new, queued, running, interrupted, failed, finished, or unknown, where Slurm does not tell here whether
    the cell's job goes on; `step` what the seed furthest behind of those that have not ended could resume from,
    `detail` what a person may want to know.
    """

    name: str
    step: int = 0
    detail: str = ""


def job_states(cells: Iterable[Cell]) -> dict[str, str]:
    """The states of the Slurm jobs of `cells`, by `Cell.job`, without those that are over for certain."""
    records = {cell.job: cell.read("job") for cell in cells if cell.job}
    here = slurm.cluster() if any(record.get("cluster") for record in records.values()) else ""
    own = {name: record["job"] for name, record in records.items() if (record.get("cluster") or here) == here}
    queued = slurm.queue(own.values())
    if queued is None:
        queued = dict.fromkeys(own.values(), NO_ANSWER)
    others = dict.fromkeys(records.keys() - own.keys(), UNKNOWN)
    return others | {name: queued[job] for name, job in own.items() if job in queued}


def state_of(cell: Cell, jobs: Mapping[str, str]) -> State:
    """The state of a cell; `jobs` as from `job_states`."""
    folders = cell.folders
    unended = [folder for folder in folders if not has_ended(folder)]
    if not unended:
        diverged = [f"seed {s}: {_failure(f)}" for s, f in zip(cell.seeds, folders, strict=True) if has_failed(f)]
        return State("finished", detail="; ".join(diverged))
    step = min(saved_step(folder) for folder in unended)
    job, known = cell.job, jobs.get(cell.job)
    if known not in (None, UNKNOWN, NO_ANSWER):
        started = known not in ("PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "SPECIAL_EXIT")
        return State("running" if started else "queued", step, f"job {cell.read('job')['job']}")
    if owner := next(filter(None, map(lock_owner, unended)), None):
        return State("running", step, owner)
    if (end := cell.read("end")) and not _started_since(cell.record("end"), unended):
        reason = end.get("reason") or reason_of(end["exit_code"], Path(end["log"]))
        return State("failed", step, f"{reason} (log: {end['log']})")
    if known:
        record = cell.record("job")
        return State("unknown", step, f"Slurm does not tell here of job {job}; if that is over, delete {record}")
    if step or any(folder.exists() for folder in unended):
        return State("interrupted", step, f"job {job} is gone (log: {cell.read('job')['log']})" if job else "")
    return State("new")


def reached(folder: Path, steps: int) -> int:
    """How far a run has come, of `steps`, as far as its folder tells."""
    return steps if has_ended(folder) else max(last_evaluated(folder), saved_step(folder))


def reason_of(code: int, log: Path) -> str:
    """Why a process ended, from its exit code and the last line of its log."""
    if code < 0:
        hint = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"killed by {signal.Signals(-code).name}{hint}"
    try:
        lines = log.read_text(errors="replace").replace("\r", "\n").splitlines()
    except OSError:
        lines = []
    said = [line.strip() for line in lines if line.strip() and not line.startswith("srun: ")]
    return said[-1] if said else f"exit code {code}"


def _started_since(record: Path, folders: Sequence[Path]) -> bool:
    """Whether a run was started or taken up after `record` was written, as by a `run.py` of its own."""
    try:
        # By the clock of the file system, which all hosts share; each start and each resumption writes info.json.
        written = record.stat().st_mtime_ns
        return any(info.stat().st_mtime_ns > written for f in folders if (info := f / "info.json").exists())
    except OSError:  # deleted at this moment
        return False


def _failure(folder: Path) -> str:
    try:
        return describe_failure(read_run(folder).failure or {})
    except (ValueError, KeyError) as error:
        return str(error)
