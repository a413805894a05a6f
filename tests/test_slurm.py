"""Sweeps on a real Slurm of one node: time limits, signals, kills, requeues, and what comes out in the end.

`tests/slurm/single_node.sh start` brings one up; `.ci/run` does.
"""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import assert_identical, outcome_of, run_command

from store.checkpoint import saved_step
from store.folder import find_runs, is_finished
from store.slurm import queue
from sweep.states import Stage, state_of
from sweep.status import find_cells

ROOT = Path(__file__).parents[1]
CELLS = "algo=DPre,SRad,NFW,DAlpha,SPre+ env=R+N seed=3,5"
WORDS = (
    f"{CELLS} steps=6000 learning_starts=100 batch_size=4 hidden=[8,8] eval_every=2000 eval_episodes=1"
    " final_episodes=1 checkpoint_every=50 train_freq=1 gradient_steps=1"
)
# Slurm looks at time limits twice a minute, and may send the signal half a minute early.
SLURM = "launcher=slurm slurm.hours=0.033 slurm.signal=USR2@30 slurm.comment=a_test"
PATIENCE = 900.0
"""Seconds until the test gives up; on two cores it takes some 160, on busy ones twice as long."""


def reason_to_skip():
    if not shutil.which("sbatch"):
        return "Slurm is not installed"
    nodes = subprocess.run(["sinfo", "--noheader", "--format=%n %T"], capture_output=True, text=True, timeout=60)
    if nodes.returncode:
        return f"Slurm does not answer: {nodes.stderr.strip().splitlines()[-1]}"
    names = {line.split()[0] for line in nodes.stdout.splitlines()}
    if names != {socket.gethostname().partition(".")[0]}:
        return "Slurm's nodes are others than this machine, and do not see the test's files"
    return None


@pytest.fixture
def slurm():
    """Skips where there is no Slurm, and leaves no jobs behind."""
    pytest.importorskip("submitit", reason="submitit is not installed")
    if reason := reason_to_skip():
        pytest.skip(reason)
    jobs = []
    yield jobs
    for job in jobs:
        subprocess.run(["scancel", job], timeout=60)


def submit(root, jobs):
    """Give the command once more, as from a shell; how many jobs it submitted."""
    command = [sys.executable, "run.py", *WORDS.split(), *SLURM.split(), f"results={root}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    if "nothing to submit" in done.stdout:
        return 0
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("submitted ")]
    jobs.append(line.split()[4])
    return int(line.split()[1])


class Fault:
    """Something that happens to a cell's job, once the cell has a checkpoint."""

    def __init__(self, cell):
        self.cell, self.stage, self.first = cell, 0, None

    @property
    def job(self):
        return self.cell.read("job")["job"]

    def is_queued(self):
        return self.job in queue([self.job])

    def owner(self):
        """The process that trains the cell, as its lock describes it; None where there is none."""
        lock = self.cell.folders[0].with_name("seed=3.lock")
        try:
            return json.loads(lock.read_text())
        except (FileNotFoundError, ValueError):
            return None

    def send(self, *signals):
        # Not waited for: scancel tries for a minute where a job is just being requeued.
        self.senders = [
            subprocess.Popen(["scancel", f"--signal={name}", self.job], stderr=subprocess.DEVNULL) for name in signals
        ]

    def advance(self):
        folder = self.cell.folders[0]
        if self.stage == 0 and saved_step(folder) > 0 and not is_finished(folder) and self.owner():
            self.first, self.struck = self.job, self.owner()["pid"]
            self.strike()
            self.stage = 1
        elif self.stage == 1 and self.follow_up():
            self.stage = 2


class Requeued(Fault):
    """Cancelled, which must not bring it back, and then put back into the queue by its owner."""

    def strike(self):
        self.send("KILL")

    def follow_up(self):
        if self.is_queued():
            return False
        assert state_of(self.cell, {}).stage is Stage.INTERRUPTED
        return not subprocess.run(["scontrol", "requeue", self.job], timeout=60).returncode


class Resubmitted(Fault):
    """Killed without warning, and found by the next command to be neither finished nor queued."""

    def __init__(self, cell, root, jobs):
        super().__init__(cell)
        self.root, self.jobs = root, jobs

    def strike(self):
        os.kill(self.struck, signal.SIGKILL)

    def follow_up(self):
        return not self.is_queued() and submit(self.root, self.jobs) >= 1 and self.job != self.first


class Preempted(Fault):
    """Told that its node is wanted: by SIGTERM, and then by the signal that it has asked for."""

    def strike(self):
        self.send("TERM", "USR2")

    def follow_up(self):
        if self.owner() and self.owner()["pid"] == self.struck:
            return False
        for sender in self.senders:
            sender.kill()  # what it still tries is meant for a process that has ended
        return True


class OutOfTime(Fault):
    """Held up until Slurm says that its time is almost over, and let go on then: it has a checkpoint to write."""

    def strike(self):
        os.kill(self.struck, signal.SIGSTOP)

    def follow_up(self):
        try:
            status = Path(f"/proc/{self.struck}/status").read_text()
            pending = int(next(line.split()[1] for line in status.splitlines() if line.startswith("ShdPnd")), 16)
            if pending & 1 << (signal.SIGUSR2 - 1):
                os.kill(self.struck, signal.SIGCONT)  # not every Slurm does that itself
            return False
        except (FileNotFoundError, ProcessLookupError):
            return True


def test_cells_that_are_killed_preempted_or_out_of_time_end_as_on_one_machine(tmp_path, slurm, capsys):
    root = tmp_path / "cluster"
    assert submit(root, slurm) == 5
    assert submit(root, slurm) == 0  # as all are queued
    cells = {cell.variant.partition(",")[0]: cell for cell in find_cells(root)}
    assert cells.keys() == {"DPre", "SRad", "NFW", "DAlpha", "SPre+"}
    faults = {
        "OutOfTime": OutOfTime(cells["NFW"]),
        "Requeued": Requeued(cells["SRad"]),
        "Resubmitted": Resubmitted(cells["DAlpha"], root, slurm),
        "Preempted": Preempted(cells["SPre+"]),
    }
    deadline = time.monotonic() + PATIENCE
    while not all(is_finished(folder) for cell in cells.values() for folder in cell.folders):
        if time.monotonic() > deadline:
            logs = "".join(path.read_text() for path in sorted(root.glob("sweep/slurm/*.err")))
            pytest.fail(f"stages {[(name, f.stage) for name, f in faults.items()]}\n{logs[-5000:]}")
        for fault in faults.values():
            fault.advance()
        time.sleep(0.2)

    for fault in faults.values():
        assert fault.stage == 2
        info = json.loads((fault.cell.folders[0] / "info.json").read_text())
        assert len(info["resumed"]) >= 1 and info["resumed"][0]["step"] > 0
        assert info["command"].startswith("run.py algo=")
    assert faults["Preempted"].job == faults["Preempted"].first and faults["OutOfTime"].job == faults["OutOfTime"].first
    assert run_command([*WORDS.split(), "threads=1", f"results={tmp_path / 'local'}"]) == 0
    capsys.readouterr()
    assert run_command(["status", str(root)]) == 0
    assert "5 cells: 5 finished" in capsys.readouterr().out
    outcomes = [
        {str(folder.relative_to(tree)): outcome_of(folder) for folder in find_runs(tree)}
        for tree in (tmp_path / "local", root)
    ]
    assert len(outcomes[0]) == 10
    assert_identical(*outcomes)
    assert submit(root, slurm) == 0
