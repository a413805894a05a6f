"""The benchmark of training (bench/training.py): its arithmetic floor, its tables and its options."""

import csv
import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from helpers import config_of
from torch.utils.flop_counter import FlopCounterMode

import envs
from algos import ALGORITHMS
from bench import peer, phases
from bench.floor import Floor, update_products
from core.replay import Batch
from envs.locomotion import HalfCheetah

ROOT = Path(__file__).parents[1]
OBS, ACTION = 17, 6


@pytest.fixture
def bench(monkeypatch):
    """bench/training.py as a module, with small replay buffers and short runs."""
    monkeypatch.setattr(sys, "path", list(sys.path))  # the script changes it
    spec = importlib.util.spec_from_file_location("bench_training", ROOT / "bench" / "training.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look there
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "TRANSITIONS", 20)
    monkeypatch.setattr(HalfCheetah, "max_episode_steps", 50)
    monkeypatch.setattr(phases, "STEPS", 220)
    monkeypatch.setattr(phases, "WARM_UP", 190)
    return module


@pytest.mark.parametrize(("base", "name"), [("TD3", "DPre"), ("SAC", "SPre")])
@pytest.mark.parametrize("seeds", [1, 3])
def test_the_floor_has_the_products_of_an_update(base, name, seeds):
    config = config_of([f"algo={name}", "env=HC+O"])
    agent = ALGORITHMS[name].build(config, envs.constraint("HC+O"), OBS, range(seeds))
    batch = config.batch_size
    shapes = [(OBS,), (ACTION,), (), (), (OBS,)]
    transitions = Batch(*(torch.rand(seeds, batch, *shape) for shape in shapes), None, None)
    with FlopCounterMode(display=False) as counter:
        agent.update(transitions)
        agent.update(transitions)
    extra = counter.get_total_flops() - 2 * update_products(base, config, OBS, ACTION, seeds).flops

    # In the actor's step, the critics' first layer may compute the gradient of its whole input, although only that of
    # the action is needed: TD3's first critics in one of two updates, SAC's two critics in both.
    critics = seeds if base == "TD3" else 4 * seeds
    assert extra in (0, 2 * critics * batch * config.hidden[0] * OBS)


def test_the_floor_multiplies_what_the_list_says():
    config = config_of(["algo=DPre", "env=HC+O", "hidden=[5,4]", "batch_size=3"])
    update = update_products("TD3", config, OBS, ACTION, 2)
    floor = Floor(update)
    floor.update()
    state = {name: matrix.clone() for name, matrix in floor.memory.items()}
    floor.update()
    memory = floor.memory
    torch.testing.assert_close(memory["critic dw1"], memory["critic(s, a) x1"].mT @ memory["critic(s, a) g2"])
    ahead = memory["critic(s, mu(s)) g1"] @ memory["critic w0"][:2, -ACTION:].mT
    torch.testing.assert_close(memory["critic(s, mu(s)) g0"], ahead)
    assert not torch.equal(state["actor dw0"], memory["actor dw0"])  # the actor's step comes every second time
    assert memory["critic w0"].shape == (4, OBS + ACTION, 5) and memory["actor dw0"].shape == (2, OBS, 5)
    assert not any(name.endswith(" dw0") and "target" in name for name in memory)


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_training_from_measurement_to_tables(bench, tmp_path, capsys):
    words = ["base=TD3,SAC", "seeds=1,2", "threads=1", "rounds=2", "steps=2", f"out={tmp_path}"]
    assert bench.main(words) == 0
    captured = capsys.readouterr()
    assert "ours / floor" in captured.out and "all outside sampling and update" in captured.out
    assert ("Stable-Baselines3 is not installed" in captured.err) == (not peer.INSTALLED)
    assert ("SB3 / ours" in captured.out) == peer.INSTALLED

    records = rows_of(tmp_path / "training.csv")
    cells = [(r["base"], r["algo"], r["seeds"], r["threads"]) for r in records]
    assert cells == [(b, a, s, "1") for b, a in (("TD3", "DPre"), ("SAC", "SPre")) for s in "12"]
    for record in records:
        for name in ("update", "floor", "environment"):
            assert 0 < float(record[f"{name}_ms_least"]) <= float(record[f"{name}_ms_median"])
        assert float(record["update_over_floor"]) > 0.5
        assert bool(record["peer_over_update"]) == bool(record["peer_environment_ms_least"]) == peer.INSTALLED

    shares = {}
    for record in rows_of(tmp_path / "phases.csv"):
        assert float(record["seconds"]) > 0, record
        shares.setdefault((record["base"], record["seeds"]), []).append(float(record["share"]))
    assert list(shares) == [("TD3", "1"), ("TD3", "2"), ("SAC", "1"), ("SAC", "2")]
    assert all(len(run_shares) == 12 and sum(run_shares) == pytest.approx(1) for run_shares in shares.values())
    assert {path.name for path in tmp_path.iterdir()} == {"training.csv", "training.md", "phases.csv", "phases.md"}


def test_training_options(bench, tmp_path, capsys):
    for words, complaint in (
        (["base=PPO"], "unknown base 'PPO'"),
        (["seeds=1,x"], "bad value 'x' for seeds"),
        (["threads=0"], "bad value '0' for threads"),
        (["steps=3"], "expected an even number"),
        (["clock=cpu"], "unknown key 'clock'"),
        (["rounds"], "expected key=value"),
    ):
        assert bench.main(words) == 2
        error = capsys.readouterr().err
        assert complaint in error and error.count("\n") == 1


def test_an_interrupted_measurement_leaves_what_it_has(bench, tmp_path, capsys, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "measure_phases", interrupt)
    assert bench.main(["base=TD3", "seeds=1", "threads=1", "rounds=1", "steps=2", f"out={tmp_path}"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert [r["base"] for r in rows_of(tmp_path / "training.csv")] == ["TD3"]
