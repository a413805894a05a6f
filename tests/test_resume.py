"""A run that is interrupted, killed or damaged and then resumed ends with the same bits as an unbroken run."""

import multiprocessing
import random
import time

import pytest
from helpers import Breaks, assert_identical, assert_never_apart, outcome, train, train_through

from sweep.train import train_words

SETTINGS = "steps=240 learning_starts=60 batch_size=8 hidden=[16,16] eval_every=100 eval_episodes=1 final_episodes=1"
CASES = {
    "TD3 on Reacher": "algo=DPre+ env=R+O10",
    "TD3 on Walker2d": "algo=DOpt env=W+M",
    "SAC with gSDE": "algo=SRad env=R+M",
    "SAC with stored centres": "algo=SAlpha env=W+M",
    "NFWPO on Reacher": "algo=NFW env=R+L2",
    "NFWPO on Walker2d": "algo=NFW env=W+O+S",
    "ARAM": "algo=ARAM env=R+L2 rejected_kept=50 snapshots_after=10 snapshot_every=20",
    "a ring that wraps": "algo=SPre env=R+T buffer_size=77",
}


@pytest.mark.parametrize("words", CASES.values(), ids=CASES)
def test_interrupted_anywhere_it_ends_with_the_bits_of_an_unbroken_run(tmp_path, words):
    words = f"{words} seed=3,5 {SETTINGS}"
    whole = Breaks()
    train(tmp_path / "whole", words, whole)
    # Interrupts in the warm-up, within episodes, between gradient steps, and in evaluations.
    check = Breaks(*range(70, whole.calls, whole.calls // 5))
    assert train_through(tmp_path / "broken", words, check) in (4, 5)
    assert_identical(outcome(tmp_path / "whole"), outcome(tmp_path / "broken"))
    assert_never_apart(tmp_path / "broken")


# ---------------------------------------------------------------- kill -9


def kill_through(root, words, kills, rng):
    """Start the command and kill it at a random moment, `kills` times, then let it end. Returns the last run's seconds.

    The processes are forked from one that has imported everything, so that most kills hit the training.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sweep.train"])
    longest = 1.0
    for n in range(kills + 1):
        process = context.Process(target=train_words, args=(f"{words} results={root}",))
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
    # With a checkpoint after every step, most kills hit the writing of one, often between the two seeds' files.
    kill_through(
        tmp_path / "broken", f"{words} checkpoint_every={checkpoint_every}", 6, random.Random(checkpoint_every)
    )
    assert_identical(outcome(tmp_path / "whole"), outcome(tmp_path / "broken"))
    assert_never_apart(tmp_path / "broken")
