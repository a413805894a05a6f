"""User-defined sets for the benchmark of constraints: rows, and rows with an ellipse, in several sizes."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints import Constraint, Intersection, LinearConstraint, QuadraticConstraint


def legs(obs: Tensor) -> Tensor:
    """Rows (..., 2, 6) with the joint velocities of each leg of a HalfCheetah: row times action is the leg's power."""
    velocity = obs[..., 11:17].unflatten(-1, (2, 3))
    return torch.diag_embed(velocity.movedim(-2, -1)).movedim(-3, -1).flatten(-2)


def random_rows(rows: int, dim: int) -> LinearConstraint:
    """Half-spaces whose normals turn with the observation, at distances of 0.05 to 0.55 from the origin."""
    generator = torch.Generator(device="cpu").manual_seed(rows * dim)
    first, second = torch.randn(2, rows, dim, generator=generator, dtype=torch.float64).unbind()
    distance = 0.05 + 0.5 * torch.rand(rows, generator=generator, dtype=torch.float64)

    def normals(obs: Tensor) -> Tensor:
        normal = first + obs[..., :1, None].sin() * second
        return normal / normal.norm(dim=-1, keepdim=True)

    return LinearConstraint(dim, normals, lambda obs: distance)


def ball(dim: int, bound: float) -> QuadraticConstraint:
    return QuadraticConstraint(dim, lambda obs: torch.eye(dim, dtype=obs.dtype, device=obs.device), bound)


def ellipse(dim: int, bound: float) -> QuadraticConstraint:
    return QuadraticConstraint(dim, lambda obs: torch.diag_embed(1.0 + obs[..., :dim].sin().square()), bound)


def own_sets() -> dict[str, Constraint]:
    """Name (rows x dimensions) -> constraint on observations (..., 17)."""
    two = LinearConstraint(6, legs, lambda obs: obs.new_tensor([5.0, 5.0]))
    return {
        "2x6": two,
        "2x6+ball": Intersection(two, ball(6, 2.0)),
        "4x2": random_rows(4, 2),
        "64x6": random_rows(64, 6),
        "60x20": random_rows(60, 20),
        "200x50": random_rows(200, 50),
        "20x12+ellipse": Intersection(random_rows(20, 12), ellipse(12, 1.0)),
    }
