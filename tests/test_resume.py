"""A run that is interrupted, killed or damaged and taken up again ends with every bit of the run that never was."""

import json
import multiprocessing
import random
import time

import pytest
import torch

import run
from store.folder import find_runs, read_run
from store.interrupt import Interrupted

SETTINGS = "steps=240 learning_starts=60 batch_size=8 hidden=[16,16] eval_every=100 eval_episodes=1 final_episodes=1"
CASES = {
    "TD3 on Reacher": "algo=DPre+ env=R+O10",
    "TD3 on Walker2d": "algo=DOpt env=W+M",
    "SAC with gSDE": "algo=SRad env=R+M",
    "SAC with stored centres": "algo=SAlpha env=W+M",
    "NFWPO on Reacher": "algo=NFW env=R+L2",
    "NFWPO on Walker2d": "algo=NFW env=W+O+S",
    "a ring that wraps": "algo=SPre env=R+T buffer_size=77",
}


class Breaks:
    """A `check` for the trainer that ends it at the given calls, which it counts over all resumptions."""

    def __init__(self, *at, error=None):
        self.calls, self.at = 0, at
        self.error = error or Interrupted(15)

    def __call__(self):
        self.calls += 1
        if self.calls in self.at:
            raise self.error


def train(root, words, check=lambda: None):
    ((config, base),) = run.plan([*words.split(), f"results={root}"])
    return run.train(config, base, check)


def train_through(root, words, check):
    """Start the same command again until it comes to its end; the number of times that it was interrupted."""
    interrupted = 0
    while True:
        try:
            train(root, words, check)
            return interrupted
        except type(check.error):
            interrupted += 1


def outcome(root):
    """Everything that a cell leaves but times, by seed."""
    return {folder.name: outcome_of(folder) for folder in find_runs(root)}


def outcome_of(folder):
    """The same of one run."""
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


@pytest.mark.parametrize("words", CASES.values(), ids=CASES)
def test_interrupted_anywhere_it_ends_with_the_bits_of_an_unbroken_run(tmp_path, words):
    words = f"{words} seed=3,5 {SETTINGS}"
    whole = Breaks()
    train(tmp_path / "whole", words, whole)
    # In the warm-up, amid episodes, between gradient steps, in evaluations.
    check = Breaks(*range(70, whole.calls, whole.calls // 5))
    assert train_through(tmp_path / "broken", words, check) in (4, 5)
    assert_identical(outcome(tmp_path / "whole"), outcome(tmp_path / "broken"))
    assert_never_apart(tmp_path / "broken")


def assert_never_apart(root):
    """Wherever seeds 3 and 5 resumed, they did so from the same moment."""
    for folder in root.glob("*/*/seed=[35]"):
        info = json.loads((folder / "info.json").read_text())
        assert all(start["lockstep"] == [3, 5] for start in [info, *info.get("resumed", [])])


# ---------------------------------------------------------------- kill -9


def kill_through(root, words, kills, rng):
    """Start the command and kill it at a random moment, `kills` times, then let it end; the seconds of the last start.

    The processes are forks of one that has imported everything, so that most kills meet the training.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["run"])
    longest = 1.0
    for n in range(kills + 1):
        process = context.Process(target=run.main, args=([*words.split(), f"results={root}"],))
        start = time.monotonic()
        process.start()
        if n < kills:
            process.join(rng.uniform(0.0, longest))
            process.kill()
            longest = 3.0
        process.join()
    return time.monotonic() - start


@pytest.mark.parametrize("checkpoint_every", [1, 30])
def test_killed_anywhere_it_ends_with_the_bits_of_an_unbroken_run(tmp_path, checkpoint_every):
    words = f"algo=DAlpha env=W+M seed=3,5 {SETTINGS}"
    train(tmp_path / "whole", words)
    # With a checkpoint after every step, most kills meet the writing of one, often between the two seeds' files.
    kill_through(
        tmp_path / "broken", f"{words} checkpoint_every={checkpoint_every}", 6, random.Random(checkpoint_every)
    )
    assert_identical(outcome(tmp_path / "whole"), outcome(tmp_path / "broken"))
    assert_never_apart(tmp_path / "broken")
