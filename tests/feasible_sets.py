"""Feasible sets for the tests of constraints, with observations and actions for them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from references import ReferenceSet, sign_rows, subset_rows
from torch import Tensor

from constraints import (
    Ball,
    Box,
    Constraint,
    DiagonalEllipse,
    HalfSpace,
    Intersection,
    LinearConstraint,
    PlanarEllipse,
    QuadraticConstraint,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)

# ------------------------------------------------------------------------------------------ the paper's tasks

# Observations here are (velocities, angles), d of each.


def velocities(obs: Tensor) -> Tensor:
    return obs[..., : obs.shape[-1] // 2]


def angles(obs: Tensor) -> Tensor:
    return obs[..., obs.shape[-1] // 2 :]


def squared_sines(obs: Tensor) -> Tensor:
    return angles(obs).sin() ** 2


def ones(obs: Tensor) -> Tensor:
    return torch.ones_like(velocities(obs))


def tip_matrix(obs: Tensor) -> Tensor:
    cos = angles(obs)[..., 1].cos()
    rows = torch.stack((2.0 + 2.0 * cos, 1.0 + cos), -1), torch.stack((1.0 + cos, torch.ones_like(cos)), -1)
    return torch.stack(rows, -2)


def leg_normal(obs: Tensor) -> Tensor:
    w, theta = velocities(obs), angles(obs)
    zero = torch.zeros_like(w[..., 0])
    first = w[..., 0] * theta[..., :3].sum(-1).sin()
    second = w[..., 3] * theta[..., 3:].sum(-1).sin()
    return torch.stack((first, zero, zero, second, zero, zero), -1)


def no_rows(dim: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((0, dim)), np.zeros(0)


def reference_l1(bound: float) -> Callable[[np.ndarray, np.ndarray], ReferenceSet]:
    def build(w: np.ndarray, theta: np.ndarray) -> ReferenceSet:
        rows = sign_rows(w)
        return ReferenceSet(rows, np.full(len(rows), bound))

    return build


def reference_positive(bound: float) -> Callable[[np.ndarray, np.ndarray], ReferenceSet]:
    def build(w: np.ndarray, theta: np.ndarray) -> ReferenceSet:
        rows = subset_rows(w)
        return ReferenceSet(rows, np.full(len(rows), bound))

    return build


def reference_half_space(w: np.ndarray, theta: np.ndarray) -> ReferenceSet:
    row = np.zeros((1, 6))
    row[0, 0] = w[0] * math.sin(theta[:3].sum())
    row[0, 3] = w[3] * math.sin(theta[3:].sum())
    return ReferenceSet(row, np.array([5.0]))


def reference_tip(w: np.ndarray, theta: np.ndarray) -> ReferenceSet:
    # a1^2 + 2 a1 (a1 + a2) cos + (a1 + a2)^2 = |a1 (1, 0) + (a1 + a2) (cos, sin)|^2
    frame = np.array([[1.0, math.cos(theta[1])], [0.0, math.sin(theta[1])]]) @ np.array([[1.0, 0.0], [1.0, 1.0]])
    return ReferenceSet(*no_rows(2), frame.T @ frame, 0.05)


def reference_both(w: np.ndarray, theta: np.ndarray) -> ReferenceSet:
    rows = sign_rows(w)
    return ReferenceSet(rows, np.full(len(rows), 10.0), np.diag(np.sin(theta) ** 2), 0.1)


@dataclass(frozen=True)
class Task:
    constraint: Constraint
    reference: Callable[[np.ndarray, np.ndarray], ReferenceSet]
    linear: bool = False

    def reference_at(self, obs: Tensor) -> ReferenceSet:
        return self.reference(velocities(obs).numpy(), angles(obs).numpy())


TASKS = {
    "R+N": Task(Box(2), lambda w, theta: ReferenceSet(*no_rows(2)), linear=True),
    "R+L2": Task(Ball(0.05, 2), lambda w, theta: ReferenceSet(*no_rows(2), np.eye(2), 0.05)),
    "R+O03": Task(WeightedL1(velocities, 0.3, 2), reference_l1(0.3), linear=True),
    "R+O10": Task(WeightedL1(velocities, 1.0, 2), reference_l1(1.0), linear=True),
    "R+O30": Task(WeightedL1(velocities, 3.0, 2), reference_l1(3.0), linear=True),
    "R+M": Task(WeightedPositivePart(velocities, 1.0, 2), reference_positive(1.0), linear=True),
    "R+T": Task(PlanarEllipse(tip_matrix, 0.05), reference_tip),
    "HC+O": Task(WeightedL1(velocities, 20.0, 6), reference_l1(20.0), linear=True),
    "HC+MA": Task(HalfSpace(leg_normal, 5.0, 6), reference_half_space, linear=True),
    "H+M": Task(WeightedPositivePart(velocities, 10.0, 3), reference_positive(10.0), linear=True),
    "H+O+S": Task(WeightedL1AndEllipse(velocities, 10.0, squared_sines, 0.1, 3), reference_both),
    "W+M": Task(WeightedPositivePart(velocities, 10.0, 6), reference_positive(10.0), linear=True),
    "W+O+S": Task(WeightedL1AndEllipse(velocities, 10.0, squared_sines, 0.1, 6), reference_both),
    # Not in the paper: the disc as an ellipse, and an ellipse that the box cuts. The degenerate angles below make some
    # or all s_i zero.
    "disc": Task(DiagonalEllipse(ones, 0.05, 2), lambda w, theta: ReferenceSet(*no_rows(2), np.eye(2), 0.05)),
    "cut ellipse": Task(
        DiagonalEllipse(squared_sines, 0.4, 4),
        lambda w, theta: ReferenceSet(*no_rows(4), np.diag(np.sin(theta) ** 2), 0.4),
    ),
}
every_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS.keys())


def sample_obs(task: Task, count: int, seed: int, largest: float = 1e6) -> Tensor:
    """Observations (count, 2d): velocities from 0.1 to `largest`, some exactly 0; angles, some exactly 0 or pi."""
    generator = torch.Generator().manual_seed(seed)
    dim = task.constraint.dim
    exponent = torch.tensor([-1.0, 0.0, 0.5, 1.0, 1.0, 1.5, math.log10(largest)])
    scale = 10.0 ** exponent[torch.randint(len(exponent), (count, 1), generator=generator)]
    w = torch.randn(count, dim, generator=generator) * scale
    w = w * (torch.rand(count, dim, generator=generator) > 0.15)
    theta = torch.randn(count, dim, generator=generator) * 2.0
    special = torch.rand(count, dim, generator=generator)
    theta = torch.where(special < 0.1, 0.0, torch.where(special < 0.2, math.pi, theta))
    theta[: count // 20] = 0.0
    w[count // 40 : count // 10] = 0.0
    return torch.cat((w, theta), -1).double()


def sample_action(task: Task, count: int, seed: int, scale: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(1000 + seed)
    return torch.randn(count, task.constraint.dim, generator=generator, dtype=torch.float64) * scale


def interior_point(task: Task, obs: Tensor, seed: int) -> Tensor:
    """Arbitrary interior points (..., d), other than the centre."""
    point = task.constraint.radial_map(obs, sample_action(task, len(obs), seed))
    return 0.9 * point


# ------------------------------------------------------------------------------------------ any dimension

WEIGHT = (2.0, -1.0, 0.7, 0.3, -1.5, 0.9)


def observation(dim: int) -> Tensor:
    return torch.tensor(WEIGHT[:dim], dtype=torch.float64)


def feasible_sets(dim: int) -> dict[str, tuple[Constraint, Tensor]]:
    """Name -> (set, centre): polytopes and ellipses, cut and not cut by the box, centred and not."""
    axis = torch.arange(dim, dtype=torch.float64)
    shift = 0.15 * torch.cos(2.0 * axis + 1.0)
    positive = WeightedPositivePart(lambda obs: obs, 1.0, dim)
    return {
        "box": (Box(dim), torch.zeros(dim, dtype=torch.float64)),
        "box off centre": (Box(dim), 2.0 * shift),
        "weighted l1": (WeightedL1(lambda obs: obs, 1.5, dim), torch.zeros(dim, dtype=torch.float64)),
        "weighted l1 off centre": (WeightedL1(lambda obs: obs, 1.5, dim), shift),
        "positive part": (positive, positive.center(observation(dim))),
        "ball": (DiagonalEllipse(torch.ones_like, 0.6, dim), torch.zeros(dim, dtype=torch.float64)),
        "ellipse cut by the box": (
            DiagonalEllipse(lambda obs: obs.square(), 0.9, dim),
            torch.zeros(dim, dtype=torch.float64),
        ),
    }


SETS = tuple(feasible_sets(2))


def gauge_and_gradient(constraint, obs, direction, center) -> tuple[Tensor, Tensor]:
    direction = direction.detach().requires_grad_()
    gauge = constraint.gauge(obs, direction, center)
    (gradient,) = torch.autograd.grad(gauge.sum(), direction)
    return gauge.detach(), gradient


# ------------------------------------------------------------------------------------------ general sets

SHAPES = [  # dim, rows, ellipses, rank, scale
    (1, 2, 0, 1, 1.0),
    (2, 3, 0, 1, 1.0),
    (6, 40, 0, 1, 1.0),
    (20, 30, 0, 1, 1.0),
    (1, 0, 1, 1, 0.1),
    (2, 0, 1, 2, 1.0),
    (6, 0, 1, 3, 1.0),
    (2, 2, 1, 2, 0.01),
    (3, 4, 2, 3, 1.0),
    (6, 10, 2, 2, 1.0),
    (20, 10, 2, 20, 10.0),
]


def random_set(dim: int, rows: int, ellipses: int, rank: int, scale: float, seed: int, batch: int = 4) -> Constraint:
    """A set around a random point of the box, with rows of norm 1e-2 to 1e4 and ellipses of rank `rank` and size
    `scale`. One row in eight passes very close to the point."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(batch, *shape, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(batch, *shape, generator=generator, dtype=torch.float64)

    inside = 1.8 * uniform(dim) - 0.9
    parts: list[Constraint] = []
    if rows:
        A = normal(rows, dim) * 10.0 ** (6.0 * uniform(rows, 1) - 2.0)
        b = (A @ inside[..., None])[..., 0] + A.norm(dim=-1) * (0.01 + uniform(rows) ** 3)
        parts.append(LinearConstraint(dim, lambda obs: A, lambda obs: b))
    for _ in range(ellipses):
        root = normal(rank, dim)
        Q = root.mT @ root
        bound = scale * (0.05 + uniform())
        offset = normal(dim)
        size = (offset * (Q @ offset[..., None])[..., 0]).sum(-1)
        c = inside + offset * (bound / size).sqrt()[..., None] * 0.95 * uniform(1)
        values = dict(Q=lambda obs, Q=Q: Q, bound=lambda obs, b=bound: b, c=lambda obs, c=c: c)
        parts.append(QuadraticConstraint(dim, **values))
    return parts[0] if len(parts) == 1 else Intersection(*parts)


def no_obs(batch: int = 4) -> Tensor:
    return torch.zeros(batch, 1, dtype=torch.float64)
