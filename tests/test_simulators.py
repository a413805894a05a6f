"""The choice of a simulator on the command line, and checkpoints of another version, as a user sees them."""

import hashlib
import io
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers import run_command

import envs
from constraints import Ball
from envs import TASKS, Task
from envs.locomotion import HalfCheetah
from envs.reacher import MANY, Reacher
from store.folder import read_results

ROOT = Path(__file__).resolve().parent.parent
SHORT = "learning_starts=16 batch_size=4 hidden=[8] eval_every=30 eval_episodes=1 final_episodes=1"
BLOCKED = "import runpy, sys; sys.modules['pybullet'] = None; runpy.run_path('run.py', run_name='__main__')"


def run(words, *program):
    command = [sys.executable, *(program or ["run.py"]), *words.split()]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)


def test_a_simulator_that_the_robot_does_not_have_is_one_line():
    for words, said in (
        ("env=R+N simulator=mujoco", "unknown simulator of R+N 'mujoco' (choices: closed-form, pybullet)"),
        ("env=R+N,W+M simulator=foo jobs=2", "unknown simulator of R+N 'foo' (choices: closed-form, pybullet)"),
        ("env=W+M simulator=pybullet", "simulator does not apply to DPre on W+M"),
    ):
        done = run(f"algo=DPre {words}")
        assert (done.returncode, done.stdout, done.stderr) == (2, "", f"run.py: {said}\n")


def test_pybullet_where_it_is_not_installed_is_one_line(tmp_path):
    done = run(f"algo=DPre env=R+N simulator=pybullet results={tmp_path}", "-c", BLOCKED)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert (
        "run.py: simulator 'pybullet' needs the package pybullet, which has wheels for Linux on x86-64 with"
        in done.stderr
    )
    assert not list(tmp_path.iterdir())


def test_pybullet_trains_as_the_closed_form_does(tmp_path):
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    evaluations = []
    for simulator in ("closed-form", "pybullet"):
        words = f"algo=DPre env=R+L2,H+M steps=30 {SHORT} simulator={simulator} results={tmp_path / simulator}"
        assert run(words).returncode == 0
        for task, expected in (("R+L2", simulator), ("H+M", None)):  # a key applies to tasks that have it
            (folder,) = (tmp_path / simulator / task).glob("*/seed=0")
            assert yaml.safe_load((folder / "config.yaml").read_text())["simulator"] == expected
            assert "simulator" not in folder.parent.name
        (file,) = (tmp_path / simulator).glob("R+L2/*/seed=0/evaluations.csv")
        evaluations.append(float(file.read_text().splitlines()[-1].split(",")[1]))
    assert evaluations[0] == pytest.approx(evaluations[1], abs=1e-4)


def interrupt(words, root):
    """Start the command, and end it with SIGTERM when it has a checkpoint. Returns the files of its state."""
    process = subprocess.Popen([sys.executable, "run.py", *words.split()], cwd=ROOT, stderr=subprocess.DEVNULL)
    while not list(root.glob("R+N/*/seed=0/checkpoint/state-*.pt")):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    return list(root.glob("R+N/*/seed=?/checkpoint/state-*.pt"))


def make_old(states):
    """Remove the format number from these files. Files of the first version have none."""
    for path in states:
        content = torch.load(io.BytesIO(path.read_bytes().partition(b"\n")[2]), weights_only=True)
        del content["format"]
        torch.save(content, body := io.BytesIO())
        path.write_bytes(hashlib.sha256(body.getvalue()).hexdigest().encode() + b"\n" + body.getvalue())


LONG = f"algo=DPre env=R+N steps=1000000 checkpoint_every=40 {SHORT}".replace("eval_every=30", "eval_every=1000")


def test_a_checkpoint_of_another_version_is_refused_and_can_be_overwritten(tmp_path):
    words = f"{LONG} results={tmp_path}"
    states = interrupt(words, tmp_path)
    make_old(states)
    done = run(words)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "was written by another version of this code" in done.stderr and "overwrite=true" in done.stderr
    assert all(path.exists() for path in states)
    assert run(f"{words} overwrite=true".replace("steps=1000000", "steps=30")).returncode == 0


def test_a_finished_seed_does_not_need_its_checkpoint_of_another_version(tmp_path):
    words = f"{LONG} results={tmp_path}"
    states = interrupt(words, tmp_path)
    make_old(states)
    result = states[0].parents[1] / "result.json"
    result.write_text('{"return_mean": 1.5, "returns": [1.5]}')
    done = run(words)
    assert done.returncode == 0 and "already finished" in done.stdout, done.stderr


def test_a_run_does_not_change_its_simulator(tmp_path):
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    words = f"{LONG} results={tmp_path}"
    states = interrupt(words, tmp_path)
    config = states[0].parents[1] / "config.yaml"
    before = config.read_text()
    done = run(f"{words} simulator=pybullet")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "started with simulator=closed-form, but this command has simulator=pybullet" in done.stderr
    assert config.read_text() == before


def test_a_resumed_run_tells_that_its_threads_have_changed(tmp_path):
    words = f"{LONG} results={tmp_path}"
    interrupt(f"{words} threads=2", tmp_path)
    process = subprocess.Popen(
        [sys.executable, "run.py", *words.split(), "threads=1"], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    said = [process.stdout.readline() for _ in range(2)]
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    assert "resuming from step" in said[0] and "threads=1 now, 2 before: equal to an uninterrupted run" in said[1]


class SlowArm(Reacher):
    def step(self, action):
        obs, reward, terminated, info = super().step(0.0 * action)
        return obs, reward - 7.0, terminated, info


class SlowCheetah(HalfCheetah):
    def step(self, action):
        obs, reward, terminated, info = super().step(0.0 * action)
        return obs, reward - 7.0, terminated, info


def test_a_class_that_derives_from_a_robot_runs_itself(tmp_path, monkeypatch):
    """The choice of simulators that it inherits names only its base class."""
    monkeypatch.setitem(TASKS, "R+Slow", Task(SlowArm, Ball(0.05, 2), "", "", 40))
    assert isinstance(envs.make("R+Slow").robot, SlowArm)
    words = "algo=DPre env=R+Slow steps=40 learning_starts=30 batch_size=4 hidden=[4] eval_every=20 eval_episodes=1"
    assert run_command([*words.split(), "final_episodes=1", f"results={tmp_path}"]) == 0
    (run,) = read_results(tmp_path)[0]
    assert run.result["return_mean"] < -6.0 * 150 and run.config["simulator"] is None


@pytest.mark.parametrize("robot", [SlowArm, SlowCheetah])
def test_a_step_that_a_derived_class_changes_is_also_taken_together(robot):
    """Even if the base class has a faster method for many robots."""
    robots = [robot() for _ in range(MANY)]
    for number, each in enumerate(robots):
        each.reset(np.random.default_rng(number))
    rewards = [step[1] for step in robot.step_together(robots, np.ones((MANY, robot.action_dim)))]
    assert max(rewards) < -3.0
