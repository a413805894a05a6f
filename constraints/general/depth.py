"""The deepest points of sets, how far sets without an interior miss one, and sets that are widened by that."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from constraints.errors import EmptySetError, require
from constraints.general.interior_point import solve_cone_programs
from constraints.general.linear_programs import maximize_on_rows
from constraints.general.scaled_sets import NO_INTERIOR, ScaledSets
from constraints.numerics import times

# The depth of the interior that `widened` gives to sets without one; single precision can tell it from 0.
_ROOM = 5e-7
# The rounding of the least violation, where that is large.
_SHARE = 1e-12
# The interior-point method's accuracy: deep enough below NO_INTERIOR to tell a thin set from a flat one.
_ACCURACY = 1e-12


def deepest_on_rows(sets: ScaledSets, box: bool = True) -> tuple[Tensor, Tensor]:
    """The deepest point of each set and its depth, as the last coordinate (n, d + 1), and multipliers (n, m).

    Ellipses are left out. The depth is the distance to the nearest row that is not 0, negative where there is no point
    in all of them; without `box`, the box's rows do not bound the depth, but the point. The multipliers say how the
    depth changes with the bounds.
    """
    m, d = sets.given_rows, sets.dim
    solid = sets.solid
    if not box:
        solid = solid & sets.given
    # Rows of unit norm again.
    shrink = torch.where(solid, 0.5, 1.0).to(sets.rows).sqrt()
    rows = torch.cat((sets.rows, solid.to(sets.rows).unsqueeze(-1)), -1) * shrink.unsqueeze(-1)
    slope = torch.zeros_like(rows[:, 0])
    slope[:, -1] = 1.0
    # To begin with, the depth is held by one row, the tightest, and the faces of the box opposite to it.
    reach = sets.rows.abs().sum(-1)
    limit = torch.where(solid, (sets.bounds + reach) / (1.0 + reach), torch.inf)
    first = limit[:, : m + 1].argmin(-1, keepdim=True)
    towards = sets.rows.take_along_dim(first.unsqueeze(-1), 1).squeeze(1) >= 0.0
    basis = torch.cat((first, m + torch.arange(d, device=first.device) + d * towards), -1)
    solution, weight = maximize_on_rows(rows, sets.bounds * shrink, slope, basis, sets.name, m)
    return solution, weight * shrink * solid


def deepest_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) of the largest `depth`, of sets with ellipses; an EmptySetError where that is not positive."""
    solution, converged = _deepest_in_cones(sets, box=True)
    point = solution[:, :-1]
    deep = sets.depth(point) > NO_INTERIOR
    require(deep | converged, "the interior-point method failed", sets.name)
    require(deep | (solution[:, -1] >= -NO_INTERIOR), "the set is empty", sets.name, EmptySetError)
    require(deep, "the set has no interior", sets.name, EmptySetError)
    return point


def _deepest_in_cones(sets: ScaledSets, box: bool) -> tuple[Tensor, Tensor]:
    """The deepest point of sets with ellipses and its depth (n, d + 1), and whether (n,) the method converged.

    Without `box`, the box's rows do not bound the depth, but the point.
    """
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
    solid = sets.solid if box else sets.solid & sets.given
    rows = torch.cat((sets.rows, solid.to(sets.rows).unsqueeze(-1)), -1)
    bounds = size * (sets.bounds - times(sets.rows, origin))
    gradient = torch.zeros_like(rows[:, 0])
    gradient[:, -1] = 1.0
    start = gradient * (size * sets.depth(origin).unsqueeze(-1)).clamp(max=0.0) - gradient
    flat = torch.zeros_like(size)
    solution, _, converged = solve_cone_programs(flat, gradient, rows, bounds, matrix, offset, start, _ACCURACY)
    solution = solution / size
    return torch.cat((origin + solution[:, :-1], solution[:, -1:]), -1), converged


def least_excess(sets: ScaledSets) -> Tensor:
    """The least (n,) by which points of the box leave rows and ellipses, negative where they are inside.

    A row 0 <= b does not count. Where there is nothing else, it is -1.
    """
    sets = replace(sets, bounds=torch.where(sets.solid, sets.bounds, 1.0))
    bounded = (sets.solid & sets.given).any(-1) | (sets.matrix.shape[1] > 0)
    excess = torch.full_like(sets.bounds[:, 0], -1.0)
    index = bounded.nonzero().squeeze(-1)
    if len(index) > 0:
        part = sets[index]
        deepest = (_deepest_in_cones(part, False) if sets.curved else deepest_on_rows(part, False))[0]
        excess[index] = -deepest[:, -1]
    return excess


def widened(sets: ScaledSets, flat: bool) -> ScaledSets:
    """The sets with rows and ellipses, not the box, moved outwards by the same distance where they are empty.

    With `flat`, also where they have no interior. The distance is the least with which a set has an interior of the
    depth `_ROOM`: its points violate the constraint by no more than the least possible violation and `_ROOM`. A row
    0 <= b < 0 is left out, as no action meets it.
    """
    excess = least_excess(sets)
    growth = torch.where(excess > (-_ROOM if flat else NO_INTERIOR), excess * (1.0 + _SHARE) + _ROOM, 0.0)
    growth = growth.unsqueeze(-1)
    bounds = torch.where(sets.solid, sets.bounds, 1.0) + growth * sets.given
    factor = (1.0 + growth / sets.root).square()
    return replace(sets, bounds=bounds, matrix=sets.matrix / factor[..., None, None], root=sets.root + growth)
