"""The number of threads of a cell if the command does not set it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from helpers import CHECKPOINTED, Breaks, cells_of, config_of, train

import sweep.train
from core.config import THREADS
from store.interrupt import Interrupted
from sweep.cells import Cell
from sweep.launch import launch
from sweep.settings import parse_sweep

ROOT = Path(__file__).resolve().parent.parent
WORDS = "algo=DPre env=R+N steps=20 learning_starts=10 batch_size=4 hidden=8 eval_episodes=1 final_episodes=1"


@pytest.mark.parametrize(
    "more, threads",
    [
        ("", 2),
        ("threads=auto device=auto", 2),
        ("threads=1", 1),
        ("jobs=1", 1),
        ("jobs=1 threads=auto", 1),
        ("jobs=1 threads=2", 2),
    ],
    ids=lambda value: str(value),
)
def test_a_cell_alone_uses_the_machine_and_a_cell_of_a_sweep_one_core(tmp_path, more, threads):
    command = [sys.executable, "run.py", *WORDS.split(), *more.split(), f"results={tmp_path}"]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "2"}, check=True, capture_output=True)
    (run,) = tmp_path.glob("R+N/*/seed=0")
    info, settings = json.loads((run / "info.json").read_text()), yaml.safe_load((run / "config.yaml").read_text())
    assert info["threads"] == settings["threads"] == threads
    assert "auto" not in (info["device"], settings["device"])


def test_small_networks_get_no_more_than_four_threads():
    for given, used in ((1, 1), (3, 3), (16, 4)):
        code = f"import torch; torch.set_num_threads({given}); from core.config import THREADS; print(THREADS['cpu'])"
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
        assert int(done.stdout) == used


@pytest.fixture
def gpu(monkeypatch):
    """Makes PyTorch say that there is a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)


def test_auto_chooses_a_gpu_where_there_is_one(gpu, monkeypatch):
    chosen = sweep.train.on_this_machine(config_of("algo=DPre env=R+N"))
    assert (chosen.device, chosen.threads) == ("cuda", THREADS["cuda"])
    chosen = sweep.train.on_this_machine(config_of("algo=DPre env=R+N device=cpu threads=3"))
    assert (chosen.device, chosen.threads) == ("cpu", 3)
    monkeypatch.setattr(type(sweep.train.TASKS["R+N"].constraint), "solved_on_cpu", True)
    assert sweep.train.on_this_machine(config_of("algo=DPre env=R+N")).device == "cpu"


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_auto_is_the_cpu_where_there_is_no_gpu():
    chosen = sweep.train.on_this_machine(config_of("algo=DPre env=R+N"))
    assert (chosen.device, chosen.threads) == ("cpu", THREADS["cpu"])


@pytest.mark.parametrize(
    "words, device, threads",
    [
        ("jobs=2", "cuda", 1),  # the cells share the GPU
        ("jobs=2 device=cpu", "cpu", 1),
        ("launcher=slurm", "cpu", 3),  # the GPU of this machine is not that of a job
        ("launcher=slurm slurm.gpus=1", "cuda", 3),
    ],
)
def test_the_launcher_chooses_for_the_cells_of_a_sweep(words, device, threads, gpu, monkeypatch):
    planned = []
    monkeypatch.setattr("sweep.launch.make_plan", lambda cells, states: planned.extend(cells) or [])
    monkeypatch.setattr("sweep.launch.describe_plan", lambda *arguments: "")
    words = f"algo=DPre,DRad env=R+N dry=true {words} slurm.cpus=3".split()
    if "launcher=slurm" not in words:
        words.remove("slurm.cpus=3")
    settings, rest = parse_sweep(words)
    launch(settings, cells_of([f"{key}={value}" for key, value in rest.items()]), lambda: None)
    assert [(cell.config.device, cell.config.threads) for cell in planned] == [(device, threads)] * 2
    assert all(f"device={device}" in cell.words and f"threads={threads}" in cell.words for cell in planned)


def test_a_run_that_resumes_on_another_device_says_so(tmp_path, capsys, monkeypatch):
    saved = Cell.settings
    monkeypatch.setattr(Cell, "settings", lambda cell, seed: saved(cell, seed) | {"device": "cuda"})
    with pytest.raises(Interrupted):
        train(tmp_path, CHECKPOINTED, Breaks(40))
    monkeypatch.setattr(Cell, "settings", saved)
    capsys.readouterr()
    assert train(tmp_path, f"{CHECKPOINTED} device=cpu")
    assert "(device=cpu now, cuda before: equal to an uninterrupted run only up to rounding)" in capsys.readouterr().out
