"""Policies of runs: `algos.load_policy`, and `run.py play` with its video."""

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
import yaml
from helpers import break_off, run_command, train

import envs
from algos import load_policy
from constraints import Ball
from core.random import stream_seed
from core.words import ConfigError
from envs import TASKS, TOLERANCE, Task
from store.checkpoint import CheckpointFolder
from store.folder import find_runs, read_run
from sweep.play import new_video

ROOT = Path(__file__).parents[1]
SHORT = "steps=40 learning_starts=20 batch_size=4 hidden=[8,8] eval_every=20 eval_episodes=1 final_episodes=1"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run of seed 3 on a task with a two-dimensional set that depends on the state."""
    root = tmp_path_factory.mktemp("finished")
    train(root, f"algo=DRad env=R+M seed=3 {SHORT}")
    (folder,) = find_runs(root)
    return folder


def parameters_of(policy):
    return policy.agent.state(0)


def assert_equal(one, other):
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


# ---------------------------------------------------------------- load_policy


@pytest.mark.parametrize(
    "algo, task", [("DRad", "R+M"), ("DPre", "R+T"), ("SAlpha", "R+L2"), ("SGauge", "R+O10"), ("ARAM", "R+L2")]
)
def test_the_policy_is_the_one_that_the_run_was_judged_by(algo, task, tmp_path):
    train(tmp_path, f"algo={algo} env={task} seed=3 {SHORT}")
    (folder,) = find_runs(tmp_path)
    policy, env = load_policy(folder), envs.make(task)
    env.reset(seed=stream_seed(3, "evaluation", 0))
    returns = []
    for _ in range(3):  # two evaluations and the final result have an episode each
        (obs, _), total, over = env.reset(), 0.0, False
        while not over:
            action = policy(obs)
            assert action.shape == (2,) and action.dtype == np.float32
            obs, reward, terminated, truncated, _ = env.step(action)
            total, over = total + reward, terminated or truncated
        returns.append(total)
    assert returns[2] == read_run(folder).result["return_mean"]


@pytest.mark.parametrize("which", ["best", "last"])
def test_best_and_last_are_those_of_the_files(finished, which):
    saved = torch.load(finished / f"{which}.pt", weights_only=True)
    assert_equal(parameters_of(load_policy(finished, which)), saved)


def test_one_observation_or_many(finished):
    policy, obs = load_policy(finished), np.random.default_rng(0).normal(size=(5, 9))
    actions = policy(obs)
    assert actions.shape == (5, 2)
    assert np.allclose(actions, [policy(row) for row in obs], atol=1e-6)
    assert policy.constraint is envs.constraint("R+M")
    assert policy.constraint.violation(torch.from_numpy(obs), torch.from_numpy(actions)).max() <= TOLERANCE
    for wrong in (np.zeros(8), np.zeros((2, 3, 9)), np.float64(0.0)):
        with pytest.raises(ValueError, match=r"expected observations \(9,\) or \(m, 9\), got shape"):
            policy(wrong)


def test_an_unfinished_run_has_the_policy_of_its_newest_checkpoint(tmp_path):
    for folder in break_off(tmp_path, 300):  # after the first evaluation
        newest = CheckpointFolder(folder).read()[0][0]
        policy = load_policy(folder, "last")
        assert_equal(parameters_of(policy), newest.state()["agent"]["parameters"])
        assert policy(np.zeros(9)).shape == (2,)
        assert_equal(parameters_of(load_policy(folder)), torch.load(folder / "best.pt", weights_only=True))


def test_it_needs_neither_the_working_directory_nor_an_import_of_the_tasks(finished, tmp_path):
    code = (
        f"import numpy; from algos import load_policy; print(load_policy({str(finished)!r})(numpy.zeros(9)).tolist())"
    )
    process = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.strip() == str(load_policy(finished)(np.zeros(9)).tolist())


def test_a_run_of_a_task_of_ones_own(tmp_path, monkeypatch):
    monkeypatch.setitem(TASKS, "R+Own", Task(TASKS["R+M"].robot, envs.constraint("R+L2"), "own", "own", 40))
    train(tmp_path, f"algo=DAlpha env=R+Own seed=0 {SHORT}")
    (folder,) = find_runs(tmp_path)
    assert load_policy(folder).constraint is envs.constraint("R+L2")
    monkeypatch.delitem(TASKS, "R+Own")
    with pytest.raises(ConfigError, match=r"unknown task 'R\+Own'"):
        load_policy(folder)


def test_a_policy_of_a_task_that_has_changed_says_so(tmp_path, monkeypatch):
    robot = TASKS["R+M"].robot
    monkeypatch.setitem(TASKS, "R+Own", Task(robot, Ball(0.05, 2), "own", "own", 40))
    train(tmp_path, f"algo=DAlpha env=R+Own seed=0 {SHORT}")
    (folder,) = find_runs(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_policy(folder)
    monkeypatch.delitem(TASKS, "R+Own")
    monkeypatch.setitem(TASKS, "R+Own", Task(robot, Ball(0.9, 2), "own", "own", 40))
    with pytest.warns(UserWarning, match="another definition of its task: .*bound: 0.05 then, 0.9 now"):
        load_policy(folder)


@pytest.mark.parametrize(
    "content, said",
    [
        (b"", "is damaged: EOFError"),
        ([1, 2], "is not a dict of tensors"),
        (torch.ones(3), "is not a dict of tensors"),
        ({"actor.layers.0.weight": [1.0]}, "is not a dict of tensors"),
    ],
)
def test_parameters_that_are_none_are_refused(finished, tmp_path, content, said):
    copied = shutil.copytree(finished, tmp_path / "seed=0")
    if isinstance(content, bytes):
        (copied / "best.pt").write_bytes(content)
    else:
        torch.save(content, copied / "best.pt")
    with pytest.raises(ConfigError, match=said):
        load_policy(copied)


@pytest.mark.parametrize("key, value, said", [("env", None, "not the folder of a run"), ("hidden", "big", "bad conf")])
def test_configurations_that_are_none_are_refused(finished, tmp_path, key, value, said):
    copied = shutil.copytree(finished, tmp_path / "seed=0")
    settings = yaml.safe_load((copied / "config.yaml").read_text())
    (copied / "config.yaml").write_text(yaml.safe_dump(settings | {key: value}))
    with pytest.raises(ConfigError, match=said):
        load_policy(copied)


def test_what_is_no_policy_is_refused(finished, tmp_path):
    def refused(folder, which="best"):
        with pytest.raises(ConfigError) as error:
            load_policy(folder, which)
        assert "\n" not in str(error.value)
        return str(error.value)

    assert "choices: best, last" in refused(finished, "newest")
    assert "is not the folder of a run" in refused(finished.parent)
    assert "is not the folder of a run" in refused(tmp_path / "nothing")
    copy = tmp_path / "seed=3"
    copy.mkdir()
    (copy / "config.yaml").write_text((finished / "config.yaml").read_text())
    assert "no best parameters: no evaluation yet" in refused(copy)
    assert "no last parameters: no checkpoint yet" in refused(copy, "last")
    (copy / "best.pt").write_bytes((finished / "best.pt").read_bytes()[:-100])
    assert "best.pt is damaged" in refused(copy)
    torch.save({"actor.weight": torch.zeros(3)}, copy / "last.pt")
    assert "does not fit the networks" in refused(copy, "last")
    (copy / "config.yaml").write_text("algo: DRat\nenv: R+M\n")
    assert "did you mean DRad?" in refused(copy)


# ---------------------------------------------------------------- play


def frames_of(path):
    """The video as an array (k, h, w, 3), and its frames a second."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return np.array([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]), meta["fps"]


def test_play_prints_returns_that_repeat(finished, capsys):
    assert run_command(["play", str(finished)]) == 0
    out = capsys.readouterr().out
    assert [line.split()[1] for line in out.splitlines()[:-1]] == ["1:", "2:", "3:"]
    returns = [float(line.split()[3]) for line in out.splitlines()[:-1]]
    assert len(set(returns)) == 3 and f"mean return {np.mean(returns):.1f}"[:-1] in out
    assert run_command(["play", str(finished)]) == 0
    assert capsys.readouterr().out == out


def test_play_films_every_step_with_the_set_drawn_in(finished, tmp_path, capsys):
    video = tmp_path / "two.mp4"
    assert run_command(["play", str(finished), "episodes=2", f"video={video}"]) == 0
    assert f"{video}: " in capsys.readouterr().out
    frames, fps = frames_of(video)
    steps = TASKS["R+M"].robot.max_episode_steps
    assert frames.shape == (2 * (steps + 1), 480, 480, 3)
    assert fps == pytest.approx(TASKS["R+M"].robot.fps, rel=0.01)
    green = np.abs(frames[:, 11:137, 343:469].astype(int) - (196, 230, 200)).max(-1) < 12
    assert (green.mean((1, 2)) > 0.3).all(), "each picture has the feasible set in its corner"
    moved = [np.abs(one.astype(int) - other).max() for one, other in zip(frames[:-1], frames[1:], strict=True)]
    assert np.mean(np.array(moved) > 30) > 0.8
    before = video.read_bytes()
    assert run_command(["play", str(finished), f"video={video}"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert video.read_bytes() == before


def test_play_of_an_unfinished_run_from_another_folder(tmp_path, capsys, monkeypatch):
    folder = break_off(tmp_path)[0]
    monkeypatch.chdir(folder)
    assert run_command(["play", ".", "which=last", "episodes=1"]) == 0
    assert "mean return" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, said",
    [
        ([], "expected the folder of a run first (run.py play FOLDER"),
        (["video=a.mp4"], "expected the folder of a run first"),
        (["nothing"], "nothing is not the folder of a run"),
        (["RUN", "episodes=0"], "bad value '0' for episodes"),
        (["RUN", "episode=1"], "did you mean episodes?"),
        (["RUN", "which=newest"], "unknown parameters 'newest'"),
        (["RUN", "video=a.gif"], "ends in .mp4"),
        (["RUN", "video=nowhere/a.mp4"], "there is no folder nowhere"),
    ],
)
def test_wrong_words_are_one_line(finished, tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert run_command(["play", *(str(finished) if word == "RUN" else word for word in words)]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_video_without_its_library_says_what_to_install(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert run_command(["play", str(finished), f"video={tmp_path / 'a.mp4'}"]) == 2
    assert "pip install imageio-ffmpeg" in capsys.readouterr().err
    assert run_command(["play", str(finished), "episodes=1"]) == 0


def test_a_video_that_breaks_off_leaves_no_file(tmp_path):
    path = tmp_path / "broken.mp4"
    with pytest.raises(ZeroDivisionError), new_video(path, 30) as film:
        for _ in range(3):
            film(np.zeros((32, 32, 3), np.uint8))
        raise ZeroDivisionError
    assert not path.exists()


def test_checkpoints_are_read_and_never_written(tmp_path):
    folder = break_off(tmp_path, 300)[0]
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    load_policy(folder, "last")
    assert run_command(["play", str(folder), "episodes=1"]) == 0
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
