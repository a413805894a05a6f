"""The training of a cell's flow, before its seeds: once, interrupted, resumed, damaged, shared."""

import json
import re
import shutil
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import Breaks, assert_identical, config_of, outcome, run_command, train, train_through

import envs
from algos import ALGORITHMS, load_policy
from bench import flows as flows_benchmark
from constraints import LinearConstraint
from core import flow_training
from core.flow import Flow
from envs import Task
from envs.reacher import Reacher
from store import tensors
from store.files import replace_file
from store.folder import find_runs, read_run
from store.interrupt import Interrupted
from store.lock import run_lock
from store.tensors import load_tensors
from sweep import flows
from sweep.definition import define

pytestmark = pytest.mark.usefixtures("small_flows")

WORDS = (
    "algo=DFlow env=R+O10 seed=3,5 steps=80 learning_starts=20 batch_size=8 hidden=[8,8] train_freq=1 gradient_steps=1"
    " eval_every=40 eval_episodes=1 final_episodes=1"
)
SAC_WORDS = WORDS.replace("DFlow", "SFlow").replace("R+O10", "H+M")


def flow_folders(root):
    return sorted(path for path in root.glob("flows/*/*") if path.is_dir())


def folder_of(root, words=WORDS):
    config = config_of(f"{words} results={root}")
    flow = ALGORITHMS[config.algo].map.configured(config)
    return flows.FlowFolder(config, flow, define(config.env, config.algo)["task"])


def clock(sleep):
    """A stand-in for the module `time`."""
    return SimpleNamespace(sleep=sleep, perf_counter=time.perf_counter)


@pytest.mark.parametrize("words", [WORDS, SAC_WORDS], ids=["DFlow", "SFlow"])
def test_interrupted_anywhere_it_ends_with_the_bits_of_an_unbroken_run(tmp_path, capsys, words):
    """Interrupts random play, the training of the flow, warm-up, gradient steps and evaluations."""
    whole = Breaks()
    train(tmp_path / "whole", words, whole)
    # After the first break, random play ends after about 15 calls, and the flow's training after about 40.
    check = Breaks(5, 30, *range(60, whole.calls, whole.calls // 9))
    assert train_through(tmp_path / "broken", words, check) >= 8
    said = capsys.readouterr().err
    assert re.search(r"interrupted at step 0 of \S+/flows/", said)  # in random play
    assert re.search(r"interrupted at step [1-9]\d? of \S+/flows/", said)
    assert_identical(outcome(tmp_path / "whole"), outcome(tmp_path / "broken"))
    one, other = (flow_folders(tmp_path / root)[0] for root in ("whole", "broken"))
    assert one.name == other.name and {path.name for path in other.iterdir()} == {path.name for path in one.iterdir()}
    first, second = (load_tensors(folder / "flow.pt")["state"] for folder in (one, other))
    assert all(torch.equal(first[name], second[name]) for name in first)
    first, second = (np.loadtxt(folder / "training.csv", delimiter=",", skiprows=1) for folder in (one, other))
    assert np.array_equal(np.delete(first, 1, axis=1), np.delete(second, 1, axis=1))  # all but the seconds


def test_a_seed_learns_the_same_alone_and_in_lockstep(tmp_path):
    """Seeds share the flow and nothing else."""
    for root, seeds in (("together", "3,5"), ("alone", "5")):
        train(tmp_path / root, SAC_WORDS.replace("3,5", seeds))
    last = {}
    for root in ("together", "alone"):
        (run,) = (folder for folder in find_runs(tmp_path / root) if folder.name == "seed=5")
        last[root] = torch.load(run / "last.pt", weights_only=True)
    assert last["together"].keys() == last["alone"].keys() and any(name.startswith("map.") for name in last["alone"])
    for name, value in last["alone"].items():
        torch.testing.assert_close(last["together"][name], value, rtol=1e-3, atol=1e-3)


def test_a_flow_is_trained_once_for_a_task_and_settings(tmp_path, monkeypatch):
    train(tmp_path, WORDS.replace("3,5", "3"))
    (folder,) = flow_folders(tmp_path)
    assert {path.name for path in folder.iterdir()} == {"settings.json", "training.csv", "flow.pt"}
    with monkeypatch.context() as patched:
        patched.setattr(flows, "FlowTraining", lambda *arguments: pytest.fail("trained again"))
        train(tmp_path, WORDS.replace("3,5", "5"))
        train(tmp_path, WORDS.replace("DFlow", "SFlow"))
        train(tmp_path, WORDS.replace("DFlow", "SFlow") + " flow_entropy=action")
    train(tmp_path, f"{WORDS} flow=mle")
    train(tmp_path, f"{WORDS} flow_steps=21")
    assert len(flow_folders(tmp_path)) == 3
    monkeypatch.setattr(envs.TASKS["R+O10"].constraint, "bound", 0.9)  # changes the definition
    train(tmp_path, WORDS.replace("3,5", "8"))
    assert len(flow_folders(tmp_path)) == 4


def test_what_a_training_leaves(tmp_path):
    train(tmp_path, WORDS)
    (folder,) = flow_folders(tmp_path)
    header, *rows = (folder / "training.csv").read_text().splitlines()
    assert header == "step,seconds,accuracy,face_accuracy,recall,violation"
    rows = np.array([[float(x) for x in row.split(",")] for row in rows])
    assert rows[:, 0].tolist() == list(range(1, 21)) and (np.diff(rows[:, 1]) >= 0).all()
    assert ((rows[:, 2:5] > 0) & (rows[:, 2:5] <= 1)).all()
    settings = json.loads((folder / "settings.json").read_text())
    assert settings["flow"]["flow"] == "reverse" and settings["flow"]["flow_steps"] == 20
    for run in find_runs(tmp_path):
        info = json.loads((run / "info.json").read_text())
        assert info["flow"]["accuracy"] == rows[-1, 2]
        same = ("versions", "commit", "processor", "preloaded")
        assert [info["flow"]["trained"][key] for key in same] == [info[key] for key in same]


@pytest.mark.parametrize("steps", [1, 7, 39, 50])
def test_a_training_is_measured_twenty_times_at_most(tmp_path, steps):
    train(tmp_path, f"{WORDS} flow_steps={steps}")
    (folder,) = flow_folders(tmp_path)
    seen = [int(line.split(",")[0]) for line in (folder / "training.csv").read_text().splitlines()[1:]]
    assert len(seen) == min(steps, 20) == len(set(seen)) and seen[-1] == steps


def test_a_run_keeps_its_flow(tmp_path):
    """A policy needs the folder of the run and nothing else; training.csv has the projected share."""
    train(tmp_path, f"{WORDS} flow=mle")
    obs = np.random.default_rng(0).normal(size=(40, 9))
    (run, _) = find_runs(tmp_path)
    before = load_policy(run)(obs)
    shutil.rmtree(tmp_path / "flows")
    moved = tmp_path / "elsewhere" / "R+O10" / "x" / run.name
    shutil.copytree(run, moved)
    policy = load_policy(moved)
    assert np.array_equal(policy(obs), before)
    assert policy.constraint.violation(torch.from_numpy(obs).float(), torch.from_numpy(before)).max() <= 1e-6
    assert run_command(["play", str(run), "episodes=1"]) == 0


def test_training_csv_has_the_share_that_is_projected(tmp_path, monkeypatch):
    """The share counts decoded actions, not the points of the box that the actor suggests."""
    monkeypatch.setattr(Flow, "propose", lambda self, constraint, obs, suggested: 0.0 * suggested + 5.0)
    train(tmp_path, WORDS.replace("3,5", "3"))
    (run,) = find_runs(tmp_path)
    training = read_run(run).training
    assert (training["suggested_infeasible"] == 1).all() and (training["suggested_violation"] >= 4).all()
    assert read_run(run).result["largest_violation"] <= 1e-6


# ---------------------------------------------------------------- faults


def test_a_flow_that_diverges_is_one_line(tmp_path, capsys):
    words = [*WORDS.split(), f"results={tmp_path}", "flow_learning_rate=1e30"]
    assert run_command(words) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("run.py: the flow of R+O10 cannot be trained: its loss is ")
    assert said.endswith("; try a smaller flow_learning_rate")
    assert not find_runs(tmp_path)


def test_a_damaged_flow_is_refused_and_a_damaged_checkpoint_starts_again(tmp_path, capsys):
    words = [*WORDS.split(), f"results={tmp_path}"]
    train(tmp_path / "whole", WORDS)
    with pytest.raises(Interrupted):
        train(tmp_path, WORDS, Breaks(flows.STATES // flows.ROBOTS + 15))
    (folder,) = flow_folders(tmp_path)
    assert (folder / "checkpoint.pt").is_file() and not (folder / "flow.pt").exists()
    (folder / "checkpoint.pt").write_bytes(b"no checkpoint")
    assert run_command(words) == 0
    assert f"{folder / 'checkpoint.pt'} is damaged" in capsys.readouterr().err
    assert_identical(outcome(tmp_path / "whole"), {name: run for name, run in outcome(tmp_path).items()})
    whole = (folder / "flow.pt").read_bytes()
    bit = bytes([whole[len(whole) // 2] ^ 64])
    for content in (b"no flow", whole[: len(whole) // 2] + bit + whole[len(whole) // 2 + 1 :], whole[:-9]):
        (folder / "flow.pt").write_bytes(content)
        assert run_command([*words, "overwrite=true"]) == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert said.startswith(f"run.py: {folder / 'flow.pt'} is damaged (") and said.endswith("trains the flow again")
    (folder / "flow.pt").unlink()
    assert run_command([*words, "overwrite=true"]) == 0


def test_a_process_waits_for_another_that_trains_the_same_flow(tmp_path, monkeypatch, capsys):
    train(tmp_path / "whole", WORDS)
    folder, looked = folder_of(tmp_path), threading.Event()
    folder.begin()
    with run_lock(folder.path):

        def finish():
            looked.wait()
            finished = flow_folders(tmp_path / "whole")[0] / "flow.pt"
            replace_file(folder.path / "flow.pt", lambda file: file.write(finished.read_bytes()))

        other = threading.Thread(target=finish)
        other.start()
        monkeypatch.setattr(flows, "time", clock(lambda seconds: looked.set()))
        train(tmp_path, WORDS)
        other.join()
    assert f"waiting: {folder.path} is being trained by process" in capsys.readouterr().err
    assert_identical(outcome(tmp_path / "whole"), outcome(tmp_path))


def test_a_process_takes_over_from_another_that_ended_without_a_flow(tmp_path, monkeypatch):
    folder = folder_of(tmp_path)
    folder.begin()
    lock = run_lock(folder.path)
    lock.__enter__()
    monkeypatch.setattr(flows, "time", clock(lambda seconds: lock.__exit__(None, None, None)))
    train(tmp_path, WORDS)
    assert len(find_runs(tmp_path)) == 2 and folder.read()["measures"]["step"] == 20


def test_a_flow_that_leaves_much_outside_is_noted(tmp_path, monkeypatch, capsys):
    train(tmp_path, f"{WORDS} flow_steps=1")
    assert "note: the flow of R+O10 maps " in capsys.readouterr().err
    monkeypatch.setattr(flows, "WIDE", 1.1)
    train(tmp_path, WORDS.replace("3,5", "8"))
    assert "% of the set; no policy can use the rest" in capsys.readouterr().err


def test_the_checkpoint_of_a_flow_cannot_be_written(tmp_path, monkeypatch, capsys):
    """The training of the flow continues without it."""

    def full(path, write):
        if path.name in ("checkpoint.pt", "training.csv"):
            raise OSError(28, "No space left on device", str(path))
        replace_file(path, write)

    monkeypatch.setattr(flows, "SECONDS", 0.0)
    monkeypatch.setattr(tensors, "replace_file", full)
    monkeypatch.setattr(flows, "replace_file", full)
    train(tmp_path, WORDS)
    said = capsys.readouterr().err
    assert "no checkpoint of the flow at step 1: no space left on device" in said
    assert "no training.csv of the flow at step 1: no space left on device" in said
    assert len(find_runs(tmp_path)) == 2


def test_play_at_random_stays_feasible_and_repeats_itself():
    config = config_of("algo=DFlow env=H+M")
    first, second = (flows.random_play(config, lambda: None) for _ in range(2))
    assert torch.equal(first, second) and first.shape == (400, 11) and first.isfinite().all()
    assert first[:, 8:11].std() > 1.0  # the robot moves
    assert len(first) > flow_training.HELD_OUT


@pytest.mark.parametrize("words, said", [("flow=both", "must be 'mle' or 'reverse'"), ("flow_steps=0", "at least 1")])
def test_wrong_settings_are_one_line(words, said, capsys):
    assert run_command(["algo=DFlow", "env=R+L2", words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("how, other", [("mle", "reverse"), ("reverse", "mle")])
def test_a_setting_of_the_other_training_is_refused(how, other, capsys):
    words = ["algo=DFlow,SFlow", "env=R+L2", "dry=true"]
    assert run_command([*words, f"flow={how}", f"{how}_softness=0.3"]) == 0
    capsys.readouterr()
    assert run_command([*words, f"flow={how}", f"{other}_softness=0.3"]) == 2
    said = f"run.py: {other}_softness applies only with flow={other}, not with flow={how}\n"
    assert capsys.readouterr().err == said


def test_sets_that_are_empty_somewhere(tmp_path, monkeypatch, capsys):
    """If the second joint is fast, the least violating actions are a face of the box."""

    class Rows(LinearConstraint):
        def A(self, obs):
            return torch.tensor([[1.0, 0.0], [-1.0, 0.0]]).expand(*obs.shape[:-1], 2, 2)

        def b(self, obs):
            return torch.stack([torch.full_like(obs[..., 6], 0.5), 0.5 - 4.0 * (obs[..., 6].abs() > 0.2)], -1)

    row = Task(Reacher, Rows(dim=2, on_empty="least"), "empty somewhere", "-", steps=100)
    monkeypatch.setitem(envs.TASKS, "R+Empty", row)
    words = WORDS.replace("R+O10", "R+Empty").replace("3,5", "3")
    for how in ("reverse", "mle"):
        train(tmp_path, f"{words} flow={how}")
    assert len(find_runs(tmp_path)) == 2 and all(read_run(run).result for run in find_runs(tmp_path))
    monkeypatch.setattr(row.constraint, "on_empty", "error")
    assert run_command([*words.split(), f"results={tmp_path / 'other'}"]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("run.py: the flow of R+Empty cannot be trained: sample ")
    assert said.endswith("the set is empty; on_empty='least' takes the least violating actions there")


def test_other_algorithms_have_no_settings_of_flows(capsys):
    assert run_command(["algo=DGauge", "env=R+L2", "flow=mle"]) == 2
    assert "flow does not apply to DGauge on R+L2" in capsys.readouterr().err


# ---------------------------------------------------------------- its benchmark


def bench_rows(capsys, *words):
    assert flows_benchmark.main(["env=R+O10", *words]) == 0
    return [line.split(" | ") for line in capsys.readouterr().out.splitlines()[1:]]


def test_the_benchmark_measures_what_a_run_trains(tmp_path, capsys):
    train(tmp_path, WORDS)
    (folder,) = flow_folders(tmp_path)
    last = (folder / "training.csv").read_text().splitlines()[-1].split(",")
    capsys.readouterr()
    (row,) = bench_rows(capsys, "flow=reverse")
    assert row[:3] == ["R+O10", "reverse", "20"]
    assert row[4:] == [f"{100 * float(share):.1f} %" for share in last[2:5]]


def test_the_benchmark_has_curves_and_the_published_recipe(capsys):
    curve = bench_rows(capsys, "every=10")
    assert [row[1:3] for row in curve] == [[way, step] for way in ("reverse", "mle") for step in ("0", "10", "20")]
    (first,) = bench_rows(capsys, "flow=mle", "every=10", "stop=0.01")
    assert first == curve[3][:3] + first[3:4] + curve[3][4:]  # the untrained row, all but the seconds
    published = bench_rows(capsys, "recipe=published", "flow=reverse", "flow_steps=20", "every=10")
    assert [row[2] for row in published] == ["0", "10", "20"] and published[2][4:] != curve[2][4:]


@pytest.mark.parametrize(
    "word, named",
    [
        ("recipe=mine", "'mine'"),
        ("stop=0", "'0' for stop"),
        ("every=0", "'0' for every"),
        ("flow=foo", "'foo'"),
        ("env=R+L9", "'R+L9'"),
        ("steps=5", "'steps'"),
        ("flow_entropy=action", "'flow_entropy'"),
    ],
)
def test_the_benchmark_names_a_wrong_word(word, named, capsys):
    assert flows_benchmark.main([word]) == 2
    said = capsys.readouterr().err
    assert said.startswith("bench/flows.py: ") and said.count("\n") == 1 and named in said
