"""What Slurm says: of the job that this process belongs to, and of the jobs in its queue."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterable
from typing import Any

ENDED = {
    "BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "PREEMPTED", "REVOKED",
    "TIMEOUT",
}  # fmt: skip
"""The states of jobs that are over."""


def cluster() -> str:
    """The name of the cluster that Slurm's programs ask here; empty where that cannot be told."""
    # The first one redirects the programs; the second one Slurm sets on its nodes.
    if name := os.environ.get("SLURM_CLUSTERS") or os.environ.get("SLURM_CLUSTER_NAME"):
        return name
    try:
        done = subprocess.run(["scontrol", "show", "config"], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    found = re.search(r"^ClusterName\s*=\s*(\S+)", done.stdout, re.MULTILINE)
    return found[1] if found and not done.returncode else ""


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


def queue(jobs: Iterable[str], timeout: float = 60.0) -> dict[str, str] | None:
    """The state (PENDING, RUNNING, ...) of those of `jobs` that have not ended, by id, an array's as `<id>_<task>`.

    None where Slurm cannot be asked, or does not answer within `timeout` seconds.
    """
    jobs = set(jobs)
    arrays = sorted({job.partition("_")[0] for job in jobs})
    if not arrays:
        return {}
    # Of all states, as without that it leaves some out in which a job goes on later.
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%i %T", f"--jobs={','.join(arrays)}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode:
        return {} if "Invalid job id" in done.stderr else None  # it forgets jobs some minutes after their end
    states = dict(line.split() for line in done.stdout.splitlines())
    return {job: states[job] for job in jobs & states.keys() if states[job] not in ENDED}


def has_ended(job: dict[str, Any]) -> bool:
    """Whether the incarnation of a job that `current_job` described in it is over for certain.

    Of a job of another cluster than the one that is asked here, nobody can say that.
    """
    here = current_job()
    if here and (here["cluster"], here["id"]) == (job["cluster"], job["id"]):
        return here["restarts"] > job["restarts"]  # Slurm starts a job again when the one before is gone
    if not job["cluster"] or job["cluster"] != cluster():
        return False
    queued = queue([job["id"]])
    return queued is not None and job["id"] not in queued
