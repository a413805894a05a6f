"""A state with an empty set ends its own seed with a message that says where, and does not affect other seeds."""

import json
import math

import pytest
import torch
from helpers import Breaks, assert_identical, outcome, run_command, train, train_through

import envs
from algos import ALGORITHMS
from constraints import ConstraintError, LinearConstraint
from core.guard import Guard
from core.random import stream_seed
from envs import TASKS, Task
from envs.reacher import Reacher

WORDS = (
    "env=R+Gap seed=3,5,8 steps=60 learning_starts=30 batch_size=24 hidden=[8,8] eval_every=30 eval_episodes=1"
    " final_episodes=1 train_freq=1 gradient_steps=1"
)


class Gaps(LinearConstraint):
    """a_1 <= 0.5, and a_1 >= 0.6 too at the observations that `is_gap` knows: the set is empty there."""

    def __init__(self):
        super().__init__(dim=2)
        self.is_gap = lambda obs: torch.zeros(obs.shape[:-1], dtype=torch.bool)

    def A(self, obs):
        return torch.tensor([[1.0, 0.0], [-1.0, 0.0]]).expand(*obs.shape[:-1], 2, 2)

    def b(self, obs):
        return torch.where(self.is_gap(obs).unsqueeze(-1), torch.tensor([0.5, -0.6]), torch.tensor([0.5, 1.0]))


@pytest.fixture
def gaps(monkeypatch):
    constraint = Gaps()
    task = Task(robot=Reacher, constraint=constraint, description="", formula="", steps=1)
    monkeypatch.setitem(TASKS, "R+Gap", task)
    return constraint


def first_observation(seed, purpose="environment", resets=1):
    """The observation after `resets` resets of the seed's environment for training or for another `purpose`."""
    env = envs.make("R+N")
    obs = env.reset(seed=stream_seed(seed, purpose))[0]
    for _ in range(resets - 1):
        obs = env.reset()[0]
    return torch.as_tensor(obs)


def near(target, distance=1e-4):
    return lambda obs: (obs - target).abs().amax(-1) < distance


def failures(root):
    return {path.parent.name: json.loads(path.read_text()) for path in root.glob("*/*/seed=?/failed.json")}


def sound_seeds(root):
    for folder in root.glob("*/*/seed=5"):
        folder.rename(folder.with_name("aside"))
    return outcome(root)


class GapAfter:
    """A test for observations near `target`, which holds from a certain gradient step on."""

    def __init__(self, monkeypatch, algo, updates, target):
        self.near, self.count = near(target), 0
        agent_class = ALGORITHMS[algo].agent
        update = agent_class.update

        def counted(agent, batch):
            self.count += 1
            self.batch = batch
            update(agent, batch)

        monkeypatch.setattr(agent_class, "update", counted)
        self.updates = updates

    def __call__(self, obs):
        return self.near(obs) & (self.count >= self.updates)


@pytest.mark.parametrize(
    "algo, where",
    [
        ("DRad", "start"),
        ("SPre+", "start"),
        ("ARAM", "start"),
        ("DGauge", "batch"),
        ("SAlpha", "batch"),
        ("NFW", "batch"),
        ("DPro", "evaluation"),
    ],
)
def test_an_empty_set_ends_its_own_seed(tmp_path, monkeypatch, gaps, capsys, algo, where):
    words = f"algo={algo} {WORDS}"
    train(tmp_path / "sound", words)
    if where == "evaluation":  # the second reset starts the first evaluation
        target = first_observation(5, "evaluation", resets=2)
        gaps.is_gap = near(target)
    else:
        target = first_observation(5)
        gaps.is_gap = near(target) if where == "start" else GapAfter(monkeypatch, algo, 11, target)
    assert run_command([*words.split(), f"results={tmp_path / 'spoiled'}"]) == 3
    ((name, failure),) = failures(tmp_path / "spoiled").items()
    assert name == "seed=5"
    if where == "batch":  # some batch from the 11th on has the transition
        assert 41 <= failure["step"] < 60 and failure["result"]["best_step"] == 30
    else:
        assert failure["step"] == {"start": 0, "evaluation": 30}[where]
    assert "the constraint of R+Gap: " in failure["quantity"]
    assert "empty" in failure["quantity"] or "not interior" in failure["quantity"] or "inside" in failure["quantity"]
    text = failure["quantity"].partition("at observation ")[2]
    torch.testing.assert_close(torch.tensor(json.loads(text)), target.float())
    assert f"failed at step {failure['step']}" in capsys.readouterr().err
    sound = outcome(tmp_path / "sound")
    assert_identical({seed: sound[seed] for seed in ("seed=3", "seed=8")}, sound_seeds(tmp_path / "spoiled"))


def test_the_others_resume_exactly_after_an_empty_set(tmp_path, monkeypatch, gaps):
    words = f"algo=DRad {WORDS}"
    train(tmp_path / "sound", words)
    gaps.is_gap = near(first_observation(5))
    assert train_through(tmp_path / "spoiled", words, Breaks(20, 60, 100)) == 3
    assert list(failures(tmp_path / "spoiled")) == ["seed=5"]
    sound = outcome(tmp_path / "sound")
    assert_identical({seed: sound[seed] for seed in ("seed=3", "seed=8")}, sound_seeds(tmp_path / "spoiled"))


def test_all_seeds_may_meet_an_empty_set(tmp_path, gaps):
    gaps.is_gap = lambda obs: obs[..., 0] > -2  # this entry is a cosine: true everywhere
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sweep.train.check_training", lambda *_: None)  # the check would refuse the task
        assert run_command([*f"algo=DRad {WORDS}".split(), f"results={tmp_path}"]) == 3
    assert len(failures(tmp_path)) == 3
    assert all(failure["step"] == 0 and "result" not in failure for failure in failures(tmp_path).values())


def test_an_error_of_no_single_seed_ends_the_run_and_says_where(tmp_path, gaps, capsys):
    words = f"algo=DRad {WORDS} checkpoint_every=10"
    outcomes = iter([False] * 5 + [True])  # for calls in gradient steps; other calls do not fail

    def breaks(obs):
        if obs.dim() == 3 and obs.shape[1] == 24 and next(outcomes, False):
            raise ZeroDivisionError("in the user's code")
        return torch.zeros(obs.shape[:-1], dtype=torch.bool)

    gaps.is_gap = breaks
    with pytest.raises(ZeroDivisionError):
        train(tmp_path / "broken", words)
    said = capsys.readouterr().err
    assert "DRad on R+Gap, seeds 3, 5, 8, step " in said and "resumes from step 30" in said
    train(tmp_path / "broken", words)
    train(tmp_path / "sound", words)
    assert_identical(outcome(tmp_path / "broken"), outcome(tmp_path / "sound"))


def test_a_guard_raises_what_it_cannot_give_to_one_seed():
    constraint = Gaps()
    constraint.is_gap = lambda obs: obs[..., 0] < 0
    obs = torch.tensor([[1.0], [-1.0]])
    guard = Guard(constraint, 2)
    assert guard.constraint.center(obs).isfinite().all() and list(guard.refused) == [1]
    assert guard.refused[1].endswith("at observation [-1.0]")
    for wrong in (obs[1], obs[1:], obs.repeat(2, 1)):  # without the axis of the seeds
        with pytest.raises(ConstraintError):
            Guard(constraint, 2).constraint.center(wrong)
    with pytest.raises(ConstraintError):
        Guard(constraint, 2).constraint.center(-obs.abs())
    with guard.of([1]) as refused:
        assert refused == {} and guard.constraint.center(obs[:1]).shape == (1, 2)
    assert list(guard.refused) == [1]


def test_rows_without_an_empty_set_keep_their_bits():
    constraint = Gaps()
    constraint.is_gap = lambda obs: obs[..., 0] < 0
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(3, 5, 2, generator=generator).abs()
    obs[1, 2] *= -1.0
    action = (2 * torch.randn(3, 5, 2, generator=generator)).requires_grad_()
    guard = Guard(constraint, 3)
    for method in ("project", "radial_map", "alpha_map", "gauge_map"):
        mapped = getattr(guard.constraint, method)(obs, action)
        (gradient,) = torch.autograd.grad(mapped.sum(), action)
        for i in (0, 2):
            alone = getattr(constraint, method)(obs[i : i + 1], action[i : i + 1])
            assert torch.equal(alone[0], mapped[i])
            assert torch.equal(torch.autograd.grad(alone.sum(), action)[0][i], gradient[i])
    assert list(guard.refused) == [1]
    ray = Guard(constraint, 3).constraint.ray(obs, action, torch.zeros(3, 5, 2))
    assert math.isfinite(ray.radial_map().sum().item())
