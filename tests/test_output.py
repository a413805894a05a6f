"""A command's output may get lost: its work and its exit code do not depend on it."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import run_command, write_run

import plot
from store.checkpoint import saved_step
from store.folder import find_runs, is_finished, read_run
from sweep.train import train_words

ROOT = Path(__file__).parents[1]
SHORT = "algo=DPre env=R+N learning_starts=20 batch_size=4 hidden=[8,8] eval_every=500 eval_episodes=1 final_episodes=1"


def no_reader():
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w", buffering=1)


def full_disk():
    return open("/dev/full", "w", buffering=1)


def closed():
    stream = open(os.devnull, "w")  # noqa: SIM115
    stream.close()
    return stream


STREAMS = {"no reader": no_reader, "full disk": full_disk, "closed": closed, "none": lambda: None}


@pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS)
def test_a_broken_stream_ends_nothing(tmp_path, monkeypatch, stream):
    monkeypatch.setattr(sys, "stdout", stream())
    monkeypatch.setattr(sys, "stderr", stream())
    assert run_command(["--help"]) == run_command([]) == plot.main(["--help"]) == 0
    assert run_command(["algo=Nobody", "env=R+N"]) == 2
    assert run_command([*SHORT.split(), "steps=40", f"results={tmp_path}"]) == 0
    assert train_words(f"{SHORT} steps=40 seed=1 results={tmp_path}")
    assert all(read_run(folder).finished for folder in find_runs(tmp_path)) and len(find_runs(tmp_path)) == 2
    assert run_command(["status", str(tmp_path)]) == 0
    assert run_command(["algo=all", "env=all", "dry=true", f"results={tmp_path}"]) == 0
    assert plot.main([str(tmp_path), "format=md,png"]) == 0
    assert (tmp_path / "tables" / "rewards.md").exists() and list((tmp_path / "figures").glob("R+N*.png"))


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_that_lacks_a_character_gets_another_one(tmp_path, monkeypatch, encoding):
    for seed in range(2):
        write_run(tmp_path, "R+N", "DPre", seed, result=1.0)
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, encoding=encoding))
    assert plot.main([str(tmp_path), "format=csv"]) == 0
    assert run_command(["status", str(tmp_path)]) == 0
    assert run_command(["algo=DPre", "env=R+N", "seed=0,1", "steps=20000", "dry=true", f"results={tmp_path}"]) == 0
    assert b"DPre" in printed.getvalue() and b"?" in printed.getvalue()


@pytest.mark.parametrize("end", ["2>&1 | head -c 1", "<&- >&- 2>&-"])
def test_a_shell_that_does_not_listen(tmp_path, end):
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} run.py {SHORT} steps=40 results={tmp_path} {end}; exit ${{PIPESTATUS[0]}}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0 and not done.stderr
    (folder,) = find_runs(tmp_path)
    assert read_run(folder).finished
    assert not any(b"step/s" in path.read_bytes() for path in folder.iterdir())  # no file has the progress bar


def test_ctrl_c_that_ends_the_reader_first_leaves_a_checkpoint(tmp_path):
    words = [*SHORT.split(), "checkpoint_every=50", "steps=100000", f"results={tmp_path}"]
    process = subprocess.Popen(
        [sys.executable, "run.py", *words],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        # A shell that runs the tests in the background may ignore the signal, and child processes inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while not any(map(saved_step, find_runs(tmp_path))):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.stdout.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=120) == 130
    (folder,) = find_runs(tmp_path)
    assert saved_step(folder) and (folder / "last.pt").exists() and not is_finished(folder)
