"""The cells of a sweep as an array of Slurm jobs, through submitit. Each job trains one cell and requeues itself."""

from __future__ import annotations

import math
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import fields, replace
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

from core.words import ConfigError, known_name
from store import slurm
from store.checkpoint import saved_step
from store.files import one_line
from store.folder import has_ended
from store.lock import LockedError, run_lock
from store.output import forgiving_output
from sweep.cells import RECORDS, Cell
from sweep.exit import Exit, exit_code, stoppable
from sweep.plan import Entry, make_plan
from sweep.settings import SIGNAL_DELAY, SlurmSettings, Sweep
from sweep.states import NO_ANSWER, Stage, count_states, job_states
from sweep.train import train_cells

ROOT = Path(__file__).parents[1]
REQUEUES = 10_000
"""How often the time limit may stop a cell. A cell without progress is not requeued, so this number can be large."""
SPARE_MEMORY = 1.3
PATIENCE = 40.0
"""Seconds to wait for an answer of squeue: less than SIGNAL_DELAY, and more than the 30 s (Slurm's default) after which
Slurm kills a cancelled job."""
PAUSES = (2.0, 8.0)
"""Shortest and longest seconds between two calls of squeue; random, because many jobs may get their signal at once."""


# ------------------------------------------------------------------------------------------------------- submission


def asks_for_gpus(sweep: Sweep) -> bool:
    # Other parameters of sbatch ask for GPUs too, and some clusters require these.
    return sweep.slurm.gpus > 0 or any(name.startswith(("gpus", "gres", "tres")) for name in sweep.sbatch)


def check_gpus(sweep: Sweep, device: str) -> None:
    """Raise ConfigError if the jobs get GPUs that they do not use, or use GPUs that they do not get."""
    gpus = sweep.slurm.gpus
    if device != "cpu" and not asks_for_gpus(sweep):
        raise ConfigError(f"device={device} with launcher=slurm needs slurm.gpus= of at least 1")
    if ":" in device:
        raise ConfigError(
            f"device={device} cannot be used with launcher=slurm: a job sees only its own GPUs (use device=cuda)"
        )
    if device == "cpu" and gpus:
        raise ConfigError(f"slurm.gpus={gpus} needs device=cuda: with device=cpu, the cells would not use them")


def submit(sweep: Sweep, cells: Sequence[Cell]) -> None:
    """Submit the cells that have not ended and that no process or job trains or may train.

    Raises ConfigError if Slurm or submitit is missing, squeue does not answer, another command is submitting, or sbatch
    refuses the jobs.
    """
    if not shutil.which("sbatch"):
        raise ConfigError("launcher=slurm needs Slurm: there is no sbatch on the PATH")
    try:
        import submitit
    except ImportError:
        raise ConfigError("launcher=slurm needs submitit: pip install -e '.[slurm]', or pip install submitit") from None
    folder = cells[0].root.absolute() / RECORDS / "slurm"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        # Take the lock before reading the queue: two commands must not both see the same cells as free.
        with run_lock(folder.with_name("submission")):
            jobs = job_states(cells)
            if NO_ANSWER in jobs.values():
                raise ConfigError("squeue does not answer, so cells may be queued already; try again later")
            entries = make_plan(cells, jobs)
            print(count_states([entry.state for entry in entries]))
            for entry in entries:
                if entry.state.stage is Stage.UNKNOWN:
                    print(f"{entry.cell.name} is not submitted: {entry.state.detail}")
            free = [entry for entry in entries if not entry.state.stage.taken and entry.state.stage != Stage.FINISHED]
            if not free:
                print("nothing to submit")
                return
            executor = submitit.AutoExecutor(folder, cluster="slurm", slurm_max_num_timeout=REQUEUES)
            executor.update_parameters(**_parameters(sweep, free))
            submitted = _submit(executor, free, sweep.sbatch.get("clusters"))
    except LockedError as error:
        raise ConfigError(f"another command is submitting cells of {folder.parents[1]}: {error}") from None
    except submitit.core.utils.FailedJobError as error:
        raise _explain(error) from error
    array = submitted[0].job_id.partition("_")[0]
    print(f"submitted {len(free)} as job {array} (`scancel {array}` cancels it; logs in {folder})")
    print(f"`python run.py status {folder.parents[1]}` shows the state of all cells")


def _submit(executor: Any, free: Sequence[Entry], clusters: str | None) -> list[Any]:
    """Submit the cells as one array and record the job of each. `clusters` is sbatch's parameter of that name."""
    # A list of clusters is kept as it is. sbatch chooses one of them, and squeue is not asked about such jobs.
    name = clusters or os.environ.get("SBATCH_CLUSTERS") or slurm.cluster()
    cells = [replace(entry.cell, root=entry.cell.root.absolute()) for entry in free]
    for cell in cells:
        cell.record("end").unlink(missing_ok=True)
    # The exception repeats what sbatch writes to stderr.
    with redirect_stderr(StringIO()), executor.batch():
        jobs = [executor.submit(Job(cell)) for cell in cells]
    for cell, job in zip(cells, jobs, strict=True):
        cell.write("job", {"job": job.job_id, "cluster": name, "log": str(job.paths.stderr)})
    return jobs


def _parameters(sweep: Sweep, free: Sequence[Entry]) -> dict[str, Any]:
    """The parameters of submitit. The user's parameters of sbatch pass through, and override ours."""
    settings, sbatch = sweep.slurm, sweep.sbatch
    parameters: dict[str, Any] = {
        "name": "acrl",
        "timeout_min": math.ceil(60 * settings.hours),
        "cpus_per_task": settings.cpus,
        "slurm_array_parallelism": settings.parallel,
        "slurm_signal_delay_s": SIGNAL_DELAY,
        # Python on the node must find this project, wherever the command was typed.
        "slurm_setup": [f"export PYTHONPATH={shlex.quote(str(ROOT))}${{PYTHONPATH:+:$PYTHONPATH}}"],
        # Since Slurm 22.05, srun does not take this from sbatch.
        "slurm_srun_args": [f"--cpus-per-task={settings.cpus}"],
        "slurm_additional_parameters": {
            "requeue": True,
            **{name: True if value == "true" else value for name, value in sbatch.items()},
        },
    }
    if settings.partition:
        parameters["slurm_partition"] = settings.partition
    if settings.gpus:
        parameters["gpus_per_node"] = settings.gpus
    if not any(name.startswith("mem") for name in sbatch):
        parameters["mem_gb"] = math.ceil(SPARE_MEMORY * max(entry.memory for entry in free) / 1e9)
    return parameters


def _explain(error: Exception) -> ConfigError:
    """A ConfigError with the message of sbatch or, for a misspelt parameter, the name that may be meant."""
    said = [line for line in str(error).splitlines() if line.startswith("sbatch: ")]
    if unknown := re.search(r"unrecognized option '--([\w-]+)", str(error)):
        usage = subprocess.run(["sbatch", "--help"], capture_output=True, text=True).stdout
        names = sorted({*(f.name for f in fields(SlurmSettings)), *re.findall(r"--([a-z][a-z-]+)", usage)})
        try:
            known_name("sbatch parameter", unknown[1], names)
        except ConfigError as wrong:
            return wrong
    return ConfigError(" ".join(said) or one_line(error))


# ----------------------------------------------------------------------------------------------------- on the node


class Job:
    """The training of one cell as a Slurm job. submitit pickles it and calls it on the node."""

    def __init__(self, cell: Cell):
        self.cell = cell

    def checkpoint(self) -> Any:
        """What submitit submits when it requeues the job: the same job again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)

    def __call__(self) -> None:
        from submitit import JobEnvironment

        # submitit's handler would requeue at once, in the middle of a gradient step or of a checkpoint. Instead,
        # `stoppable` notes the signal and ends the training between two steps, with a checkpoint; later signals must
        # not disturb it.
        environment = JobEnvironment()
        signum = signal.Signals[f"SIG{JobEnvironment.USR_SIG}"]
        requeue: Any = signal.signal(signum, lambda *_: None)
        log, before = environment.paths.stderr, self._progress()
        try:
            with forgiving_output():
                code = exit_code(partial(stoppable, partial(train_cells, [self.cell])))
        except Exception:
            self.cell.note_end(1, log)
            raise
        if code > 128 and _is_running(environment.job_id):
            # SIGTERM, with which Slurm preempts, may come at any moment; the other signal comes near the time limit.
            if code == 128 + signum and self._progress() == before:
                reason = "not requeued: the job wrote no new checkpoint before Slurm's signal (slurm.hours too short?)"
                self.cell.note_end(code, log, reason)
            else:
                try:
                    requeue(signum, None)
                except Exception as error:
                    self.cell.note_end(code, log, f"could not be requeued: {one_line(error)}")
                    raise
        if code < 128:
            self.cell.note_end(code, log)
        if code not in (Exit.DONE, Exit.DIVERGED):
            sys.exit(code)

    def _progress(self) -> list[tuple[bool, int]]:
        """For each seed: whether it has ended, and the step from which a new job would resume."""
        return [(has_ended(folder), saved_step(folder)) for folder in self.cell.folders]


def _is_running(job: str) -> bool:
    """Whether Slurm still runs `job`. If so, its signal meant the time limit or a preemption, not a cancellation.

    A cancelled job must not come back, although Slurm would allow it. If squeue gives no answer for PATIENCE seconds,
    the job was not cancelled, because Slurm would have killed it by then.
    """
    deadline = time.monotonic() + PATIENCE
    while (states := slurm.queue([job], timeout=20.0)) is None:
        if time.monotonic() >= deadline:
            return True
        time.sleep(random.uniform(*PAUSES))
    return states.get(job) == "RUNNING"
