"""Helpers of several test modules: short trainings, their outcomes, and invented runs."""

import json

import numpy as np
import pytest
import torch

import plot
import run
from algos import setting_keys
from core.words import parse_words
from store.folder import find_runs, read_run, run_folder, variant_name
from store.interrupt import Interrupted
from store.writer import RunWriter
from sweep.cells import make_cells
from sweep.definition import define
from sweep.train import train as train_cell

run_command = run.main
"""Does the same as `python run.py` with a list of words; returns the exit code."""


CHECKPOINTED = (
    "algo=DPre env=R+N seed=3,5 steps=60 learning_starts=20 batch_size=4 hidden=[8,8] eval_every=30 eval_episodes=1"
    " final_episodes=1 checkpoint_every=10 train_freq=1 gradient_steps=1"
)
"""A short cell of two seeds with many checkpoints."""


class Breaks:
    """A `stop_if_asked` that ends the training at the given calls, counted over all resumptions."""

    def __init__(self, *at, error=None):
        self.calls, self.at = 0, at
        self.error = error or Interrupted(15)

    def __call__(self):
        self.calls += 1
        if self.calls in self.at:
            raise self.error


def cells_of(words):
    """The cells that the words of a command define."""
    return make_cells(parse_words(words.split() if isinstance(words, str) else words, setting_keys()))


def config_of(words):
    """The configuration of the only cell that the words of a command define."""
    (cell,) = cells_of(words)
    return cell.config


def train(root, words, stop_if_asked=lambda: None):
    """Train the cell of `words` below `root`. Returns whether every seed has a result."""
    (cell,) = cells_of(f"{words} results={root}")
    return train_cell(cell, define(cell.config.env, cell.config.algo), stop_if_asked)


def train_through(root, words, check):
    """Repeat the same training until it finishes. Returns the number of interruptions."""
    interrupted = 0
    while True:
        try:
            train(root, words, check)
            return interrupted
        except type(check.error):
            interrupted += 1


def outcome(root):
    """All results and files of a cell, except times, by seed folder."""
    return {folder.name: outcome_of(folder) for folder in find_runs(root)}


def outcome_of(folder):
    """All results and files of one run, except times."""
    result = read_run(folder).result
    result.pop("seconds")
    evaluations = [line.rpartition(",")[0] for line in (folder / "evaluations.csv").read_text().splitlines()]
    training = folder / "training.csv"
    return {
        "result": result,
        "evaluations": evaluations,
        "training": training.read_text() if training.exists() else None,
        "parameters": {name: torch.load(folder / f"{name}.pt", weights_only=True) for name in ("best", "last")},
        "files": sorted(path.name for path in folder.iterdir()),
    }


def assert_identical(one, other):
    assert one.keys() == other.keys() and one
    for seed in one:
        for what in ("result", "evaluations", "training", "files"):
            assert one[seed][what] == other[seed][what]
        for name in ("best", "last"):
            a, b = (outcomes[seed]["parameters"][name] for outcomes in (one, other))
            assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def assert_never_apart(root):
    """Assert that seeds 3 and 5 were always started and resumed together."""
    for folder in root.glob("*/*/seed=[35]"):
        info = json.loads((folder / "info.json").read_text())
        assert all(start["lockstep"] == [3, 5] for start in [info, *info.get("resumed", [])])


def refused_by_plot(capsys, *arguments):
    """The error message, one line, with which plot.py refuses `arguments`."""
    assert plot.main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "Traceback" not in captured.err
    return captured.err


def write_run(root, task, algo, seed, result=None, overrides=None, evaluations=4, base=0.0, **config):
    """Write a run with `evaluations` evaluations. It is finished with the mean return `result`, unless that is None."""
    overrides = overrides or {}
    folder = run_folder(root, task, variant_name(algo, overrides), seed)
    settings = {
        "algo": algo,
        "env": task,
        "seed": str(seed),
        "steps": 20_000,
        "gamma": 0.99,
        **overrides,
        **config,
    }
    writer = RunWriter(folder, settings, {"commit": None}, eval_episodes=3)
    rng = np.random.default_rng(seed)
    for step in range(5_000, 5_000 * evaluations + 1, 5_000):
        writer.append_evaluation(step, base + step / 1_000 + rng.normal(size=3), step / 100)
    if result is not None:
        writer.finish({"return_mean": result, "returns": [result] * 50})
    return writer


def break_off(root, calls=100):
    """Run the command up to a crash that leaves two checkpoints for each seed. Returns the seeds' folders."""
    with pytest.raises(ZeroDivisionError):
        train(root, CHECKPOINTED, Breaks(calls, error=ZeroDivisionError()))
    folders = sorted(root.glob("*/*/seed=?"))
    assert [len(list(folder.glob("checkpoint/state-*.pt"))) for folder in folders] == [2, 2]
    return folders


def outcome_files(root):
    return {path: path.read_bytes() for path in root.glob("*/*/seed=?/*.*")}
