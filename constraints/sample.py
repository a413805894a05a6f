"""Uniform points in a convex set, by hit-and-run from points that are nearly uniform already."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_MARGIN = 1e-6
"""Steps stay this share of the chord away from its ends, so that rounding does not move the point out of the set."""
_THIN = 1e-9
"""Half the width that a flat set is given, so that its axes span the space."""


def uniform(lead: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Numbers (*lead,) uniform in [0, 1), in float64, drawn on the generator's device and moved to that of `like`."""
    device = like.device if generator is None else generator.device
    return torch.rand(lead, dtype=torch.float64, device=device, generator=generator).to(like.device)


def random_directions(lead: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Unit vectors (*lead,), uniform on the sphere; float64 and device as in `uniform`."""
    device = like.device if generator is None else generator.device
    normal = torch.randn(lead, dtype=torch.float64, device=device, generator=generator).to(like.device)
    return torch.nn.functional.normalize(normal, dim=-1)


def uniform_in_ball(lead: tuple[int, ...], like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Points (*lead,) uniform in the unit ball; float64 and device as in `uniform`."""
    directions = random_directions(lead, like, generator)
    return uniform((*lead[:-1], 1), like, generator) ** (1.0 / lead[-1]) * directions


def hit_and_run(
    gauge: Callable[[Tensor, Tensor], Tensor],
    oracle: Callable[[Tensor], Tensor],
    center: Tensor,
    count: int,
    generator: torch.Generator | None,
) -> Tensor:
    """Points (..., count, d) of a convex set, independent of each other and uniform.

    A step moves each point to a uniform one on its chord in a random direction (Smith 1984). Uniform points stay
    uniform; others become uniform, and faster in a rounder set. Directions are therefore drawn in `round_axes`, and the
    first points are uniform on their rays from the centre. On simplices, which are the slowest sets known, 4 d (d + 4)
    steps leave means that are wrong by less than 1 % of a standard deviation (measured for d = 2, 6 and 12).

    Args:
        gauge: returns L (..., count) of directions (..., count, d) around interior points (..., count, d).
        oracle: returns the point (..., d) of the set with the largest inner product with (..., d).
        center: (..., d) float64, an interior point.
    """
    dim = center.shape[-1]
    lead = (*center.shape[:-1], count, dim)
    axes = round_axes(oracle, center)

    def draw_directions() -> Tensor:
        return random_directions(lead, center, generator) @ axes.mT

    def draw_shares() -> Tensor:
        return uniform(lead[:-1], center, generator).clamp(_MARGIN, 1.0 - _MARGIN)

    middle, direction = center.unsqueeze(-2).expand(lead), draw_directions()
    point = middle + (draw_shares() ** (1.0 / dim) / gauge(direction, middle)).unsqueeze(-1) * direction
    for _ in range(4 * dim * (dim + 4)):
        direction = draw_directions()
        forward, back = gauge(torch.stack((direction, -direction)), point).reciprocal()
        point = point + ((forward + back) * draw_shares() - back).unsqueeze(-1) * direction
    return point


def round_axes(oracle: Callable[[Tensor], Tensor], center: Tensor) -> Tensor:
    """Columns (..., d, d): axes in whose coordinates the set is nearly round, however thin it is.

    Each axis is half the difference of the two points that are furthest apart in a direction orthogonal to all earlier
    axes (Betke and Henk 1993). For an ellipse they are conjugate semi-diameters, so that it becomes the unit ball.
    """
    dim = center.shape[-1]
    across = torch.eye(dim, dtype=center.dtype, device=center.device).expand(*center.shape, dim).clone()
    axes = []
    for _ in range(dim):
        # `across` projects onto the complement of all axes so far. Its longest column suffers least from rounding.
        longest = across.square().sum(-2).argmax(-1)[..., None, None].expand(*center.shape, 1)
        normal = torch.nn.functional.normalize(across.gather(-1, longest).squeeze(-1), dim=-1)
        axis = (oracle(normal) - oracle(-normal)) / 2.0
        # A set that is flat in this direction is sampled within its tolerance (`on_empty="least"`).
        axis = torch.where((axis == 0.0).all(-1, keepdim=True), _THIN * normal, axis)
        axes.append(axis)
        new = torch.nn.functional.normalize((across @ axis.unsqueeze(-1)).squeeze(-1), dim=-1, eps=0.0)
        across = across - new.unsqueeze(-1) * (across @ new.unsqueeze(-1)).mT
    return torch.stack(axes, -1)
