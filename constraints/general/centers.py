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

# A centre is at least this share as deep as the deepest point. With a larger share, the centre moves faster when
# the set changes.
_DEEP = 0.9
# A guess less deep than this, and less deep than half of the largest depth, gives way to a point that is nearly the
# deepest.
_SHALLOW = 1e-2
# In a set that is nowhere deeper than this, the deepest point is taken: too little room is left beside it.
_THIN = 1e-6


def deep_points(traced: ScaledSets) -> Tensor:
    """Centres (n, d) of sets without ellipses, differentiable if the sets are. EmptySetError if a set is empty or flat.

    The centre is the point nearest to the origin among those at least `_DEEP` times as deep as the deepest. It is
    continuous in rows and bounds. The largest depth is continuous, because it is the maximum over the box of a
    continuous function. The points of at least that share of it form a convex set with interior, so this set moves
    continuously, and so does its point nearest to the origin. The deepest points themselves may jump: in a wedge they
    lie at its wide end, however small its angle.
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
    """Interior points (n, d) of sets with ellipses, continuous in the sets.

    The point is the guess if that is deep inside. If the guess is far outside, the point is the nearest one among those
    at least `_DEEP` times as deep as the deepest. In between it is a weighted mean of the two.
    """
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
    # The depth is concave: a mean of two points is at least as deep as the mean of their depths, which is positive.
    deep = (0.5 * largest).clamp(max=_SHALLOW)
    share = (0.5 - 0.5 * depth / deep).clamp(0.0, 1.0).unsqueeze(-1)
    return guess.index_put((shallow,), torch.lerp(start, inside, share))
