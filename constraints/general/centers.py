"""Interior points of sets of rows, and of sets with ellipses."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import EmptySetError, require
from constraints.general.active_set import project_on_rows
from constraints.general.interior_point import solve_cone_programs
from constraints.general.linear_programs import maximize_on_rows
from constraints.general.scaled_sets import NO_INTERIOR, ScaledSets
from constraints.numerics import times

# The share of the largest radius that a centre keeps. A larger one leaves less room in which it moves continuously.
_DEEP = 0.9
_TRACE = 1e-11
# A guess less deep than this, or than half of the largest depth, gives way to the deepest point.
_SHALLOW = 1e-2
# The interior-point method's accuracy: deep enough below NO_INTERIOR to tell a thin set from a flat one.
_ACCURACY = 1e-12


def deep_points(sets: ScaledSets) -> Tensor:
    """Centres (n, d) of sets without ellipses: the point nearest to the origin of those that are `_DEEP` times as deep
    as the deepest. A ConstraintError where a set is empty or flat.

    It is continuous in rows and bounds. The largest depth is: it is the maximum over the box of a continuous function.
    The points of that share of it are a convex set with interior, so they move continuously, and so does the one of
    them that is nearest to the origin. The deepest points themselves may jump: those of a wedge are at its wide end,
    however small its angle.
    """
    radius = largest_radius(sets)
    require(radius >= -NO_INTERIOR, "the set is empty", sets.name, EmptySetError)
    require(radius > NO_INTERIOR, "the set has no interior", sets.name)
    bounds = sets.bounds - _DEEP * radius.unsqueeze(-1) * sets.solid
    return project_on_rows(sets.rows, bounds, torch.zeros_like(sets.rows[:, 0]), sets.name, sets.given_rows)[0]


def largest_radius(sets: ScaledSets) -> Tensor:
    """Radius (n,) of the largest ball in each set, the ellipses left out; negative where it is empty."""
    m, d = sets.given_rows, sets.dim
    # The last coordinate is the radius; rows have unit norm again. Zero rows do not bound it.
    shrink = torch.where(sets.solid, 0.5, 1.0).to(sets.rows).sqrt()
    rows = torch.cat((sets.rows, sets.solid.to(sets.rows).unsqueeze(-1)), -1) * shrink.unsqueeze(-1)
    # To begin with, two opposite faces of the box hold the radius. The others get a trace of it, so that the simplex
    # method does not exchange rows without effect.
    slope = torch.full_like(rows[:, 0], _TRACE)
    slope[:, 0], slope[:, -1] = 0.0, 1.0
    basis = m + torch.cat((torch.arange(d, device=rows.device), torch.tensor([d], device=rows.device)))
    basis = basis.expand(len(rows), -1)
    return maximize_on_rows(rows, sets.bounds * shrink, slope, basis, sets.name, sets.given_rows)[0][:, -1]


def interior_points(sets: ScaledSets) -> Tensor:
    """Interior points (n, d) of sets with ellipses: the guess where it is deep, the deepest point where it is outside.

    In between it is a mean of the two, so that the centre does not jump where the guess leaves the set.
    """
    point = guessed_points(sets)
    depth = sets.depth(point)
    shallow = (depth < _SHALLOW).nonzero().squeeze(-1)
    if len(shallow) > 0:
        part, depth = sets[shallow], depth[shallow]
        deepest = deepest_points(part)
        deep = (0.5 * part.depth(deepest)).clamp(max=_SHALLOW)
        # The depth is concave, so that of a mean is at least the mean of the two, which is positive.
        share = (0.5 - 0.5 * depth / deep).clamp(0.0, 1.0).unsqueeze(-1)
        point = point.index_put((shallow,), torch.lerp(point[shallow], deepest, share))
    return point


def guessed_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) that are often interior: the centre of a single ellipse without rows, the origin otherwise."""
    alone = sets.matrix.shape[1] == 1 and sets.given_rows == 0
    return sets.center[:, 0] if alone else torch.zeros_like(sets.center[:, 0])


def deepest_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) of the largest `depth`, of sets with ellipses; a ConstraintError where that is not positive."""
    # Around the centre of the smallest ellipse, in its size.
    traces = sets.matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    size = sets.inverse_size()
    smallest = traces.argmax(-1)[:, None, None]
    origin = sets.center.take_along_dim(smallest, 1).squeeze(1).clamp(-1.0, 1.0)
    matrix, offset = sets.as_cones(origin, size)
    # The last coordinate is the depth; a zero matrix does not bound it.
    sink = torch.zeros_like(offset)
    sink[..., 0] = 1.0 / (size * sets.root)
    matrix = torch.cat((matrix, sink.unsqueeze(-1)), -1)
    rows = torch.cat((sets.rows, sets.solid.to(sets.rows).unsqueeze(-1)), -1)
    bounds = size * (sets.bounds - times(sets.rows, origin))
    gradient = torch.zeros_like(rows[:, 0])
    gradient[:, -1] = 1.0
    start = gradient * (size * sets.depth(origin).unsqueeze(-1)).clamp(max=0.0) - gradient
    flat = torch.zeros_like(size)
    solution, _, converged = solve_cone_programs(flat, gradient, rows, bounds, matrix, offset, start, _ACCURACY)
    solution = solution / size
    point = origin + solution[:, :-1]
    deep = sets.depth(point) > NO_INTERIOR
    require(deep | converged, "the interior-point method failed", sets.name)
    require(deep | (solution[:, -1] >= -NO_INTERIOR), "the set is empty", sets.name, EmptySetError)
    require(deep, "the set has no interior", sets.name)
    return point
