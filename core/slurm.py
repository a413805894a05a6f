"""What Slurm says: of the job that this process belongs to, and of the jobs in its queue."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterable
from typing import Any


def current_job() -> dict[str, Any] | None:
    """Cluster, id and number of restarts of the job that this process belongs to; None outside of Slurm.

    The id of one in an array is `<id>_<task>`; it stays when Slurm starts the job again.
    """
    if "SLURM_JOB_ID" not in os.environ:
        return None
    job, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    return {
        "cluster": os.environ.get("SLURM_CLUSTER_NAME", ""),
        # The number of a job in an array may be that of the whole array.
        "id": f"{job}_{task}" if job else os.environ["SLURM_JOB_ID"],
        "restarts": int(os.environ.get("SLURM_RESTART_COUNT", 0)),
    }


def queue(jobs: Iterable[str]) -> dict[str, str] | None:
    """The state (PENDING, RUNNING, ...) of those of `jobs` that have not ended, by id, an array's as `<id>_<task>`.

    None where Slurm cannot be asked.
    """
    jobs = set(jobs)
    arrays = sorted({job.partition("_")[0] for job in jobs})
    if not arrays:
        return {}
    command = ["squeue", "--noheader", "--array", "--format=%i %T", f"--jobs={','.join(arrays)}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode:
        return {} if "Invalid job id" in done.stderr else None  # it forgets jobs some minutes after their end
    states = dict(line.split() for line in done.stdout.splitlines())
    return {job: states[job] for job in jobs & states.keys()}


def has_ended(job: dict[str, Any]) -> bool:
    """Whether the incarnation of a job that `current_job` described in it is over for certain."""
    here = current_job()
    if here and (here["cluster"], here["id"]) == (job["cluster"], job["id"]):
        return here["restarts"] > job["restarts"]  # Slurm starts a job again when the one before is gone
    queued = queue([job["id"]])
    return queued is not None and job["id"] not in queued
