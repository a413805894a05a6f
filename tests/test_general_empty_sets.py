"""User-defined sets that are empty at some observations."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

import envs
from constraints import (
    Box,
    ConstraintError,
    Intersection,
    LinearConstraint,
    QuadraticConstraint,
    WeightedL1,
)
from constraints.errors import EmptySetError
from envs import TASKS, InfeasibleActionError, Robot, Task


def slab(obs: Tensor) -> Tensor:
    return torch.tensor([[0.6, 0.8], [-0.6, -0.8]], dtype=torch.float64)


def low_and_high(obs: Tensor) -> Tensor:
    """0.3 <= 0.6 a_1 + 0.8 a_2 <= obs, which is empty for obs < 0.3."""
    return torch.stack((obs[..., 0], torch.full_like(obs[..., 0], -0.3)), -1)


def linear(on_empty: str = "error") -> LinearConstraint:
    return LinearConstraint(2, slab, low_and_high, on_empty=on_empty)


def disc(obs: Tensor) -> Tensor:
    return torch.eye(2, dtype=torch.float64)


def curved(on_empty: str = "error") -> Intersection:
    """A disc of radius 0.2 around (obs, 0), and a_1 <= -0.3."""
    row = LinearConstraint(
        2, lambda obs: torch.tensor([[1.0, 0.0]]).double(), lambda obs: torch.tensor([-0.3]).double()
    )
    middle = QuadraticConstraint(2, disc, 0.04, lambda obs: torch.stack((obs[..., 0], 0 * obs[..., 0]), -1))
    return Intersection(row, middle, on_empty=on_empty)


def far(on_empty: str = "error") -> QuadraticConstraint:
    """A disc of radius 0.2 around (obs, 0), which the box may miss."""
    return QuadraticConstraint(2, disc, 0.04, lambda obs: torch.stack((obs[..., 0], 0 * obs[..., 0]), -1), on_empty)


OBS = torch.tensor([[[0.5], [0.1]], [[0.4], [-0.5]]], dtype=torch.float64)
ACTION = torch.tensor([0.9, -0.7], dtype=torch.float64).expand(2, 2, 2)


def methods(constraint, obs, action):
    return {
        "project": lambda: constraint.project(obs, action),
        "center": lambda: constraint.center(obs),
        "linear_oracle": lambda: constraint.linear_oracle(obs, action),
        "alpha_map": lambda: constraint.alpha_map(obs, action),
        "radial_map": lambda: constraint.radial_map(obs, action),
        "gauge_map": lambda: constraint.gauge_map(obs, action),
    }


@pytest.mark.parametrize("name", list(methods(None, None, None)))
def test_the_error_has_the_sample(name):
    cases = [
        (linear(), OBS, (0, 1)),
        (linear(), OBS[1], (1,)),
        (linear(), OBS[1, 1], ()),
        (LinearConstraint(1, lambda obs: obs[..., :1, None], lambda obs: -2 * obs[..., :1]), OBS[0, :, :1], (0,)),
        (curved(), torch.tensor([[-0.4], [0.0]]).double(), (1,)),
        (far(), torch.tensor([[0.4], [1.3]]).double(), (1,)),
    ]
    for constraint, obs, sample in cases:
        action = torch.full((*obs.shape[:-1], constraint.dim), 0.7, dtype=torch.float64)
        with pytest.raises(EmptySetError, match="the set is empty") as error:
            methods(constraint, obs, action)[name]()
        assert error.value.sample == sample
        assert isinstance(error.value, ConstraintError)
        copy = pickle.loads(pickle.dumps(error.value))
        assert copy.sample == sample and str(copy) == str(error.value)


def least_violation(constraint, obs: Tensor) -> Tensor:
    """The least violation (n,) on a grid of the box, 1e-2 wide."""
    side = torch.linspace(-1.0, 1.0, 201, dtype=torch.float64)
    grid = torch.cartesian_prod(side, side)
    return constraint.violation(obs.unsqueeze(1), grid).amin(1)


EMPTY = {
    "rows": (linear("least"), torch.tensor([[0.5], [0.1], [-0.4], [0.3]])),
    "row outside the box": (linear("least"), torch.tensor([[-9.0], [0.4], [-2.0], [-1.5]])),
    "ellipse and row": (curved("least"), torch.tensor([[-0.4], [0.0], [0.9], [-0.1]])),
    "ellipse outside the box": (far("least"), torch.tensor([[0.4], [1.3], [-2.0], [1.2]])),
    "with a closed form": (
        Intersection(
            WeightedL1(lambda obs: torch.ones_like(obs).expand(*obs.shape[:-1], 2), 0.4, 2),
            linear(),
            Box(2),
            on_empty="least",
        ),
        torch.tensor([[0.5], [0.1], [-0.4], [0.3]]),
    ),
}


@pytest.mark.parametrize("name", EMPTY)
def test_the_least_violation(name):
    constraint, obs = EMPTY[name]
    obs, action = obs.double(), torch.tensor([0.9, -0.7], dtype=torch.float64).expand(4, 2)
    least = least_violation(constraint, obs)
    exact = constraint.least_violation(obs)
    assert (exact <= least.clamp(min=0.0) + 1e-9).all() and (exact >= least - 1.1e-2)[least > 0.0].all()
    assert (exact[least <= 0.0] == 0.0).all()
    assert (least > 1e-3).any() and (least < 0.0).any() or name == "row outside the box"
    for method, call in methods(constraint, obs, action).items():
        result = call()
        violation = constraint.violation(obs, result)
        assert result.abs().max() <= 1.0 + 1e-12, method
        assert (violation <= exact + 1e-6).all() and (violation >= exact - 1e-9)[exact > 0.0].all(), method
        single = constraint.violation(obs, methods(constraint, obs.float(), action.float())[method]().double())
        assert (single <= exact + 2e-6).all(), method
    # Of the points with the least violation, the projection is the nearest, the oracle's the furthest along.
    others = constraint.project(obs.unsqueeze(1), 2.0 * torch.rand(1, 200, 2, dtype=torch.float64) - 1.0)
    nearest = (constraint.project(obs, action) - action).norm(dim=-1, keepdim=True)
    assert ((others - action.unsqueeze(1)).norm(dim=-1) >= nearest - 1e-5).all()
    best = (constraint.linear_oracle(obs, action) * action).sum(-1, keepdim=True)
    assert ((others * action.unsqueeze(1)).sum(-1) <= best + 1e-5).all()


def test_samples_that_are_not_empty_stay_as_they_are():
    obs, action = OBS.flatten(0, 1), ACTION.flatten(0, 1)
    kept = [0, 2]
    for name, call in methods(linear("least"), obs, action).items():
        alone = methods(linear(), obs[kept], action[kept])[name]()
        torch.testing.assert_close(call()[kept], alone, rtol=0.0, atol=1e-9, msg=name)
    for build, obs in ((curved, torch.tensor([[-0.4], [0.0]]).double()), (far, torch.tensor([[0.4], [1.3]]).double())):
        for name, call in methods(build("least"), obs, action[:2]).items():
            alone = methods(build(), obs[:1], action[:1])[name]()
            torch.testing.assert_close(call()[:1], alone, rtol=0.0, atol=1e-8, msg=name)


def test_a_row_that_no_action_meets_does_not_count():
    """The row 0 <= -1 is violated by 1 everywhere; the other row is satisfied."""
    rows = torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    constraint = LinearConstraint(
        2, lambda obs: rows, lambda obs: torch.tensor([-1.0, -0.5]).double(), on_empty="least"
    )
    obs = torch.zeros(1, 1, dtype=torch.float64)
    projected = constraint.project(obs, torch.tensor([[0.9, 0.3]], dtype=torch.float64))
    torch.testing.assert_close(projected, torch.tensor([[-0.5, 0.3]], dtype=torch.float64), rtol=0.0, atol=1e-6)
    assert constraint.violation(obs, projected) == 1.0 and constraint.least_violation(obs) == 1.0


def test_gradients_of_the_least_violation():
    obs = torch.tensor([[0.1]], dtype=torch.float64)
    action = torch.tensor([[0.4, -0.2]], dtype=torch.float64, requires_grad=True)
    constraint = linear("least")
    for method in (constraint.project, constraint.alpha_map, constraint.radial_map):
        assert torch.autograd.gradcheck(lambda a, m=method: m(obs, a), action, atol=1e-5)
    with pytest.raises(RuntimeError, match="no gradient.*where the set is empty"):
        constraint.project(obs.requires_grad_(), action)


def test_choices_of_on_empty():
    assert linear().on_empty == "error" and curved("least").on_empty == "least"
    with pytest.raises(ValueError, match="unknown on_empty 'nearest' \\(choices: error, least\\)"):
        linear("nearest")


class Still(Robot):
    """Observation (2,): a number that falls by 0.2 in each step, and 0."""

    obs_dim, action_dim, max_episode_steps, fps = 2, 2, 10, 10

    def reset(self, rng):
        self.steps = 0.0
        return np.array([0.5, 0.0])

    def step(self, action):
        self.steps += 1.0
        return np.array([0.5 - 0.2 * self.steps, 0.0]), 0.0, False, {}

    def render(self):
        return np.zeros((480, 480, 3), np.uint8)

    def close(self):
        pass


@pytest.mark.parametrize("project", [False, True])
def test_an_environment_admits_the_least_violation(project, monkeypatch):
    for on_empty in ("error", "least"):
        monkeypatch.setitem(TASKS, f"X+{on_empty}", Task(Still, linear(on_empty), "empty after a step", "", 1000))
        env = envs.make(f"X+{on_empty}", project=project)
        env.reset(seed=0)
        inside = env.constraint.project(torch.tensor([0.5, 0.0]).double(), torch.zeros(2).double()).numpy()
        env.step(inside)
        env.step(inside)  # the set is flat at the second step, empty at the third: 0.3 <= . <= 0.1
        if on_empty == "error":
            with pytest.raises(ConstraintError if project else InfeasibleActionError):
                env.step(inside)
            continue
        obs = torch.tensor([0.1, 0.0], dtype=torch.float64)
        assert env.constraint.least_violation(obs).item() == pytest.approx(0.1)
        if not project:
            with pytest.raises(InfeasibleActionError, match="at most 0.1"):
                env.step(inside)
        env.step(env.constraint.project(obs, torch.from_numpy(inside)).numpy())
        assert env.largest_violation == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_rows_of_small_integers(seed):
    """Rows that vanish, are parallel or meet in one point, with ties everywhere, against SciPy's linear programs."""
    generator = torch.Generator().manual_seed(seed)
    dim, rows = 1 + seed % 5, 1 + (5 * seed) % 11
    A = torch.randint(-2, 3, (8, rows, dim), generator=generator).double()
    b = torch.randint(-(seed % 2), 4, (8, rows), generator=generator).double() / 2.0
    action = torch.randint(-2, 3, (8, dim), generator=generator).double() / 2.0
    constraint = LinearConstraint(dim, lambda obs: A, lambda obs: b, on_empty="least")
    obs = torch.zeros(8, 1, dtype=torch.float64)
    least = constraint.least_violation(obs)
    for name, call in methods(constraint, obs, action).items():
        assert (constraint.violation(obs, call()) <= least + 1e-6).all(), name
    extreme = constraint.linear_oracle(obs, action)
    norm = A.norm(dim=-1)
    unit, limit = A / torch.where(norm > 0.0, norm, 1.0).unsqueeze(-1), b / torch.where(norm > 0.0, norm, 1.0)
    for k in range(8):
        sides = torch.cat((unit[k], torch.full((rows, 1), -1.0)), -1).numpy()
        expected = linprog([0.0] * dim + [1.0], sides, limit[k].numpy(), bounds=[(-1, 1)] * dim + [(0, None)]).fun
        assert abs(least[k].item() - expected) <= 1e-8
        if expected < 1e-9:
            best = -linprog(-action[k].numpy(), A[k].numpy(), b[k].numpy(), bounds=(-1, 1)).fun
            assert abs((action[k] @ extreme[k]).item() - best) <= 1e-6
