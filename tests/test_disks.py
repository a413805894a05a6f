"""Full disks: training continues if possible, and a command that fails says so in one line."""

import errno
import os

import pytest
import torch
from helpers import CHECKPOINTED, Breaks, assert_identical, break_off, outcome, run_command, train

from store.checkpoint import Checkpoint, CheckpointFolder
from store.files import replace_file
from store.writer import RunWriter


def no_space(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("refuses", [os.path.isdir, lambda path: True], ids=["folders", "everything"])
@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP])
def test_file_systems_that_know_no_fsync(tmp_path, monkeypatch, refuses, code):
    def fsync(descriptor):
        if refuses(os.readlink(f"/proc/self/fd/{descriptor}")):
            raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fsync)
    replace_file(tmp_path / "a", lambda file: file.write(b"text"))
    assert (tmp_path / "a").read_bytes() == b"text" and os.listdir(tmp_path) == ["a"]
    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space left"):
        replace_file(tmp_path / "a", lambda file: file.write(b"more"))
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("failing", ["state-3.pt", "state-4.pt", "replay-"])
def test_a_disk_without_room_for_a_checkpoint_does_not_end_the_training(
    tmp_path, capsys, monkeypatch, unbroken, failing
):
    fsync, refused = os.fsync, []

    def full(descriptor):
        name = os.readlink(f"/proc/self/fd/{descriptor}")
        if failing in name and "seed=5" in name and len(refused) < 3:
            refused.append(name)
            no_space()
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    train(tmp_path, CHECKPOINTED)
    err = capsys.readouterr().err
    assert refused and err.count("no checkpoint at step") == len(refused) and "no space left on device" in err.lower()
    assert not list(tmp_path.rglob("*.tmp"))
    assert_identical(outcome(tmp_path), unbroken)


def test_parameters_that_do_not_fit_are_an_oserror_that_names_the_file(tmp_path, monkeypatch):
    writer = RunWriter(tmp_path / "run", {}, {}, eval_episodes=1)
    full = tmp_path / "run" / "best.pt.tmp"
    full.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device: '.*best.pt'"):
        writer.save_parameters("best", {"weight": torch.zeros(100_000)})
    assert not full.is_symlink() and not (tmp_path / "run" / "best.pt").exists()


def test_an_error_after_the_last_step_names_the_checkpoint_too(tmp_path, monkeypatch, capsys, unbroken):
    with monkeypatch.context() as patch:
        patch.setattr(RunWriter, "finish", no_space)
        with pytest.raises(OSError, match="No space"):
            train(tmp_path, CHECKPOINTED)
    assert "OSError (the same command resumes from step " in capsys.readouterr().err
    train(tmp_path, CHECKPOINTED)
    assert_identical(outcome(tmp_path), unbroken)


def test_checkpoints_that_did_not_fit_leave_the_seeds_with_a_moment_that_they_share(
    tmp_path, monkeypatch, unbroken, capsys
):
    """The files of seed 3 always fit on the disk, those of seed 5 never do."""
    first, second = break_off(tmp_path)
    fsync = os.fsync

    def full(descriptor):
        if "seed=5/checkpoint" in os.readlink(f"/proc/self/fd/{descriptor}"):
            no_space()
        fsync(descriptor)

    before = [[path.name for path in sorted(folder.glob("checkpoint/state-*"))] for folder in (first, second)]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        step = CheckpointFolder(first).read()[0][0].step
        capsys.readouterr()
        with pytest.raises(ZeroDivisionError):
            train(
                tmp_path,
                CHECKPOINTED.replace("checkpoint_every=10", "checkpoint_every=2"),
                Breaks(200, error=ZeroDivisionError()),
            )
    assert f"ZeroDivisionError (the same command resumes from step {step})" in capsys.readouterr().err
    after = [[path.name for path in sorted(folder.glob("checkpoint/state-*"))] for folder in (first, second)]
    assert after == before
    train(tmp_path, CHECKPOINTED)
    assert_identical(outcome(tmp_path), unbroken)


def test_after_a_checkpoint_that_did_not_fit_the_one_before_is_whole(tmp_path, monkeypatch, unbroken):
    def fill_disk():
        check()
        if check.calls == 90:
            monkeypatch.setattr(os, "fsync", no_space)

    check = Breaks(100, error=ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        train(tmp_path, CHECKPOINTED, fill_disk)
    monkeypatch.undo()
    train(tmp_path, CHECKPOINTED)
    assert_identical(outcome(tmp_path), unbroken)


def test_transitions_that_cannot_be_read_leave_the_run_as_it_is(tmp_path, monkeypatch, unbroken):
    """Tables and parameters are reset to the checkpoint only after the transitions of all seeds have been read."""

    def unreadable(checkpoint, *args):
        if "seed=5" in str(checkpoint.path):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(checkpoint.path))
        fill(checkpoint, *args)

    def left():
        names = ("evaluations.csv", "best.pt", "checkpoint/state-3.pt")
        return {path: (path.read_bytes(), path.stat().st_mtime_ns) for f in folders for path in map(f.joinpath, names)}

    folders, fill = break_off(tmp_path, calls=200), Checkpoint.fill
    before = left()
    for folder in folders:  # it has one evaluation more than its checkpoint
        (newest, _), _ = CheckpointFolder(folder).read()
        tables = newest.state()["tables"]
        assert tables["evaluations.csv"].count("\n") < (folder / "evaluations.csv").read_text().count("\n")
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoint, "fill", unreadable)
        assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}"]) == 2
    assert left() == before
    train(tmp_path, CHECKPOINTED)
    assert_identical(outcome(tmp_path), unbroken)


def test_a_result_that_cannot_be_written_ends_the_run_with_one_line_and_it_can_be_resumed(
    tmp_path, capsys, monkeypatch, unbroken
):
    def fill_disk(writer, name, row):
        path = writer.folder / name
        path.unlink()
        path.symlink_to("/dev/full")
        append(writer, name, row)

    append = RunWriter._append
    with monkeypatch.context() as patch:
        patch.setattr(RunWriter, "_append", fill_disk)
        assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}"]) == 2
    err = capsys.readouterr().err
    (table,) = [path for path in tmp_path.glob("*/*/seed=?/evaluations.csv") if path.is_symlink()]
    assert err.splitlines()[-1] == f"run.py: {table}: no space left on device" and "Traceback" not in err
    table.unlink()
    train(tmp_path, CHECKPOINTED)
    assert_identical(outcome(tmp_path), unbroken)
