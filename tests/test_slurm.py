"""Sweeps on a real Slurm of one node: time limits, signals, kills, requeues, and the final results.

`tests/slurm/single_node.sh start` starts such a Slurm; `.ci/run` calls it.
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
ALGOS = "DPre,SRad,NFW,DAlpha,SPre+"
STEPS = 4000
WORDS = (
    f"env=R+N seed=3,5 steps={STEPS} learning_starts=100 batch_size=4 hidden=[8,8] eval_every=2000 eval_episodes=1"
    " final_episodes=1 checkpoint_every=50 train_freq=1 gradient_steps=1"
)
# Slurm looks at time limits twice a minute, and may send the signal half a minute early.
SLURM = "launcher=slurm slurm.hours=0.033 slurm.signal=USR2@30 slurm.comment=a_test"
PATIENCE = 900.0
"""Seconds until the test gives up. On two cores it takes about 160 seconds, on busy ones twice as long."""


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
    """Skips the test without Slurm, and leaves no jobs behind."""
    pytest.importorskip("submitit", reason="submitit is not installed")
    if reason := reason_to_skip():
        pytest.skip(reason)
    jobs = []
    yield jobs
    for job in jobs:
        subprocess.run(["scancel", job], timeout=60)


def submit(root, jobs, algos=ALGOS):
    """Run the command again, as from a shell. Returns the number of jobs that it submitted."""
    command = [sys.executable, "run.py", f"algo={algos}", *WORDS.split(), *SLURM.split(), f"results={root}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    if "nothing to submit" in done.stdout:
        return 0
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("submitted ")]
    jobs.append(line.split()[4])
    return int(line.split()[1])


def status_of(pid):
    """The fields of /proc/<pid>/status, by name; empty once the process is gone."""
    try:
        return dict(line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    except (FileNotFoundError, ProcessLookupError):
        return {}


def birth_of(pid):
    """When the process started, in ticks of the clock; None once it is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (FileNotFoundError, ProcessLookupError):
        return None


class Fault:
    """A fault that hits a cell's job between a tenth and half of its steps.

    The process is stopped before the fault, and continues once the signals of `awaited` are pending. So the fault hits
    at that point, after complete checkpoints, however fast the job and however slow Slurm is. A run that ended before
    it could be stopped is deleted and submitted again.
    """

    awaited = ()

    def __init__(self, cell, root, jobs):
        self.cell, self.root, self.jobs = cell, root, jobs
        self.stage, self.first, self.struck, self.born, self.senders = 0, None, None, None, []

    @property
    def job(self):
        return self.cell.read("job")["job"]

    def is_queued(self):
        return self.job in queue([self.job])

    def owner(self):
        """The id of the process that trains the cell, from its lock; None if there is none."""
        lock = self.cell.folders[0].with_name("seed=3.lock")
        try:
            return json.loads(lock.read_text())["pid"]
        except (FileNotFoundError, ValueError):
            return None

    def submit(self):
        return submit(self.root, self.jobs, self.cell.variant.partition(",")[0])

    def send(self, *signals):
        # Do not wait: scancel repeats a signal to a job of an array for a minute.
        self.senders = [
            subprocess.Popen(["scancel", f"--signal={name}", self.job], stderr=subprocess.DEVNULL) for name in signals
        ]

    def advance(self):
        if self.stage == 0 and self.holds():
            self.first = self.job
            self.strike()
            self.stage = 1
        elif self.stage == 1:
            pending = 0 if self.is_gone() else int(status_of(self.struck).get("ShdPnd", "0"), 16)
            if self.awaited and all(pending & 1 << (signum - 1) for signum in self.awaited):
                for sender in self.senders:
                    sender.kill()
                    sender.wait()
                os.kill(self.struck, signal.SIGCONT)  # not every Slurm sends SIGCONT itself
            if self.follow_up():
                self.stage = 2

    def is_gone(self):
        """Whether the struck process has ended. Another process may have its id by now."""
        return birth_of(self.struck) != self.born

    def is_in_reach(self):
        return STEPS // 10 <= saved_step(self.cell.folders[0]) <= STEPS // 2

    def holds(self):
        """Stop the cell's process. Returns whether it has stopped in the range of steps where the fault may hit."""
        folder, pid = self.cell.folders[0], self.owner()
        if is_finished(folder):
            if not self.is_queued():  # it ended before it was stopped: start again
                for folder in self.cell.folders:
                    shutil.rmtree(folder)
                assert self.submit() == 1
            return False
        if not pid or not self.is_in_reach():
            return False
        self.struck, self.born = pid, birth_of(pid)
        os.kill(pid, signal.SIGSTOP)
        while not status_of(pid).get("State", "T").startswith("T"):
            time.sleep(0.01)
        if pid == self.owner() and self.is_in_reach():
            return True
        if status_of(pid):
            os.kill(pid, signal.SIGCONT)
        return False


class Requeued(Fault):
    """The job is cancelled, after which it must not requeue itself, and then requeued by its owner."""

    def strike(self):
        # Slurm continues a cancelled process and ends it by SIGTERM a moment later. Here SIGTERM is pending already.
        os.kill(self.struck, signal.SIGTERM)
        self.send("KILL")

    def follow_up(self):
        if self.is_queued():
            return False
        assert state_of(self.cell, {}).stage is Stage.INTERRUPTED
        return not subprocess.run(["scontrol", "requeue", self.job], timeout=60).returncode


class Resubmitted(Fault):
    """The job is killed without warning. The next command finds it neither finished nor queued."""

    def strike(self):
        os.kill(self.struck, signal.SIGKILL)

    def follow_up(self):
        return not self.is_queued() and self.submit() == 1 and self.job != self.first


class Preempted(Fault):
    """The job is told that its node is wanted, by SIGTERM and by the signal that it has requested."""

    awaited = (signal.SIGTERM, signal.SIGUSR2)

    def strike(self):
        self.send("TERM", "USR2")

    def follow_up(self):
        return self.is_gone()


class OutOfTime(Fault):
    """The job is stopped until Slurm signals that its time is almost over. It must then write a checkpoint."""

    awaited = (signal.SIGUSR2,)

    def strike(self):
        pass

    def follow_up(self):
        return self.is_gone()


def test_cells_that_are_killed_preempted_or_out_of_time_end_as_on_one_machine(tmp_path, slurm, capsys):
    root = tmp_path / "cluster"
    assert submit(root, slurm) == 5
    assert submit(root, slurm) == 0  # as all are queued
    cells = {cell.variant.partition(",")[0]: cell for cell in find_cells(root)}
    assert cells.keys() == {"DPre", "SRad", "NFW", "DAlpha", "SPre+"}
    faults = {
        "OutOfTime": OutOfTime(cells["NFW"], root, slurm),
        "Requeued": Requeued(cells["SRad"], root, slurm),
        "Resubmitted": Resubmitted(cells["DAlpha"], root, slurm),
        "Preempted": Preempted(cells["SPre+"], root, slurm),
    }
    deadline = time.monotonic() + PATIENCE
    while not (
        all(fault.stage == 2 for fault in faults.values())
        and all(is_finished(folder) for cell in cells.values() for folder in cell.folders)
    ):
        if time.monotonic() > deadline:
            logs = "".join(path.read_text() for path in sorted(root.glob("sweep/slurm/*.err")))
            pytest.fail(f"stages {[(name, f.stage) for name, f in faults.items()]}\n{logs[-5000:]}")
        for fault in faults.values():
            fault.advance()
        time.sleep(0.2)

    for fault in faults.values():
        info = json.loads((fault.cell.folders[0] / "info.json").read_text())
        assert len(info["resumed"]) >= 1 and info["resumed"][0]["step"] > 0
        assert "submitit" in info["command"] and info["cell"].startswith("algo=")
    assert faults["Preempted"].job == faults["Preempted"].first and faults["OutOfTime"].job == faults["OutOfTime"].first
    assert run_command([f"algo={ALGOS}", *WORDS.split(), "threads=1", f"results={tmp_path / 'local'}"]) == 0
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
