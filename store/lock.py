"""A lock that lets only one process train a run. It ends with its owner and names the owner to other processes."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from store import slurm


class LockedError(RuntimeError):
    """Another process trains this run. The message names it."""


@contextmanager
def run_lock(run_folder: Path) -> Iterator[None]:
    """Hold `<run folder>.lock` while the context is open. Raises LockedError if another process holds it.

    The operating system's lock on the open file tells whether an owner on this host is alive, because it ends with the
    process. The file's text names the owner. Not every network file system passes locks on to other hosts, so the file
    of another host counts as held, unless its owner belonged to a Slurm job that has ended.
    """

    path = run_folder.with_name(run_folder.name + ".lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _acquire(path, run_folder)
    while file is None:
        file = _acquire(path, run_folder)
    try:
        os.truncate(file, 0)
        owner: dict[str, Any] = {"pid": os.getpid(), "host": socket.gethostname()}
        if job := slurm.current_job():
            owner["job"] = job
        os.pwrite(file, json.dumps(owner).encode() + b"\n", 0)
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(file)


def lock_owner(run_folder: Path) -> str | None:
    """The process that trains the run, from its lock file; None if no process does. Does not touch the lock."""
    try:
        owner = _parse(run_folder.with_name(run_folder.name + ".lock").read_bytes())
    except OSError:
        return None
    if owner is None:
        return None
    alive = _is_alive(owner["pid"]) if owner["host"] == socket.gethostname() else not _job_is_over(owner)
    return _name(owner) if alive else None


def _acquire(path: Path, run_folder: Path) -> int | None:
    """The descriptor of the locked file; None if the file was deleted or got another owner since we opened it."""
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        owner, here = _read_owner(file), socket.gethostname()
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held = False
        except BlockingIOError:
            held = True
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                raise
            held = owner is not None and owner["host"] == here and _is_alive(owner["pid"])
        name = _name(owner) if owner else "another process"
        if held:
            raise LockedError(f"{run_folder} is being trained by {name}")
        if owner and owner["host"] != here and not _job_is_over(owner):
            raise LockedError(f"{run_folder} is being trained by {name}; if that process has ended, delete {path}")
        # Another host may have taken the file over while Slurm answered.
        unchanged = _read_owner(file) == owner
        if unchanged and path.exists() and os.path.samestat(os.stat(path), os.fstat(file)):
            return file
    except BaseException:
        os.close(file)
        raise
    os.close(file)
    return None


def _read_owner(file: int) -> dict[str, Any] | None:
    return _parse(os.pread(file, 1000, 0))


def _parse(text: bytes) -> dict[str, Any] | None:
    try:
        owner = json.loads(text)
        job = owner.get("job")
        if job is not None:
            job = {"cluster": str(job["cluster"]), "id": str(job["id"]), "restarts": int(job["restarts"])}
        return {"pid": int(owner["pid"]), "host": str(owner["host"]), "job": job}
    except (ValueError, KeyError, TypeError, AttributeError):
        return None  # the file is new, or another program wrote it


def _name(owner: dict[str, Any]) -> str:
    return f"process {owner['pid']} on {owner['host']}"


def _job_is_over(owner: dict[str, Any]) -> bool:
    return owner["job"] is not None and slurm.has_ended(owner["job"])


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return pid != os.getpid()  # our own process id: the owner was a process of an earlier container
