"""Interior points of sets of rows, and of sets with ellipses."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import EmptySetError, require
from constraints.general.active_set import project_on_rows
from constraints.general.depth import deepest_on_rows, deepest_points
from constraints.general.derivatives import with_derivatives
from constraints.general.projection import closest_points
from constraints.general.scaled_sets import NO_INTERIOR, ScaledSets, guessed_points
from constraints.numerics import times

# The share of the largest radius that a centre keeps. A larger one leaves less room in which it moves continuously.
_DEEP = 0.9
# A guess less deep than this, or than half of the largest depth, gives way to a point that is nearly the deepest.
_SHALLOW = 1e-2
# In a set that is nowhere deeper, too little room is left beside the deepest point.
_THIN = 1e-6


def deep_points(traced: ScaledSets) -> Tensor:
    """Centres (n, d) of sets without ellipses: the point nearest to the origin of those that are `_DEEP` times as deep
    as the deepest. An EmptySetError where a set is empty or flat. Differentiable where the sets are.

    It is continuous in rows and bounds. The largest depth is: it is the maximum over the box of a continuous function.
    The points of that share of it are a convex set with interior, so they move continuously, and so does the one of
    them that is nearest to the origin. The deepest points themselves may jump: those of a wedge are at its wide end,
    however small its angle.
    """
    sets = traced.detach()
    deepest, weight = deepest_on_rows(sets)
    require(deepest[:, -1] >= -NO_INTERIOR, "the set is empty", sets.name, EmptySetError)
    require(deepest[:, -1] > NO_INTERIOR, "the set has no interior", sets.name, EmptySetError)
    radius = deepest[:, -1]
    if traced.rows.requires_grad or traced.bounds.requires_grad:
        # The radius changes with the slacks at the deepest point, by the multipliers of its rows.
        slack = traced.bounds - times(traced.rows, deepest[:, :-1])
        radius = radius + (weight * (slack - slack.detach())).sum(-1)
    shrunk = traced.inner(_DEEP * radius)
    target = torch.zeros_like(sets.rows[:, 0])
    bounds = shrunk.bounds.detach()
    center, multipliers = project_on_rows(sets.rows, bounds, target, sets.name, sets.given_rows)
    if not shrunk.bounds.requires_grad:
        return center
    flat = torch.eye(sets.dim, dtype=target.dtype, device=target.device).expand(len(target), -1, -1)
    return with_derivatives(shrunk, target, center, flat, multipliers)


def interior_points(sets: ScaledSets) -> Tensor:
    """Interior points (n, d) of sets with ellipses, continuous in these: the guess where it is deep, the point nearest
    to it of those `_DEEP` times as deep as the deepest where it is outside, and a mean of the two in between."""
    guess = guessed_points(sets)
    depth = sets.depth(guess)
    shallow = (depth < _SHALLOW).nonzero().squeeze(-1)
    if len(shallow) == 0:
        return guess
    part, start, depth = sets[shallow], guess[shallow], depth[shallow]
    inside = deepest_points(part)
    largest = part.depth(inside)
    wide = (largest > _THIN).nonzero().squeeze(-1)
    if len(wide) > 0:
        nearest = closest_points(part[wide].inner(_DEEP * largest[wide]), start[wide])[0]
        inside = inside.index_put((wide,), nearest)
    # The depth is concave, so that of a mean is at least the mean of the two, which is positive.
    deep = (0.5 * largest).clamp(max=_SHALLOW)
    share = (0.5 - 0.5 * depth / deep).clamp(0.0, 1.0).unsqueeze(-1)
    return guess.index_put((shallow,), torch.lerp(start, inside, share))
