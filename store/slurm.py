"""Queries to Slurm: the job that this process belongs to, and the jobs in the queue."""

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
"""The states of jobs that have ended."""


def cluster() -> str:
    """The name of the cluster that Slurm's programs query here; empty if it is unknown."""
    # The first variable redirects Slurm's programs; Slurm sets the second one on its nodes.
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

    A job of an array has the id `<id>_<task>`. Slurm keeps the id when it restarts a job.
    """
    if "SLURM_JOB_ID" not in os.environ:
        return None
    job, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    return {
        "cluster": os.environ.get("SLURM_CLUSTER_NAME", ""),
        # In an array, SLURM_JOB_ID may be the number of the whole array.
        "id": f"{job}_{task}" if job else os.environ["SLURM_JOB_ID"],
        "restarts": int(os.environ.get("SLURM_RESTART_COUNT", 0)),
    }


def queue(jobs: Iterable[str], timeout: float = 60.0) -> dict[str, str] | None:
    """The states (PENDING, RUNNING, ...), by id, of the `jobs` that have not ended. A job of an array is `<id>_<task>`.

    None if Slurm cannot be queried or does not answer within `timeout` seconds.
    """
    jobs = set(jobs)
    arrays = sorted({job.partition("_")[0] for job in jobs})
    if not arrays:
        return {}
    # Without --states=all, squeue leaves out some states from which a job continues later.
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%i %T", f"--jobs={','.join(arrays)}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode:
        return {} if "Invalid job id" in done.stderr else None  # Slurm forgets jobs some minutes after their end
    states = dict(line.split() for line in done.stdout.splitlines())
    return {job: states[job] for job in jobs & states.keys() if states[job] not in ENDED}


def has_ended(job: dict[str, Any]) -> bool:
    """Whether this run of `job`, as `current_job` described it, has certainly ended.

    Always False for jobs of another cluster: only the job's own cluster can confirm it.
    """
    here = current_job()
    if here and (here["cluster"], here["id"]) == (job["cluster"], job["id"]):
        return here["restarts"] > job["restarts"]  # Slurm restarts a job after its previous run has ended
    if not job["cluster"] or job["cluster"] != cluster():
        return False
    queued = queue([job["id"]])
    return queued is not None and job["id"] not in queued
