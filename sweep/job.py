"""One cell as a Slurm job: the command `run.py <words>`, which requeues itself when its time is over."""

from __future__ import annotations

import random
import signal
import sys
import time
from typing import Any

from submitit import JobEnvironment
from submitit.helpers import Checkpointable

from store import slurm
from store.checkpoint import saved_step
from store.files import one_line
from store.folder import has_ended
from sweep.cells import Cell

PATIENCE = 40.0
"""Seconds to go on asking a squeue that does not answer: a part of SIGNAL_DELAY, and more than the 30 s (by default)
after which Slurm kills a job that was cancelled."""
PAUSES = (2.0, 8.0)
"""Shortest and longest seconds between two questions; random, as many jobs may get their signal at the same time."""


class Job(Checkpointable):
    """What submitit pickles, and calls on the node. `words` train `cell` alone."""

    def __init__(self, words: list[str], cell: Cell):
        self.words, self.cell = words, cell

    def __call__(self) -> None:
        from run import main  # the command that the job is; only here, as run.py imports sweeps itself

        # submitit's own handler would requeue at once, amid a gradient step or the writing of a checkpoint. run.py
        # notes the signal, and ends with a checkpoint between two steps; what comes later must not disturb that.
        signum = signal.Signals[f"SIG{JobEnvironment.USR_SIG}"]
        requeue: Any = signal.signal(signum, lambda *_: None)
        log, before = JobEnvironment().paths.stderr, self._progress()
        sys.argv = ["run.py", *self.words]  # what info.json says of the command
        try:
            code = main(self.words)
        except Exception:
            self.cell.note_end(1, log)
            raise
        if code > 128 and self._is_running():
            # SIGTERM, with which Slurm preempts, may come at any moment; the other signal comes near the time limit.
            if code == 128 + signum and self._progress() == before:
                reason = "not requeued: no checkpoint between the start of the job and Slurm's signal (slurm.hours?)"
                self.cell.note_end(code, log, reason)
            else:
                try:
                    requeue(signum, None)
                except Exception as error:
                    self.cell.note_end(code, log, f"could not be requeued: {one_line(error)}")
                    raise
        if code < 128:
            self.cell.note_end(code, log)
        if code not in (0, 3):
            sys.exit(code)

    def _is_running(self) -> bool:
        """Whether Slurm has not ended the job: the signal came before its time is over, or before it is preempted.

        One that was cancelled is not running any more, and must not come back, which Slurm would allow. Where squeue
        goes on not to answer, Slurm would have killed that one by now.
        """
        job, deadline = JobEnvironment().job_id, time.monotonic() + PATIENCE
        while (states := slurm.queue([job], timeout=20.0)) is None:
            if time.monotonic() >= deadline:
                return True
            time.sleep(random.uniform(*PAUSES))
        return states.get(job) == "RUNNING"

    def _progress(self) -> list[tuple[bool, int]]:
        """How far each seed is, as a job would find it that starts now."""
        return [(has_ended(folder), saved_step(folder)) for folder in self.cell.folders]
