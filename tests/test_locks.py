"""Locks: one process for each run."""

import errno
import json
import os
import socket
import subprocess

import pytest
from helpers import CHECKPOINTED, break_off, outcome_files, run_command

from store.lock import LockedError, run_lock


def test_a_run_in_progress_is_left_to_its_process(tmp_path, capsys):
    _, folder = break_off(tmp_path)
    capsys.readouterr()
    with run_lock(folder):
        before = outcome_files(tmp_path)
        assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}"]) == 2
        assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}", "overwrite=true"]) == 2
        err = capsys.readouterr().err
        said = f"run.py: {folder} is being trained by process {os.getpid()} on {socket.gethostname()}\n"
        assert err == 2 * said
        assert outcome_files(tmp_path) == before
    assert not list(tmp_path.rglob("*.lock"))  # nor the lock of the other seed
    assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}"]) == 0


def test_the_lock_of_a_dead_process_is_taken_over(tmp_path):
    lock = tmp_path / "seed=1.lock"
    lock.write_text(json.dumps({"pid": 1, "host": socket.gethostname()}))
    with run_lock(tmp_path / "seed=1"):
        assert json.loads(lock.read_text())["pid"] == os.getpid()
    lock.write_text("nothing that can be read")
    with run_lock(tmp_path / "seed=1"):
        assert json.loads(lock.read_text()) == {"pid": os.getpid(), "host": socket.gethostname()}
    assert not lock.exists()


def test_the_lock_of_another_host_is_for_a_person_to_delete(tmp_path):
    lock = tmp_path / "seed=1.lock"
    lock.write_text(json.dumps({"pid": 7, "host": "node-12"}))
    with pytest.raises(LockedError, match=rf"by process 7 on node-12; if that process has ended, delete {lock}"):
        run_lock(tmp_path / "seed=1").__enter__()
    assert lock.exists()


def test_where_files_cannot_be_locked_the_process_id_decides(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", unsupported)
    lock = tmp_path / "seed=1.lock"
    lock.write_text(json.dumps({"pid": os.getppid(), "host": socket.gethostname()}))
    with pytest.raises(LockedError, match=f"by process {os.getppid()} on "):
        run_lock(tmp_path / "seed=1").__enter__()
    ended = subprocess.Popen(["true"])
    ended.wait()
    lock.write_text(json.dumps({"pid": ended.pid, "host": socket.gethostname()}))
    with run_lock(tmp_path / "seed=1"):
        assert json.loads(lock.read_text())["pid"] == os.getpid()


def test_a_lock_that_its_owner_deletes_meanwhile_is_no_lock(tmp_path, monkeypatch):
    import fcntl

    lock, flock, calls = tmp_path / "seed=1.lock", fcntl.flock, []

    def race(file, how):
        if not calls:
            lock.unlink()  # the owner deletes it between our opening and our locking
        calls.append(how)
        return flock(file, how)

    monkeypatch.setattr("fcntl.flock", race)
    with run_lock(tmp_path / "seed=1"):
        assert len(calls) == 2 and json.loads(lock.read_text())["pid"] == os.getpid()
