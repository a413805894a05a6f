"""Exact projection on polyhedra, in batch, by the dual active-set method of Goldfarb and Idnani (1983).

It starts at the point itself, adds the most violated row and drops rows whose multiplier would turn negative. It
therefore needs no interior, ends after finitely many steps, is exact to rounding, and can prove that a set is empty.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import ConstraintError, EmptySetError, SampleName
from constraints.general.scaled_sets import EMPTY
from constraints.numerics import times

# A row depends on the active ones if its part outside their span is shorter than this.
_DEPENDENT = 1e-9
# A multiplier that decreases more slowly than this along a step counts as constant.
_FALLS = 1e-12
# Finished samples are removed from the batch once they exceed this share of it: copying the others costs several steps.
_LEAVING = 0.3


def project_on_rows(
    rows: Tensor, bounds: Tensor, target: Tensor, name: SampleName, named: int
) -> tuple[Tensor, Tensor]:
    """Closest point (n, d) to target (n, d) with rows (n, m, d) @ a <= bounds (n, m), and its multipliers (n, m).

    Rows have unit norm or are 0. The rows with a positive multiplier are linearly independent. An EmptySetError names a
    sample whose set is empty, and a row in conflict if one of the first `named` rows is.
    """
    count, m, dim = rows.shape
    multipliers, solution = torch.zeros_like(bounds), target.clone()
    # State of the unfinished samples; active rows fill the slots from the left.
    sample = torch.arange(count, device=rows.device)
    point, limits = target.clone(), bounds.clone()
    normals = rows.new_zeros(count, dim, dim)  # (sample, slot, coordinate)
    # normals = triangle' @ basis, where the rows of the basis are orthonormal. Only the inverse of the upper triangle
    # is stored. Unused slots are 0.
    basis, inverse = torch.zeros_like(normals), torch.zeros_like(normals)
    index = torch.full((count, dim), -1, device=rows.device)
    weight = rows.new_zeros(count, dim)
    entering = torch.zeros_like(sample)
    entered = rows.new_zeros(count)
    pending = torch.zeros_like(sample, dtype=torch.bool)

    if count == 0:
        return solution, multipliers

    for _ in range(50 * (m + dim)):
        excess = times(rows, point) - limits
        entering = torch.where(pending, entering, excess.argmax(-1))
        over = excess.gather(-1, entering.unsqueeze(-1)).squeeze(-1)
        tolerance = 1e-12 + 1e-15 * point.abs().amax(-1)
        done = ~pending & (over <= tolerance)
        finished = int(done.sum())
        if finished == len(sample) or finished > _LEAVING * len(sample):
            spots = torch.where(index[done] >= 0, index[done], 0)
            solution[sample[done]] = point[done]
            multipliers[sample[done]] = torch.zeros_like(limits[done]).scatter_add(-1, spots, weight[done])
            if finished == len(sample):
                return solution, multipliers
            live = (~done).nonzero().squeeze(-1)
            rows, limits, sample, point = rows[live], limits[live], sample[live], point[live]
            normals, basis, inverse = normals[live], basis[live], inverse[live]
            index, weight, entering, entered = index[live], weight[live], entering[live], entered[live]
            pending, tolerance, over, done = pending[live], tolerance[live], over[live], done[live]

        normal = rows.take_along_dim(entering[:, None, None], 1).squeeze(1)
        used = index >= 0
        slot = used.sum(-1)
        # Remove the part in the span twice: after one pass, a short remainder would be mostly rounding.
        along = times(basis, normal)
        step = normal - times(basis.mT, along)
        again = times(basis, step)
        along, step = along + again, step - times(basis.mT, again)
        within = times(inverse, along)
        length = step.square().sum(-1)
        dependent = (length <= _DEPENDENT**2) | (slot == dim)

        ratio = torch.where(used & (within > _FALLS), weight / within, torch.inf)
        until_drop, leaving = ratio.min(-1)
        until_met = torch.where(dependent, torch.inf, over.clamp(min=0.0) / length)
        stuck = until_drop.isinf() & until_met.isinf() & ~done
        if bool(stuck.any()):
            conflicting = (stuck & (over > EMPTY)).nonzero().squeeze(-1)
            if len(conflicting) > 0:
                first = int(conflicting[0])
                # Name the row that cannot be satisfied or one in conflict with it, but no row of the box.
                conflict = [row for row in [int(entering[first]), *index[first].tolist()] if 0 <= row < named]
                which, spot = f", row {conflict[0]}" if conflict else "", int(sample[first])
                raise EmptySetError(f"{name(spot)}{which}: the set is empty", name.position(spot))
            # The active rows satisfy a dependent row up to rounding: raise its limit.
            limits[stuck.nonzero().squeeze(-1), entering[stuck]] += over[stuck].clamp(min=0.0) + tolerance[stuck]

        idle = stuck | done
        size = torch.where(idle, 0.0, torch.minimum(until_drop, until_met)).unsqueeze(-1)
        point = torch.where(dependent.unsqueeze(-1), point, point - size * step)
        weight = torch.where(used, weight - size * within, 0.0).clamp(min=0.0)
        entered = torch.where(pending, entered, 0.0) + size.squeeze(-1)
        add = ~idle & (until_met <= until_drop)
        drop = ~idle & ~add
        pending = drop

        where = add.nonzero().squeeze(-1)
        if len(where) > 0:
            at, norm = slot[where], length[where].sqrt().unsqueeze(-1)
            normals[where, at] = normal[where]
            index[where, at] = entering[where]
            weight[where, at] = entered[where]
            basis[where, at] = step[where] / norm
            column = -within[where] / norm
            inverse[where, :, at] = column.scatter(-1, at.unsqueeze(-1), 1.0 / norm)
        where = drop.nonzero().squeeze(-1)
        if len(where) > 0:
            # A row rejected as dependent loses the multiplier that it gained, which is rounding.
            index[where, leaving[where]] = -1
            order = (index[where] < 0).long().argsort(stable=True, dim=-1)
            index[where], weight[where] = index[where].gather(-1, order), weight[where].gather(-1, order)
            kept = normals[where].take_along_dim(order.unsqueeze(-1), 1) * (index[where] >= 0).unsqueeze(-1)
            normals[where] = kept
            basis[where], inverse[where] = _factors(kept, index[where] >= 0)
        # Long steps leave the active rows by their rounding. Return to them.
        offset = limits.gather(-1, index.clamp(min=0)) - times(normals, point)
        offset = torch.where((index >= 0) & ~(pending | done).unsqueeze(-1), offset, 0.0)
        point = point + times(basis.mT, times(inverse.mT, offset))
    spot = int(sample[0])
    raise ConstraintError(
        f"{name(spot)}: no active set found; rows may be parallel up to rounding", name.position(spot)
    )


def _factors(normals: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """Basis (n, d, d) of the normals (n, d, d) in the slots `used` (n, d), and the triangle's inverse (n, d, d)."""
    columns, triangle = torch.linalg.qr(normals.mT)
    identity = torch.eye(normals.shape[-1], dtype=normals.dtype, device=normals.device)
    triangle = torch.where(used.unsqueeze(-1) & used.unsqueeze(-2), triangle, identity)
    inverse = torch.linalg.solve_triangular(triangle, identity.expand_as(triangle), upper=True)
    return columns.mT * used.unsqueeze(-1), inverse * used.unsqueeze(-1) * used.unsqueeze(-2)
