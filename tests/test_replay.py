"""The replay buffer's ring, and the random streams that make every seed independent of its neighbours."""

import pytest
import torch

from core.random import PURPOSES, Streams
from core.replay import Batch, Replay


def numbered(seeds, number, centers=True):
    """Transition `number`: seed i's obs is 100 i + number, and every other column is derived from the same value."""
    value = torch.arange(seeds).unsqueeze(1) * 100.0 + number
    columns = [torch.cat([value, -value], 1), value + 0.1, value + 0.2, value % 2, torch.cat([value + 0.3] * 2, 1)]
    return Batch(*columns, *([value + 0.4, value + 0.5] if centers else []))


def filled(seeds, counts, capacity, centers=True):
    replay = Replay(seeds, capacity, obs_dim=2, action_dim=1, centers=centers)
    for number in range(max(counts)):
        which = [i for i, count in enumerate(counts) if number < count]
        replay.add(which, numbered(len(seeds), number, centers))
    return replay


def test_the_ring_keeps_the_last_transitions_of_every_seed():
    replay = filled([4, 7, 9], counts=[13, 3, 10], capacity=5)
    obs = replay.sample(400).obs[..., 0]
    kept = [sorted(set(row.tolist())) for row in obs]
    assert kept == [[8, 9, 10, 11, 12], [100, 101, 102], [205, 206, 207, 208, 209]]


def test_a_sample_is_of_whole_transitions():
    batch = filled([4, 7], counts=[13, 3], capacity=5).sample(50)
    value = batch.obs[..., :1]
    assert batch.obs.shape == (2, 50, 2) and batch.action.shape == (2, 50, 1) and batch.reward.shape == (2, 50)
    torch.testing.assert_close(batch.obs, torch.cat([value, -value], -1))
    torch.testing.assert_close(batch.action, value + 0.1)
    torch.testing.assert_close(batch.reward, value[..., 0] + 0.2)
    torch.testing.assert_close(batch.terminated, value[..., 0] % 2)
    torch.testing.assert_close(batch.next_obs, torch.cat([value + 0.3] * 2, -1))
    torch.testing.assert_close(batch.center, value + 0.4)
    torch.testing.assert_close(batch.next_center, value + 0.5)


def test_without_centers_the_batch_has_none():
    batch = filled([4, 7], counts=[6, 3], capacity=5, centers=False).sample(10)
    assert batch.center is None and batch.next_center is None
    torch.testing.assert_close(batch.next_obs[..., 0], batch.obs[..., 0] + 0.3)


def test_sampling_is_uniform_with_replacement():
    obs = filled([4, 7], counts=[23, 4], capacity=10).sample(40_000).obs[..., 0].long()
    for row, size in zip(obs, (10, 4), strict=True):
        counts = row.bincount().double()
        counts = counts[counts > 0]
        expected = 40_000 / size
        assert len(counts) == size
        # Chi-squared: mean size - 1, variance 2 (size - 1); the streams are fixed, so this never fails by chance.
        assert ((counts - expected).square() / expected).sum() < size - 1 + 4 * (2 * (size - 1)) ** 0.5


def test_a_seed_samples_the_same_alone_and_among_others():
    together = filled([1, 3, 8], counts=[17, 12, 2], capacity=10)
    alone = Replay([3], 10, obs_dim=2, action_dim=1, centers=True)
    for number in range(12):
        alone.add([0], Batch(*(column[1:2] for column in numbered(3, number))))
    for _ in range(3):
        for column, lone in zip(together.sample(20), alone.sample(20), strict=True):
            assert torch.equal(column[1:2], lone)


@pytest.mark.parametrize("draw", ["normal", "uniform"])
def test_streams_draw_what_each_seed_alone_would(draw):
    together, lone = Streams([1, 3, 8], "explore"), Streams([3], "explore")
    # Seed 3 draws three times; its neighbours draw at other times.
    for only in ([0, 1, 2], [1], [1, 2]):
        drawn = getattr(together, draw)(4, 2, which=only)
        assert torch.equal(drawn[1], getattr(lone, draw)(4, 2)[0])
        for i in {0, 1, 2} - set(only):
            assert not drawn[i].any()
    first = Streams([1], "explore")
    getattr(first, draw)(4, 2)
    # Seed 1 has skipped two draws: its stream is where it was after its only draw.
    assert torch.equal(getattr(together, draw)(4, 2)[0], getattr(first, draw)(4, 2)[0])


def test_streams_indices_are_those_of_each_seed_alone():
    drawn = Streams([1, 3, 8], "replay").indices([5, 70, 2], 50)
    assert torch.equal(drawn[1], Streams([3], "replay").indices([70], 50)[0])
    assert (drawn >= 0).all() and (drawn.amax(1) < torch.tensor([5, 70, 2])).all()


def test_streams_of_other_seeds_and_purposes_differ():
    draws = [Streams([seed], purpose).normal(4) for seed in range(5) for purpose in PURPOSES]
    assert len({tuple(draw.flatten().tolist()) for draw in draws}) == len(draws)


def test_the_distributions_of_the_streams():
    normal, uniform = (getattr(Streams([0, 1], "explore"), draw)(50_000) for draw in ("normal", "uniform"))
    for row in normal:
        assert row.mean().abs() < 0.02 and (row.std() - 1).abs() < 0.02
    for row in uniform:
        assert -1 <= row.min() < -0.999 and 0.999 < row.max() < 1
        assert row.mean().abs() < 0.02 and (row.std() - 3**-0.5).abs() < 0.01


def test_transitions_on_their_way_are_in_the_buffer_whenever_it_is_read():
    for count in (1, 4, 5, 6, 17):
        replay = filled([4, 7], [count, count - 1], capacity=5)
        assert bool(replay.waiting) == bool(count % 5)
        for i, added in enumerate((count, count - 1)):
            numbers = range(max(0, added - 5), added)
            views = replay.stretch(i, numbers.start, numbers.stop)
            assert torch.cat([view[:, 0] for view in views]).tolist() == [100.0 * i + number for number in numbers]
        assert not replay.waiting


def test_the_device_knows_how_much_it_can_sample():
    """Also after restoring a checkpoint, which writes transitions and their number directly."""
    replay = filled([4, 7], [3, 8], capacity=5)
    replay.flush()
    assert replay.sizes.tolist() == [[3], [5]]
    replay.added[0] = 4
    replay.flush()
    assert replay.sizes.tolist() == [[4], [5]]
