"""The benchmark of a GPU (bench/gpu.py), run on the CPU with tiny sizes: every part, what it saves, and its options."""

import csv
import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

import bench.shared_gpu as sharing
from bench import lockstep
from bench.mps import shared_gpu
from envs.locomotion import HalfCheetah

ROOT = Path(__file__).parents[1]


@pytest.fixture
def bench(monkeypatch):
    """bench/gpu.py as a module, with small sizes."""
    monkeypatch.setattr(sys, "path", list(sys.path))  # the script changes it
    spec = importlib.util.spec_from_file_location("bench_gpu", ROOT / "bench" / "gpu.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look there
    spec.loader.exec_module(module)
    for name, value in (("TRANSITIONS", 20), ("ROUNDS", 2), ("WARM_UP", 60), ("SETTLED", 120), ("LEARNED", 180)):
        monkeypatch.setattr(lockstep, name, value)
    monkeypatch.setattr(lockstep, "COMPARED", (1, 3))
    monkeypatch.setattr(HalfCheetah, "max_episode_steps", 60)
    monkeypatch.setattr(module, "RUN_SEEDS", (1, 2))
    monkeypatch.setattr(module, "TESTS", ["tests/test_ahead.py", "-k", "a_block_has"])
    monkeypatch.setattr(module.os, "cpu_count", lambda: 2)
    words = "steps=400 learning_starts=150 eval_every=200 eval_episodes=1 final_episodes=1 hidden=[8,8] batch_size=4"
    monkeypatch.setattr(module, "CELL_WORDS", words.split())
    return module


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_all_parts_from_measurement_to_tables(bench, tmp_path, capfd):
    words = ["device=cpu", "task=HC+O", "seeds=1,2", "steps=2", "cells=DPre,SRad", "cell_seeds=0-1", f"out={tmp_path}"]
    assert bench.main(words) == 0, capfd.readouterr().err
    written = {path.name for path in tmp_path.iterdir()}
    tables = {f"{part}.{suffix}" for part in bench.PARTS for suffix in ("csv", "md")}
    assert written == tables | {"machine.json", "gpu.md", "tests.txt", "runs", "cell-DPre.txt", "cell-SRad.txt"}
    assert "cores" in json.loads((tmp_path / "machine.json").read_text())
    assert all(
        title in (tmp_path / "gpu.md").read_text() for title in ("Tests", "Gradient", "Largest", "Whole", "Cells")
    )

    (tests,) = rows_of(tmp_path / "tests.csv")
    assert tests["outcome"] == "exit code 0" and "passed" in tests["summary"]
    updates = rows_of(tmp_path / "updates.csv")
    assert [(r["seeds"], r["base"]) for r in updates] == [("1", "TD3"), ("1", "SAC"), ("2", "TD3"), ("2", "SAC")]
    for record in updates:
        for key in ("seed_updates_per_second", "floor_seed_updates_per_second", "cpu_ms_a_step", "replay_mb"):
            assert float(record[key]) > 0
        assert bool(record["eager_updates_per_second"]) == (record["seeds"] == "1") and record["gpu_mb"] == ""
    agreement = rows_of(tmp_path / "agreement.csv")
    assert {r["algo"] for r in agreement} == set(bench.PAPER) and len(agreement) == 26
    assert all(float(r["rounding"]) > 0 for r in agreement)
    assert all(float(r["difference"]) == 0 for r in agreement)  # the CPU is compared with itself
    runs = rows_of(tmp_path / "runs.csv")
    assert [(r["seeds"], r["threads"]) for r in runs] == [*[("1", "1")] * 2, *[("2", "1")] * 2, *[("2", "2")] * 2]
    for record in runs:
        assert int(record["steps"]) >= 60 and record["gradient_steps"] == record["steps"]
        phases = [float(record[f"{phase}_ms".replace(" ", "_")]) for phase in bench.PHASES]
        assert sum(phases) == pytest.approx(1e3 / float(record["steps_per_second"]), rel=1e-3)
        assert min(phases) >= 0 and float(record["gradient_step_ms"]) > 0 and float(record["environments_ms"]) > 0
    for record in rows_of(tmp_path / "cells.csv"):
        assert (record["exit_code"], record["finished"], record["evaluated_to_step"]) == ("0", "2", "400")
        assert float(record["return_mean"]) < 0


def test_an_error_of_one_case_leaves_the_others(bench, tmp_path, capsys, monkeypatch):
    def measure(base, *rest):
        if base == "TD3":
            raise ZeroDivisionError("so it goes")
        return lockstep.measure_updates(base, *rest)

    monkeypatch.setattr(bench, "measure_updates", measure)
    words = ["device=cpu", "parts=updates", "task=HC+O", "seeds=1", "steps=1", f"out={tmp_path}"]
    assert bench.main(words) == 1
    assert [r["base"] for r in rows_of(tmp_path / "updates.csv")] == ["SAC"]
    assert "so it goes" in (tmp_path / "errors.txt").read_text() and "SAC" in (tmp_path / "gpu.md").read_text()


def test_cells_that_the_time_cuts_short_say_how_far_they_came(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(
        bench, "CELL_WORDS", ["steps=1000000" if word == "steps=400" else word for word in bench.CELL_WORDS]
    )
    assert bench.main(["device=cpu", "parts=cells", "cells=DPre", "minutes=1", f"out={tmp_path}"]) == 0
    (record,) = rows_of(tmp_path / "cells.csv")
    assert record["finished"] == "0" and record["exit_code"] in ("143", "-15") and record["return_mean"] == ""


def test_options(bench, tmp_path, capsys):
    for words, complaint in (
        (["parts=speed"], "unknown parts 'speed'"),
        (["device=tpu"], "bad value 'tpu' for device"),
        (["minutes=0"], "bad value '0' for minutes"),
        (["cells=PPO"], "unknown cells 'PPO'"),
        (["task=X"], "unknown task 'X'"),
        (["clock=cpu"], "unknown key 'clock'"),
    ):
        assert bench.main(["device=cpu", f"out={tmp_path}", *words][1 if words[0].startswith("device") else 0 :]) == 2
        error = capsys.readouterr().err
        assert complaint in error and error.count("\n") == 1


MPS = """#!/bin/sh
[ "$1" = -d ] || read command
echo "$1$command $CUDA_MPS_PIPE_DIRECTORY" >> {log}
exit {code}
"""


@pytest.fixture
def mps(tmp_path, monkeypatch):
    """A stand-in for NVIDIA's command that logs its calls."""

    def install(code=0):
        command = tmp_path / "bin" / "nvidia-cuda-mps-control"
        command.parent.mkdir()
        command.write_text(MPS.format(log=tmp_path / "log", code=code))
        command.chmod(0o755)
        monkeypatch.setenv("PATH", f"{command.parent}:/usr/bin:/bin")
        return tmp_path / "log"

    return install


def test_the_multi_process_service_runs_while_processes_share_a_gpu(mps):
    log = mps()
    with pytest.raises(KeyboardInterrupt), shared_gpu(torch.device("cuda")) as environment:
        folder = environment["CUDA_MPS_PIPE_DIRECTORY"]
        assert log.read_text() == f"-d {folder}\n"
        raise KeyboardInterrupt
    assert log.read_text() == f"-d {folder}\nquit {folder}\n"
    with shared_gpu(torch.device("cpu")) as environment:
        assert environment == {}


def test_processes_take_turns_where_the_service_does_not_start(mps, capsys):
    mps(code=1)
    with shared_gpu(torch.device("cuda")) as environment:
        assert environment == {}
    assert "take turns" in capsys.readouterr().err


def test_processes_are_measured_beside_each_other(capfd):
    assert sharing.main(["device=cpu", "processes=1,2", "seeds=1", "seconds=1", "algo=SPre", "env=R+L2"]) == 0
    title, turns = capfd.readouterr().out.splitlines()
    assert title.split("\t")[1:] == ["1", "2"]
    assert all(float(rate.replace(",", "")) > 0 for rate in turns.split("\t")[1:])
    for wrong in ("processes=0", "algo=DPre,SPre", "env=R+L3", "seconds=-1", "device=tpu"):
        assert sharing.main([wrong]) == 2
        assert len(capfd.readouterr().err.splitlines()) == 1
