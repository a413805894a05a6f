"""What Slurm says: of the job that this process belongs to, and of the jobs in its queue."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterable
from typing import Any


def current_job() -> dict[str, Any] | None:
    """Cluster, id and number of restarts of the job that this process belongs to; None outside of Slurm.

    The id is a job's own also in an array, and stays when Slurm starts the job again.
    """
    if "SLURM_JOB_ID" not in os.environ:
        return None
    return {
        "cluster": os.environ.get("SLURM_CLUSTER_NAME", ""),
        "id": os.environ["SLURM_JOB_ID"],
        "restarts": int(os.environ.get("SLURM_RESTART_COUNT", 0)),
    }


def queue(jobs: Iterable[str]) -> dict[str, str] | None:
    """The state (PENDING, RUNNING, ...) of those of `jobs` that have not ended, by id, an array's as `<id>_<task>`.

    None where Slurm cannot be asked.
    """
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
    return dict(line.split() for line in done.stdout.splitlines())


def has_ended(job: dict[str, Any]) -> bool:
    """Whether the incarnation of a job that `current_job` described in it is over for certain."""
    here = current_job()
    if here and (here["cluster"], here["id"]) == (job["cluster"], job["id"]):
        return here["restarts"] > job["restarts"]  # Slurm starts a job again when the one before is gone
    return queue([job["id"]]) == {}
