"""Interior points: Chebyshev centres of rows, deepest points of sets with ellipses."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import require
from constraints.general.interior_point import solve_cone_programs
from constraints.general.linear_programs import solve_linear_programs
from constraints.general.scaled_sets import NO_INTERIOR, ScaledSets
from constraints.numerics import times

# A guess nearer to the boundary than this gives way to the deepest point.
_NEAR_BOUNDARY = 1e-6
# The interior-point method's accuracy: deep enough below NO_INTERIOR to tell a thin set from a flat one.
_ACCURACY = 1e-12


def chebyshev_centers(sets: ScaledSets) -> Tensor:
    """Chebyshev centres (n, d) of sets without ellipses; a ConstraintError where a set is empty or flat."""
    solid = sets.rows.abs().amax(-1, keepdim=True) > 0.0
    rows = torch.cat((sets.rows, solid.to(sets.rows.dtype)), -1)
    objective = torch.zeros(len(rows), sets.dim + 1, dtype=rows.dtype)
    objective[:, -1] = 1.0
    solution = solve_linear_programs(objective, rows, sets.bounds)
    radius = solution[:, -1]
    require(radius >= -NO_INTERIOR, "the set is empty", sets.name)
    require(radius > NO_INTERIOR, "the set has no interior", sets.name)
    return solution[:, :-1]


def interior_points(sets: ScaledSets) -> Tensor:
    """Interior points (n, d) of sets with ellipses: the guess or, where that is not interior, the deepest point."""
    candidate = guessed_points(sets)
    shallow = (sets.depth(candidate) <= _NEAR_BOUNDARY).nonzero().squeeze(-1)
    if len(shallow) == 0:
        return candidate
    candidate = candidate.clone()
    candidate[shallow] = deepest_points(sets[shallow])
    return candidate


def guessed_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) that are often interior: the centre of a single ellipse without rows, the origin otherwise."""
    alone = sets.matrix.shape[1] == 1 and sets.given_rows == 0
    return sets.center[:, 0] if alone else torch.zeros_like(sets.center[:, 0])


def deepest_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) of the largest `depth`, of sets with ellipses; a ConstraintError where that is not positive."""
    solid = sets.rows.abs().amax(-1, keepdim=True) > 0.0
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
    rows = torch.cat((sets.rows, solid.to(sets.rows.dtype)), -1)
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
    require(deep | (solution[:, -1] >= -NO_INTERIOR), "the set is empty", sets.name)
    require(deep, "the set has no interior", sets.name)
    return point
