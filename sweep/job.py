"""One cell as a Slurm job: the command `run.py <words>`, which requeues itself when its time is over."""

from __future__ import annotations

import signal
import sys
from typing import Any

from submitit import JobEnvironment
from submitit.helpers import Checkpointable

from core import slurm
from sweep.cells import Cell


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
        log = JobEnvironment().paths.stderr
        sys.argv = ["run.py", *self.words]  # what info.json says of the command
        try:
            code = main(self.words)
        except Exception:
            self.cell.note_end(1, log)
            raise
        if code > 128 and self._is_running():
            requeue(signum, None)
        if code < 128:
            self.cell.note_end(code, log)
        if code not in (0, 3):
            sys.exit(code)

    def _is_running(self) -> bool:
        """Whether Slurm has not ended the job: the signal came before its time is over, or before it is preempted.

        One that was cancelled is not running any more, and must not come back.
        """
        job = JobEnvironment().job_id
        return (slurm.queue([job]) or {}).get(job) == "RUNNING"
