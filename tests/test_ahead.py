"""Random numbers drawn many gradient steps ahead equal the numbers that each step would have drawn itself."""

import pytest
import torch

from core.ahead import BLOCK, Ahead, Draw
from core.random import Streams

SEEDS = [4, 7, 9]
KINDS = {
    "in groups of 16": [[Draw("normal", (2, 8, 3))]],
    "not in groups of 16": [[Draw("normal", (25, 3))]],
    "few": [[Draw("normal", (3,))]],
    "uniform": [[Draw("uniform", (5, 2))]],
    "two draws": [[Draw("normal", (16,)), Draw("uniform", (3,))]],
    "two kinds": [[Draw("normal", (16,))], [Draw("uniform", (4,)), Draw("normal", (5, 5)), Draw("normal", ())]],
    "a kind without": [[], [Draw("normal", (16,))]],
}


def ahead_of(streams, kinds):
    streams.ahead = Ahead(streams.generators, kinds, torch.device("cpu"))
    return streams


def test_a_stream_has_only_words_or_none():
    with pytest.raises(AssertionError, match="only words, or none"):
        Ahead([torch.Generator()], [[Draw("words", (4,)), Draw("normal", (4,))]], torch.device("cpu"))


def step(streams, kinds, number):
    """The draws of step `number`."""
    kind = number % len(kinds)
    if streams.ahead:
        streams.ahead.begin(kind)
        streams.ahead.read(kind)
    return [getattr(streams, draw.kind)(*draw.shape) for draw in kinds[kind]]


@pytest.mark.parametrize("kinds", KINDS.values(), ids=KINDS)
def test_a_block_has_the_numbers_of_its_steps(kinds):
    plain, ahead = Streams(SEEDS, "update"), ahead_of(Streams(SEEDS, "update"), kinds)
    for number in range(BLOCK + 7):
        for one, other in zip(step(plain, kinds, number), step(ahead, kinds, number), strict=True):
            assert one.shape == other.shape and torch.equal(one, other)
        if number % 9 == 0:
            assert all(torch.equal(plain.state(i), ahead.state(i)) for i in range(len(SEEDS)))


@pytest.mark.parametrize("count", [16, 100, 7, 1])
def test_words_make_the_integers_of_randint(count):
    plain, ahead = Streams(SEEDS, "replay"), ahead_of(Streams(SEEDS, "replay"), [[Draw("words", (count,))]])
    for number in range(BLOCK + 7):
        sizes = [1, 1000 + number, 2**27 - number]
        ahead.ahead.begin(0)
        ahead.ahead.read(0)
        expected = plain.indices(sizes, count)
        assert torch.equal(expected, ahead.indices([], count, torch.tensor(sizes).unsqueeze(1)))
        if number in (5, BLOCK, BLOCK + 6):
            assert all(torch.equal(plain.state(i), ahead.state(i)) for i in range(len(SEEDS)))


def test_a_stream_that_is_put_back_draws_the_same_again():
    kinds = KINDS["two kinds"]
    plain, ahead = Streams(SEEDS, "update"), ahead_of(Streams(SEEDS, "update"), kinds)
    for number in range(11):
        step(plain, kinds, number)
        step(ahead, kinds, number)
    saved = ahead.state(1)
    for number in range(11, 20):
        step(plain, kinds, number)
        step(ahead, kinds, number)
    for streams in (plain, ahead):
        streams.load_state(1, saved)
    assert all(torch.equal(plain.state(i), ahead.state(i)) for i in range(len(SEEDS)))
    for number in range(21, 21 + BLOCK):  # not the kind that was expected next
        for one, other in zip(step(plain, kinds, number), step(ahead, kinds, number), strict=True):
            assert torch.equal(one, other)


def test_what_a_captured_step_cannot_do_is_an_error():
    kinds = KINDS["two kinds"]
    ahead = ahead_of(Streams(SEEDS, "update"), kinds)
    ahead.ahead.begin(0)
    with pytest.raises(RuntimeError, match="do not alternate"):
        ahead.ahead.begin(0)
    ahead.ahead.read(0)
    with pytest.raises(RuntimeError, match="unlike the step before"):
        ahead.uniform(16)
    with pytest.raises(ValueError, match="for all seeds"):
        ahead.normal(16, which=[0])
    ahead.normal(16)
    with pytest.raises(RuntimeError, match="unlike the step before"):
        ahead.normal(16)
