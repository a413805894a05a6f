"""The states of cells (new, queued, running, ended, ...), from their folders, their records and Slurm's queue."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from store import slurm
from store.checkpoint import saved_step
from store.folder import describe_failure, has_ended, has_failed, last_evaluated, read_run
from store.lock import lock_owner
from sweep.cells import CellFolders, format_seeds

UNKNOWN_JOB = "UNKNOWN"
"""In place of a job's state: the job belongs to a cluster other than that of this machine's Slurm."""
NO_ANSWER = "NO_ANSWER"
"""In place of a job's state: squeue does not answer."""
WAITING_JOB = ("PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "SPECIAL_EXIT")
"""Slurm's states of jobs that have not started."""


class Stage(Enum):
    """The stage of a cell. The values are the words that users read."""

    NEW = "new"
    QUEUED = "queued"
    RUNNING = "running"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
    FINISHED = "finished"
    UNKNOWN = "unknown"  # it is not known here whether the cell's job is over

    @property
    def taken(self) -> bool:
        """Whether another process or job trains the cell, or may do so."""
        return self in (Stage.QUEUED, Stage.RUNNING, Stage.UNKNOWN)


@dataclass(frozen=True)
class CellState:
    """The stage of a cell. `step` is the smallest step from which an unfinished seed can resume.

    `detail` tells users more, such as who trains the cell or why it failed.
    """

    stage: Stage
    step: int = 0
    detail: str = ""

    def describe(self) -> str:
        """A few words: the stage, the step to resume from, and who trains the cell."""
        words = self.stage.value
        if self.step and self.stage is not Stage.FINISHED:
            words += f", {'at least' if self.stage is Stage.RUNNING else 'resumes from'} step {self.step}"
        return f"{words}: {self.detail}" if self.stage in (Stage.QUEUED, Stage.RUNNING) else words


def job_states(cells: Iterable[CellFolders]) -> dict[str, str]:
    """Slurm's state of the jobs of `cells`, by `CellFolders.job`, without jobs that have certainly ended."""
    records = {cell.job: cell.read("job") for cell in cells if cell.job}
    here = slurm.cluster() if any(record.get("cluster") for record in records.values()) else ""
    own = {name: record["job"] for name, record in records.items() if (record.get("cluster") or here) == here}
    queued = slurm.queue(own.values())
    if queued is None:
        queued = dict.fromkeys(own.values(), NO_ANSWER)
    others = dict.fromkeys(records.keys() - own.keys(), UNKNOWN_JOB)
    return others | {name: queued[job] for name, job in own.items() if job in queued}


def state_of(cell: CellFolders, jobs: Mapping[str, str]) -> CellState:
    """The state of a cell; `jobs` comes from `job_states`."""
    folders = cell.folders
    unended = [folder for folder in folders if not has_ended(folder)]
    if not unended:
        diverged = [f"seed {s}: {_failure(f)}" for s, f in zip(cell.seeds, folders, strict=True) if has_failed(f)]
        return CellState(Stage.FINISHED, detail="; ".join(diverged))
    step = min(saved_step(folder) for folder in unended)
    job, known = cell.job, jobs.get(cell.job)
    if known not in (None, UNKNOWN_JOB, NO_ANSWER):
        stage = Stage.QUEUED if known in WAITING_JOB else Stage.RUNNING
        return CellState(stage, step, f"job {cell.read('job')['job']}")
    if owner := next(filter(None, map(lock_owner, unended)), None):
        return CellState(Stage.RUNNING, step, owner)
    if (end := cell.read("end")) and not _started_since(cell.record("end"), unended):
        reason = end.get("reason") or reason_of(end["exit_code"], Path(end["log"]))
        return CellState(Stage.FAILED, step, f"{reason} (log: {end['log']})")
    if known:
        detail = f"Slurm does not say here whether job {job} is over; if it is, delete {cell.record('job')}"
        return CellState(Stage.UNKNOWN, step, detail)
    if step or any(folder.exists() for folder in unended):
        return CellState(
            Stage.INTERRUPTED, step, f"job {job} ended early (log: {cell.read('job')['log']})" if job else ""
        )
    return CellState(Stage.NEW)


def reached(folder: Path, steps: int) -> int:
    """How many of its `steps` a run has done, according to its folder."""
    return steps if has_ended(folder) else max(last_evaluated(folder), saved_step(folder))


def reason_of(code: int, log: Path) -> str:
    """Why a process ended: from its exit code and the last line of its log."""
    if code < 0:
        hint = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"killed by {signal.Signals(-code).name}{hint}"
    try:
        lines = log.read_text(errors="replace").replace("\r", "\n").splitlines()
    except OSError:
        lines = []
    said = [line.strip() for line in lines if line.strip() and not line.startswith("srun: ")]
    return said[-1] if said else f"exit code {code}"


def list_details(cells: Sequence[CellFolders], states: Sequence[CellState]) -> list[str]:
    """A line for each cell that has a detail, such as why it failed, diverged or was interrupted."""
    return [
        f"{cell.name} seed={format_seeds(cell.seeds)}: {state.detail}"
        for cell, state in zip(cells, states, strict=True)
        if state.detail and state.stage not in (Stage.QUEUED, Stage.RUNNING)
    ]


def count_states(states: Sequence[CellState]) -> str:
    """The numbers of cells at each stage, as text."""
    counts = Counter(state.stage.value for state in states)
    return f"{len(states)} cell{'s' * (len(states) > 1)}: " + ", ".join(f"{n} {stage}" for stage, n in counts.items())


def _started_since(record: Path, folders: Sequence[Path]) -> bool:
    """Whether a run was started or resumed after `record` was written, for example by its own `run.py`."""
    try:
        # All hosts share the file system's clock. Each start and each resumption writes info.json.
        written = record.stat().st_mtime_ns
        return any(info.stat().st_mtime_ns > written for f in folders if (info := f / "info.json").exists())
    except OSError:  # deleted at this moment
        return False


def _failure(folder: Path) -> str:
    try:
        return describe_failure(read_run(folder).failure or {})
    except (ValueError, KeyError) as error:
        return str(error)
