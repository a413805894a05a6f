"""The cells of a sweep as an array of Slurm jobs, through submitit."""

from __future__ import annotations

import math
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import fields, replace
from io import StringIO
from pathlib import Path
from typing import Any

from core.config import Config, ConfigError, choose
from store.files import one_line
from store.lock import LockedError, run_lock
from store.slurm import cluster
from sweep.cells import NO_ANSWER, RECORDS, cell_of, command_words, job_states
from sweep.plan import Entry, count_states, make_plan
from sweep.settings import SIGNAL_DELAY, SlurmSettings, Sweep

ROOT = Path(__file__).parents[1]
REQUEUES = 10_000
"""How often a cell may be stopped by its time limit; each time it has come further."""
SPARE_MEMORY = 1.3


def submit(sweep: Sweep, cells: Sequence[tuple[Config, Config]]) -> None:
    """Submit the cells that are neither finished nor queued nor running.

    ConfigError where Slurm or submitit is missing, or refuses.
    """
    if not shutil.which("sbatch"):
        raise ConfigError("launcher=slurm needs Slurm: there is no sbatch on the PATH")
    try:
        import submitit
    except ImportError:
        raise ConfigError("launcher=slurm needs submitit: pip install '.[slurm]', or pip install submitit") from None
    folder = cell_of(*cells[0]).root.absolute() / RECORDS / "slurm"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with run_lock(folder.with_name("submission")):
            # Only now: two commands at the same time must not see the same cells as free.
            jobs = job_states(cell_of(*cell) for cell in cells)
            if NO_ANSWER in jobs.values():
                raise ConfigError("squeue does not answer, so nobody knows which cells are queued already")
            entries = make_plan(cells, jobs)
            print(count_states([entry.state for entry in entries]))
            for entry in entries:
                if entry.state.name == "unknown":
                    print(f"{entry.cell.name} is not submitted: {entry.state.detail}")
            free = [entry for entry in entries if entry.state.name in ("new", "interrupted", "failed")]
            if not free:
                print("nothing to submit")
                return
            executor = submitit.AutoExecutor(folder, cluster="slurm", slurm_max_num_timeout=REQUEUES)
            executor.update_parameters(**_parameters(sweep, free))
            submitted = _submit(executor, free, sweep.sbatch.get("clusters"))
    except LockedError as error:
        raise ConfigError(f"another command submits cells of {folder.parents[1]} at this moment: {error}") from None
    except submitit.core.utils.FailedJobError as error:
        raise _explain(error) from error
    array = submitted[0].job_id.partition("_")[0]
    print(f"submitted {len(free)} as job {array} (`scancel {array}` ends it; logs in {folder})")
    print(f"`python run.py status {folder.parents[1]}` shows how all cells stand")


def _submit(executor: Any, free: Sequence[Entry], clusters: str | None) -> list[Any]:
    """Submit the cells as one array, and record which job has which cell; `clusters` is what sbatch is told of them."""
    from sweep.job import Job  # here, as it needs submitit

    # Which of several sbatch chose is not worth knowing: squeue is not asked for them either.
    name = clusters or os.environ.get("SBATCH_CLUSTERS") or cluster()
    cells = [replace(entry.cell, root=entry.cell.root.absolute()) for entry in free]
    for cell in cells:
        cell.record("end").unlink(missing_ok=True)
    # What sbatch says against it is in the exception as well.
    with redirect_stderr(StringIO()), executor.batch():
        jobs = [
            executor.submit(Job(command_words(entry.config, entry.base), cell))
            for entry, cell in zip(free, cells, strict=True)
        ]
    for cell, job in zip(cells, jobs, strict=True):
        cell.write("job", {"job": job.job_id, "cluster": name, "log": str(job.paths.stderr)})
    return jobs


def _parameters(sweep: Sweep, free: Sequence[Entry]) -> dict[str, Any]:
    """What submitit is told. Further parameters go to sbatch as they are, and before ours."""
    slurm, sbatch = sweep.slurm, sweep.sbatch
    parameters: dict[str, Any] = {
        "name": "acrl",
        "timeout_min": math.ceil(60 * slurm.hours),
        "cpus_per_task": slurm.cpus,
        "slurm_array_parallelism": slurm.parallel,
        "slurm_signal_delay_s": SIGNAL_DELAY,
        # On the node, Python has to find this project, wherever the command was typed.
        "slurm_setup": [f"export PYTHONPATH={shlex.quote(str(ROOT))}${{PYTHONPATH:+:$PYTHONPATH}}"],
        # srun does not take this from sbatch any more, since Slurm 22.05.
        "slurm_srun_args": [f"--cpus-per-task={slurm.cpus}"],
        "slurm_additional_parameters": {
            "requeue": True,
            **{name: True if value == "true" else value for name, value in sbatch.items()},
        },
    }
    if slurm.partition:
        parameters["slurm_partition"] = slurm.partition
    if slurm.gpus:
        parameters["gpus_per_node"] = slurm.gpus
    if not any(name.startswith("mem") for name in sbatch):
        parameters["mem_gb"] = math.ceil(SPARE_MEMORY * max(entry.memory for entry in free) / 1e9)
    return parameters


def _explain(error: Exception) -> ConfigError:
    """What sbatch says, and for a misspelt parameter the one that may be meant."""
    said = [line for line in str(error).splitlines() if line.startswith("sbatch: ")]
    if unknown := re.search(r"unrecognized option '--([\w-]+)", str(error)):
        usage = subprocess.run(["sbatch", "--help"], capture_output=True, text=True).stdout
        names = sorted({*(f.name for f in fields(SlurmSettings)), *re.findall(r"--([a-z][a-z-]+)", usage)})
        try:
            choose("sbatch parameter", unknown[1], names)
        except ConfigError as wrong:
            return wrong
    return ConfigError(" ".join(said) or one_line(error))
