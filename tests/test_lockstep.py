"""Seeds trained in lockstep learn what each learns alone."""

import pytest
import torch
from helpers import config_of

from core.replay import Replay
from store.writer import RunWriter
from sweep.train import make_trainer


class RecordingReplay(Replay):
    """Keeps a checksum of every batch of every seed, and each seed's transitions."""

    def sample(self, batch_size):
        batch = super().sample(batch_size)
        self.shown.append([float(batch.obs[i].double().sum()) for i in range(len(self.added))])
        return batch


# Copies of the critic start early, so that they are replaced several times.
OWN_SETTINGS = {"ARAM": {"snapshots_after": 50, "snapshot_every": 30}}


def configuration(algo, env, seed, **settings):
    settings = {"steps": 600, "learning_starts": 300, "batch_size": 16, "eval_every": 300} | settings
    settings |= {"eval_episodes": 1, "final_episodes": 1, "hidden": "[32,32]"} | OWN_SETTINGS.get(algo, {})
    return config_of([f"algo={algo}", f"env={env}", f"seed={seed}", *(f"{k}={v}" for k, v in settings.items())])


def train(tmp_path, algo, env, seed, **settings):
    """Train a short run. Returns a dict for each seed: the last parameters, the transitions in the order of storing,
    the number of gradient steps, the mean return, and a checksum of the batch of each gradient step."""
    config = configuration(algo, env, seed, **settings)
    seeds = [int(s) for s in str(seed).split(",")]
    writers = [RunWriter(tmp_path / f"{algo}-{seed}" / f"seed={s}", {}, {}, 1) for s in seeds]
    trainer = make_trainer(config, seeds, writers, progress=False)
    trainer.replay.__class__ = RecordingReplay
    trainer.replay.shown = []
    results = trainer.run()
    if algo == "ARAM":
        assert (trainer.agent.copies > config.snapshots).all() and not trainer.agent.missing.any()
    rows = trainer.replay.rows.view(len(seeds), trainer.replay.capacity, -1)
    return {
        s: {
            "parameters": torch.load(writers[i].folder / "last.pt", weights_only=True),
            "transitions": rows[i, : trainer.replay.added[i]],
            "gradient_steps": results[i]["gradient_steps"],
            "return": results[i]["return_mean"],
            "batches": [shown[i] for shown in trainer.replay.shown][: results[i]["gradient_steps"]],
        }
        for i, s in enumerate(seeds)
    }


CASES = {
    "TD3 on Reacher": ("DPre+", "R+O10"),
    "SAC with gSDE": ("SRad", "R+M"),
    "NFWPO": ("NFW", "R+L2"),
    # (Much longer runs differ: contact amplifies a rounding error by a factor of ten in some twenty steps.)
    # Untrained walkers fall after 10 to 50 steps, each seed at other times; updates come once an episode.
    "TD3 on Walker2d": ("DAlpha", "W+M"),
    "SAC on Walker2d": ("SAlpha", "W+O+S"),
    "SAC with stored centres": ("SRad", "W+M"),
    "ARAM": ("ARAM", "R+L2"),
}


def assert_same(alone, among):
    assert among["gradient_steps"] == alone["gradient_steps"]
    assert len(alone["transitions"]) == len(among["transitions"])
    assert len(alone["batches"]) == len(among["batches"]) == alone["gradient_steps"]
    # The random numbers have the same bits; so have the data, until roundings of the weights affect them.
    assert torch.equal(alone["transitions"][:300], among["transitions"][:300])
    torch.testing.assert_close(alone["transitions"], among["transitions"], rtol=0, atol=1e-3)
    assert alone["batches"] == pytest.approx(among["batches"], abs=1e-2)
    for name, parameter in alone["parameters"].items():
        torch.testing.assert_close(parameter, among["parameters"][name], rtol=0, atol=1e-4, msg=name)


@pytest.mark.parametrize("algo, env", CASES.values(), ids=CASES)
def test_a_seed_learns_the_same_alone_and_among_others(tmp_path, algo, env):
    alone = train(tmp_path, algo, env, "3")[3]
    together = train(tmp_path, algo, env, "1,3,8")
    assert_same(alone, together[3])
    assert alone["gradient_steps"] >= 150
    # Neighbours are different seeds, not copies.
    assert not torch.equal(together[1]["transitions"][:300], together[3]["transitions"][:300])
    if env.startswith("W") and configuration(algo, env, "3").train_freq == "episode":
        assert len({together[s]["gradient_steps"] for s in together}) > 1


def test_a_seed_that_finishes_late_learns_what_it_learns_alone(tmp_path):
    """Its finished neighbours take part in its last gradient steps, without effect on any seed."""
    together = train(tmp_path, "DAlpha", "W+M", "1,3,8")
    # All unfinished seeds take every gradient step, so the seed with the most steps finishes last.
    early, *_, late = sorted(together, key=lambda seed: together[seed]["gradient_steps"])
    assert together[early]["gradient_steps"] < together[late]["gradient_steps"]
    for seed in (early, late):
        assert_same(train(tmp_path, "DAlpha", "W+M", str(seed))[seed], together[seed])


def test_different_seeds_start_from_different_networks(tmp_path):
    runs = train(tmp_path, "DPre", "R+N", "0,1", steps=10, learning_starts=10, eval_every=10)
    first, second = (runs[s]["parameters"]["actor.layers.0.weight"] for s in (0, 1))
    assert not torch.equal(first, second)


def test_the_same_seed_twice_gives_the_same_bits(tmp_path):
    one = train(tmp_path / "a", "SPre", "R+T", "5", steps=400, learning_starts=200)[5]
    two = train(tmp_path / "b", "SPre", "R+T", "5", steps=400, learning_starts=200)[5]
    assert torch.equal(one["transitions"], two["transitions"])
    assert all(torch.equal(p, two["parameters"][name]) for name, p in one["parameters"].items())
