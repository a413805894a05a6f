"""The deepest points of sets, the least excess over their constraints, and the widening of sets without interior."""

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
# Relative rounding of the least violation.
_SHARE = 1e-12
# The interior-point method's accuracy: far enough below NO_INTERIOR to tell a thin set from a flat one.
_ACCURACY = 1e-12


def deepest_on_rows(sets: ScaledSets, box: bool = True) -> tuple[Tensor, Tensor]:
    """The deepest point of each set with its depth as the last coordinate (n, d + 1), and multipliers (n, m).

    Ellipses are ignored. The depth is the distance to the nearest nonzero row, negative if no point satisfies all rows.
    Without `box`, the rows of the box bound the point but not its depth. The multipliers are the derivatives of the
    depth with respect to the bounds.
    """
    m, d = sets.given_rows, sets.dim
    solid = sets.solid
    if not box:
        solid = solid & sets.given
    # Scale the rows to unit norm again.
    shrink = torch.where(solid, 0.5, 1.0).to(sets.rows).sqrt()
    rows = torch.cat((sets.rows, solid.to(sets.rows).unsqueeze(-1)), -1) * shrink.unsqueeze(-1)
    slope = torch.zeros_like(rows[:, 0])
    slope[:, -1] = 1.0
    # At the start, the tightest row and the faces of the box opposite to it hold the depth.
    reach = sets.rows.abs().sum(-1)
    limit = torch.where(solid, (sets.bounds + reach) / (1.0 + reach), torch.inf)
    first = limit[:, : m + 1].argmin(-1, keepdim=True)
    towards = sets.rows.take_along_dim(first.unsqueeze(-1), 1).squeeze(1) >= 0.0
    basis = torch.cat((first, m + torch.arange(d, device=first.device) + d * towards), -1)
    solution, weight = maximize_on_rows(rows, sets.bounds * shrink, slope, basis, sets.name, m)
    return solution, weight * shrink * solid


def deepest_points(sets: ScaledSets) -> Tensor:
    """Points (n, d) of largest `depth` in sets with ellipses.

    Raises EmptySetError if a set is empty or has no interior, and ConstraintError if the interior-point method fails.
    """
    solution, converged = _deepest_in_cones(sets, box=True)
    point = solution[:, :-1]
    deep = sets.depth(point) > NO_INTERIOR
    require(deep | converged, "the interior-point method failed", sets.name)
    require(deep | (solution[:, -1] >= -NO_INTERIOR), "the set is empty", sets.name, EmptySetError)
    require(deep, "the set has no interior", sets.name, EmptySetError)
    return point


def _deepest_in_cones(sets: ScaledSets, box: bool) -> tuple[Tensor, Tensor]:
    """The deepest point of sets with ellipses and its depth (n, d + 1), and whether (n,) the method converged.

    Without `box`, the rows of the box bound the point but not its depth.
    """
    # Solve around the centre of the smallest ellipse, in units of its size.
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
    """The least excess (n,) over rows and ellipses of the points in the box, negative if some point is inside.

    Zero rows do not count. If nothing else is left, the result is -1.
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
    """The sets, with rows and ellipses (not the box) moved outwards by one common distance where a set is empty.

    `flat` widens sets without interior too. The distance is the least that gives a set an interior of depth `_ROOM`, so
    its points violate the constraint by no more than the least possible violation plus `_ROOM`. A zero row with b < 0
    is dropped, because no action satisfies it.
    """
    excess = least_excess(sets)
    growth = torch.where(excess > (-_ROOM if flat else NO_INTERIOR), excess * (1.0 + _SHARE) + _ROOM, 0.0)
    growth = growth.unsqueeze(-1)
    bounds = torch.where(sets.solid, sets.bounds, 1.0) + growth * sets.given
    factor = (1.0 + growth / sets.root).square()
    return replace(sets, bounds=bounds, matrix=sets.matrix / factor[..., None, None], root=sets.root + growth)
