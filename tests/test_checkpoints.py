"""Checkpoints: damage, the choice of one to resume from, their contents, and resuming."""

import hashlib
import io
import json
import os
import pickle
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import (
    CHECKPOINTED,
    Breaks,
    assert_identical,
    break_off,
    outcome,
    outcome_files,
    run_command,
    train,
    train_through,
)

from algos.td3 import TD3
from core.replay import Batch, Replay
from store import folder as results
from store.checkpoint import Checkpoint, CheckpointFolder, group_checkpoints
from store.writer import RunWriter

ROOT = Path(__file__).parents[1]


def newest(folder, pattern):
    return max((folder / "checkpoint").glob(pattern), key=lambda path: int(path.stem.split("-")[1]))


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(content)


def truncate(path):
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize("damage", [flip, truncate, Path.unlink], ids=["flipped bit", "truncated", "deleted"])
@pytest.mark.parametrize("pattern", ["state-*.pt", "replay-*.f32"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path, capsys, unbroken, pattern, damage):
    first, _ = break_off(tmp_path)
    damaged = newest(first, pattern)
    newest_state = newest(first, "state-*.pt")
    damage(damaged)
    capsys.readouterr()
    train(tmp_path, CHECKPOINTED)
    captured = capsys.readouterr()
    steps = [int(line.rpartition(" ")[2]) for line in captured.out.splitlines() if "resuming from step" in line]
    assert len(steps) == 2 and steps[0] == steps[1] and steps[0] % 10 == 0
    if damage is not Path.unlink or pattern != "state-*.pt":
        assert f"{newest_state}: damaged checkpoint: " in captured.err
    assert_identical(outcome(tmp_path), unbroken)


def test_without_a_whole_checkpoint_a_run_starts_again_and_the_old_one_is_kept(tmp_path, capsys):
    first, second = break_off(tmp_path)
    for path in first.glob("checkpoint/state-*.pt"):
        flip(path)
    train(tmp_path, CHECKPOINTED)
    captured = capsys.readouterr()
    assert captured.err.count("damaged checkpoint: wrong checksum") == 2
    assert "seeds were trained together" in captured.out and captured.out.count("resuming") == 1
    assert f"{second}: resuming" in captured.out
    assert (first.parent / "seed=3.old-1" / "checkpoint").is_dir()
    assert set(outcome(tmp_path)) == {"seed=3", "seed=5"}


class Malicious:
    def __reduce__(self):
        return os.mkdir, ("executed",)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_a_checkpoint_executes_nothing(tmp_path, capsys, monkeypatch, unbroken):
    monkeypatch.chdir(tmp_path)
    first, _ = break_off(tmp_path)
    body = io.BytesIO()
    torch.save({"state": Malicious()}, body)
    for content in (body.getvalue(), pickle.dumps(Malicious())):
        path = newest(first, "state-*.pt")
        path.write_bytes(hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
        checkpoints, problems = CheckpointFolder(first).read()
        assert len(checkpoints) == 1 and len(problems) == 1 and problems[0].startswith(f"{path}: damaged checkpoint: ")
        assert "\n" not in problems[0]
    train(tmp_path, CHECKPOINTED)
    assert not (tmp_path / "executed").exists()
    assert_identical(outcome(tmp_path), unbroken)


def kept(serial, moment, group, step=0):
    return Checkpoint(Path(), serial, moment, group, step, {}, ())


A, B = (1, 2, 3), (4, 5)


@pytest.mark.parametrize(
    "intact, moments, fresh",
    [
        # all are whole: the newest is chosen
        ({s: [kept(8, "n", A), kept(7, "m", A)] for s in A}, [dict.fromkeys(A, "n")], []),
        # killed between writing the checkpoints of two seeds
        (
            {1: [kept(8, "n", A), kept(7, "m", A)], 2: [kept(7, "m", A), kept(6, "l", A)], 3: [kept(7, "m", A)]},
            [dict.fromkeys(A, "m")],
            [],
        ),
        # the same with the very first checkpoints
        ({1: [kept(1, "n", A)], 2: [], 3: []}, [], [1, 2, 3]),
        (
            {1: [kept(2, "n", A), kept(1, "m", A)], 2: [kept(1, "m", A)], 3: [kept(1, "m", A)]},
            [dict.fromkeys(A, "m")],
            [],
        ),
        # one seed has lost all its checkpoints: the others lose nothing
        ({1: [], 2: [kept(8, "n", A), kept(7, "m", A)], 3: [kept(8, "n", A)]}, [{2: "n", 3: "n"}], [1]),
        # two groups and a new seed
        (
            {s: [kept(1, "n", A)] for s in A} | {s: [kept(9, "z", B)] for s in B} | {6: []},
            [dict.fromkeys(A, "n"), dict.fromkeys(B, "z")],
            [6],
        ),
    ],
)
def test_seeds_are_taken_up_at_a_moment_that_they_share(intact, moments, fresh):
    started = {seed: A if seed in A else B if seed in B else () for seed in intact}
    groups, chosen_fresh = group_checkpoints(intact, started)
    assert [{seed: c.moment for seed, c in group.items()} for group in groups] == moments and chosen_fresh == fresh


def test_replay_files_hold_each_transition_once_and_go_when_it_is_overwritten(tmp_path):
    folder, replay = CheckpointFolder(tmp_path), Replay([1, 2], 50, obs_dim=2, action_dim=1, centers=False)
    kept_files = []
    for number in range(130):
        replay.add([1], Batch(*(torch.full((2, width), float(number)) for width in replay.widths)))
        if number % 20 == 19:
            stored = partial(replay.stretch, 1), max(0, replay.added[1] - 50), replay.added[1]
            folder.write("moment", (2,), number, {}, {"number": number}, *stored)
            folder.keep()
            kept_files.append(sorted(path.name for path in (tmp_path / "checkpoint").glob("*.f32")))
    assert kept_files[:3] == [["replay-0-20.f32"]] * 1 + [
        ["replay-0-20.f32", "replay-20-40.f32"],
        ["replay-0-20.f32", "replay-20-40.f32", "replay-40-60.f32"],
    ]
    # The buffer has transitions 71 to 120. The previous checkpoint, at 100, needs 51 to 100.
    assert kept_files[-1] == [f"replay-{start}-{start + 20}.f32" for start in (100, 40, 60, 80)]
    newest_one, before = folder.read()[0]
    for checkpoint, stop in ((newest_one, 120), (before, 100)):
        again = Replay([1, 2], 50, obs_dim=2, action_dim=1, centers=False)
        again.added[1] = stop
        checkpoint.fill(partial(again.stretch, 1), max(0, again.added[1] - 50))
        assert checkpoint.state() == {"number": stop - 1}
        assert sorted(again.rows[50:, 0].tolist()) == list(range(stop - 50, stop))
        assert again.rows[50 + (stop - 1) % 50].eq(stop - 1).all()


def test_checkpoints_after_a_resumption_join_those_before_it(tmp_path):
    first, _ = break_off(tmp_path, calls=100)
    serials = sorted(int(path.stem.split("-")[1]) for path in first.glob("checkpoint/state-*.pt"))
    replay_files = {path.name for path in first.glob("checkpoint/*.f32")}
    with pytest.raises(ZeroDivisionError):
        train(tmp_path, CHECKPOINTED, Breaks(200, error=ZeroDivisionError()))
    later = sorted(int(path.stem.split("-")[1]) for path in first.glob("checkpoint/state-*.pt"))
    assert later[0] == later[1] - 1 and serials[1] < later[1] <= serials[1] + 3
    assert replay_files < {path.name for path in first.glob("checkpoint/*.f32")}
    assert not CheckpointFolder(first).read()[1]


def test_settings_that_changed_are_not_mixed(tmp_path, capsys, monkeypatch):
    folder, _ = break_off(tmp_path)
    monkeypatch.setitem(TD3.paper["Reacher"], "tau", 0.5)
    capsys.readouterr()
    assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}"]) == 2
    err = capsys.readouterr().err
    assert (
        f"{folder} started with tau=0.005, but this command has tau=0.5; use" in err
        and "overwrite=true" in err
        and err.count("\n") == 1
    )
    assert run_command([*CHECKPOINTED.split(), f"results={tmp_path}", "overwrite=true"]) == 0
    assert (folder.parent / "seed=3.old-1" / "checkpoint").is_dir() and (folder / "result.json").is_file()


def test_another_grouping_goes_on_from_the_checkpoints_too(tmp_path, capsys, unbroken):
    folder, other = break_off(tmp_path)
    capsys.readouterr()
    alone = CHECKPOINTED.replace("seed=3,5", "seed=3")
    train(tmp_path, alone)
    assert f"{folder}: resuming from step" in (out := capsys.readouterr().out) and "only up to rounding" in out
    assert (other / "checkpoint").is_dir() and not (folder / "checkpoint").exists()
    result = results.read_run(folder).result
    assert result["steps"] == 60 and result["gradient_steps"] == unbroken["seed=3"]["result"]["gradient_steps"]
    for name, parameter in torch.load(folder / "last.pt", weights_only=True).items():
        torch.testing.assert_close(parameter, unbroken["seed=3"]["parameters"]["last"][name], rtol=0, atol=1e-4)
    train(tmp_path, CHECKPOINTED)
    assert "already finished" in (out := capsys.readouterr().out) and f"{other}: resuming from step" in out
    assert set(outcome(tmp_path)) == {"seed=3", "seed=5"}


def test_what_a_death_after_the_last_result_leaves_is_cleared_away(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(CheckpointFolder, "remove", lambda self: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            train(tmp_path, CHECKPOINTED)
    assert len(list(tmp_path.glob("*/*/seed=?/checkpoint"))) == 2
    before = outcome_files(tmp_path)
    assert train(tmp_path, CHECKPOINTED)
    assert not list(tmp_path.glob("*/*/seed=?/checkpoint")) and outcome_files(tmp_path) == before


def test_a_clock_that_jumps_changes_nothing(tmp_path, monkeypatch, unbroken):
    now = time.time()
    jumps = iter(range(10**9))
    monkeypatch.setattr(time, "time", lambda: now + 1e7 * (-1) ** next(jumps))
    assert train_through(tmp_path, CHECKPOINTED, Breaks(60)) == 1
    assert_identical(outcome(tmp_path), unbroken)
    for folder in tmp_path.glob("*/*/seed=?"):
        trained = results.read_run(folder)
        assert 0 <= trained.evaluations.seconds[0] <= trained.evaluations.seconds[1] < 1e4
        assert 0 < trained.result["seconds"]["total"] < 1e4


def test_every_resumption_is_on_record(tmp_path):
    train_through(tmp_path, CHECKPOINTED, Breaks(60, 90))
    for folder in tmp_path.glob("*/*/seed=?"):
        info = json.loads((folder / "info.json").read_text())
        assert info["lockstep"] == [3, 5] and len(info["resumed"]) == 2
        for start in (info, *info["resumed"]):
            assert {"versions", "commit", "platform", "processor", "threads", "device", "started"} <= start.keys()
        assert 0 < info["resumed"][0]["step"] <= info["resumed"][1]["step"] < 60


def test_tables_go_back_to_what_a_checkpoint_holds(tmp_path):
    writer = RunWriter(tmp_path / "seed=1", {"tau": 0.5}, {"commit": "a"}, eval_episodes=2)
    before = writer.tables()
    assert list(before) == ["evaluations.csv"] and writer.last_finite_evaluation() is None
    writer.append_evaluation(10, [1.0, 3.0], 0.5)
    writer.append_statistics(10, {"temperature": 0.1, "entropy": 1 / 3})
    tables = writer.tables()
    assert tables["training.csv"] == "step,temperature,entropy\n10,0.1,0.3333333333333333\n"
    writer.append_evaluation(20, [float("nan"), 1.0], 0.7)
    writer.append_statistics(20, {"temperature": 0.2, "entropy": float("nan")})
    assert writer.tables()["training.csv"] == tables["training.csv"] + "20,0.2,nan\n"
    assert writer.last_finite_evaluation() == {"step": 10, "return_mean": 2.0}

    (tmp_path / "seed=1" / "info.json").write_text("{")  # for people: resuming does not need it
    again = RunWriter.resume(tmp_path / "seed=1", {"tau": 0.5}, {"commit": "b"}, eval_episodes=2)
    again.restore_tables(tables)
    assert again.tables() == tables and results.read_run(again.folder).config == {"tau": 0.5}
    assert json.loads((again.folder / "info.json").read_text()) == {"resumed": [{"commit": "b"}]}
    again.restore_tables(before)
    assert again.tables() == before and not (again.folder / "training.csv").exists()


def test_the_cost_of_checkpoints_can_be_measured(tmp_path):
    done = subprocess.run(
        [sys.executable, "bench/checkpoint.py", "seeds=2", "env=R+L2", "transitions=2e4", f"folder={tmp_path}"],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for said in ("seeds=2: a gradient step takes", "whole buffer:", "after 10000 steps:", "memory:", "resuming:"):
        assert said in done.stdout
    assert not list(tmp_path.iterdir())
