"""Exact projection on polyhedra, in batch, by the dual active-set method of Goldfarb and Idnani (1983).

It starts at the point itself, adds the most violated row and drops rows whose multiplier would turn negative. So it
needs no interior, ends after finitely many steps, is exact to rounding, and proves a set empty.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import ConstraintError, SampleName
from constraints.general.scaled_sets import EMPTY
from constraints.numerics import times

# A row depends on the active ones where its part outside their span is shorter than this.
_DEPENDENT = 1e-9
# A multiplier that falls more slowly than this along a step does not fall.
_FALLS = 1e-12


def project_on_rows(
    rows: Tensor, bounds: Tensor, target: Tensor, name: SampleName, named: int
) -> tuple[Tensor, Tensor]:
    """Closest point (n, d) to target (n, d) with rows (n, m, d) @ a <= bounds (n, m), and its multipliers (n, m).

    Rows have unit norm or are 0. The rows with a positive multiplier are linearly independent. A ConstraintError names
    a sample whose set is empty, and the row that shows it if that is one of the first `named` ones.
    """
    count, m, dim = rows.shape
    multipliers = torch.zeros(count, m, dtype=rows.dtype)
    solution = target.clone()
    # State of the unfinished samples; active rows fill the slots from the left.
    sample = torch.arange(count)
    point, limits = target.clone(), bounds.clone()
    normals = torch.zeros(count, dim, dim, dtype=rows.dtype)  # (sample, slot, coordinate)
    index = torch.full((count, dim), -1)
    weight = torch.zeros(count, dim, dtype=rows.dtype)
    entering = torch.zeros(count, dtype=torch.long)
    entered = torch.zeros(count, dtype=rows.dtype)
    pending = torch.zeros(count, dtype=torch.bool)
    tolerance = 1e-12 + 1e-15 * target.abs().amax(-1)

    if count == 0:
        return solution, multipliers

    for _ in range(50 * (m + dim)):
        excess = times(rows, point) - limits
        entering = torch.where(pending, entering, excess.argmax(-1))
        over = excess.gather(-1, entering.unsqueeze(-1)).squeeze(-1)
        done = ~pending & (over <= tolerance)
        if bool(done.any()):
            solution[sample[done]] = point[done]
            spots = torch.where(index[done] >= 0, index[done], 0)
            found = torch.zeros(len(spots), m, dtype=rows.dtype).scatter_add(-1, spots, weight[done])
            multipliers[sample[done]] = found
            live = ~done
            if not bool(live.any()):
                return solution, multipliers
            sample, point, limits, normals = sample[live], point[live], limits[live], normals[live]
            index, weight, entering, entered = index[live], weight[live], entering[live], entered[live]
            pending, tolerance, rows, over = pending[live], tolerance[live], rows[live], over[live]

        normal = rows.take_along_dim(entering[:, None, None], 1).squeeze(1)
        used = index >= 0
        basis, triangle = torch.linalg.qr(normals.mT)
        basis = basis * used.unsqueeze(1)
        triangle = torch.where(used.unsqueeze(-1), triangle, torch.eye(dim, dtype=rows.dtype))
        within = times(basis.mT, normal)
        step = normal - times(basis, within)
        within = torch.linalg.solve_triangular(triangle, within.unsqueeze(-1), upper=True).squeeze(-1)
        length = step.square().sum(-1)
        dependent = (length <= _DEPENDENT**2) | (used.sum(-1) == dim)

        ratio = torch.where(used & (within > _FALLS), weight / within, torch.inf)
        until_drop, leaving = ratio.min(-1)
        until_met = torch.where(dependent, torch.inf, over.clamp(min=0.0) / length)
        stuck = until_drop.isinf() & until_met.isinf()
        if bool((stuck & (over > EMPTY)).any()):
            first = int((stuck & (over > EMPTY)).nonzero()[0])
            # The row that cannot be met, or one that is in its way; not a row of the box.
            conflict = [row for row in [int(entering[first]), *index[first].tolist()] if 0 <= row < named]
            which = f", row {conflict[0]}" if conflict else ""
            empty = int(sample[first])
            raise ConstraintError(f"{name(empty)}{which}: the set is empty", name.position(empty))
        # The active rows meet a dependent row up to rounding: raise its limit.
        limits[stuck.nonzero().squeeze(-1), entering[stuck]] += over[stuck].clamp(min=0.0) + tolerance[stuck]

        size = torch.where(stuck, 0.0, torch.minimum(until_drop, until_met)).unsqueeze(-1)
        point = torch.where(dependent.unsqueeze(-1), point, point - size * step)
        weight = torch.where(used, weight - size * within, 0.0).clamp(min=0.0)
        entered = torch.where(pending, entered, 0.0) + size.squeeze(-1)
        add = ~stuck & (until_met <= until_drop)
        drop = ~stuck & ~add
        pending = drop

        slot = used.sum(-1)
        where = add.nonzero().squeeze(-1)
        normals[where, slot[where]] = normal[where]
        index[where, slot[where]] = entering[where]
        weight[where, slot[where]] = entered[where]
        # A row rejected as dependent loses the multiplier that it gained, which is rounding.
        index[drop.nonzero().squeeze(-1), leaving[drop]] = -1
        order = (index < 0).long().argsort(stable=True, dim=-1)
        index, weight = index.gather(-1, order), weight.gather(-1, order)
        normals = normals.take_along_dim(order.unsqueeze(-1), 1) * (index >= 0).unsqueeze(-1)
        # Steps from far away leave the active rows by their rounding. Return to them.
        offset = limits.gather(-1, index.clamp(min=0)) - times(normals, point)
        offset = torch.where(index >= 0, offset, 0.0).unsqueeze(-1)
        gram = normals @ normals.mT + torch.diag_embed((index < 0).to(rows.dtype))
        back = normals.mT @ torch.linalg.solve_ex(gram, offset)[0]
        point = point + torch.where(pending.unsqueeze(-1), 0.0, back.squeeze(-1).nan_to_num())
    first = int(sample[0])
    message = f"{name(first)}: no active set found; rows may be parallel up to rounding"
    raise ConstraintError(message, name.position(first))
