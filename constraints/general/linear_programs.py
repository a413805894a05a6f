"""Linear programs on rows, in batch: the dual simplex method and, if it fails, projections of far points.

The simplex method keeps a basis of rows that hold the objective with multipliers >= 0, and exchanges one of them for
the most violated row. Its answer is checked. If it is wrong, for example for rows that are parallel up to rounding, the
second method takes over: the projection of x + R g is the point with the largest product with g once R is large enough
(Mangasarian and Meyer 1979, "Nonlinear perturbation of linear programs"). So every set with a projection has an answer.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import SampleName
from constraints.general.active_set import project_on_rows
from constraints.numerics import times

# Entries of the tableau below this are rounding: no row leaves the basis for them.
_PIVOT = 1e-9
# Violations and negative multipliers of the simplex method's answer up to this are rounding.
_ROUNDING = 1e-10
# Finished programs are removed from the batch once they exceed this share of it.
_LEAVING = 0.3
# The first R, the factor by which it grows, and the loss that ends its growth.
_FIRST, _GROWTH, _LOSS = 1e3, 30.0, 1e-11
_MAX_STEPS = 8


def maximize_on_rows(
    rows: Tensor, bounds: Tensor, slope: Tensor, basis: Tensor, name: SampleName, named: int
) -> tuple[Tensor, Tensor]:
    """argmax (n, k) of <slope, y> subject to rows (n, m, k) @ y <= bounds (n, m), and multipliers (n, m).

    `slope` (n, k) is of order 1. `basis` (n, k) are indices of k rows; `slope` must be a sum of these rows with weights
    >= 0. Rows, errors and the other arguments are as in `project_on_rows`.
    """
    solution, multipliers, solved = _dual_simplex(rows, bounds, slope, basis)
    left = (~solved).nonzero().squeeze(-1)
    if len(left) > 0:
        part = name.part(left.tolist())
        solution[left], multipliers[left] = _by_projection(rows[left], bounds[left], slope[left], part, named)
    return solution, multipliers


def _dual_simplex(rows: Tensor, bounds: Tensor, slope: Tensor, basis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As `maximize_on_rows`; also whether (n,) a sample is solved, up to rounding."""
    m, dim = rows.shape[1:]
    held = rows.take_along_dim(basis.unsqueeze(-1), 1)  # (n, position in the basis, k)
    # Every row as a combination of the rows in the basis, and its slack at the point where those meet.
    tableau = torch.linalg.solve_ex(held, rows, left=False)[0]
    weight = torch.linalg.solve_ex(held.mT, slope.unsqueeze(-1))[0].squeeze(-1)
    slack = bounds - times(tableau, bounds.gather(-1, basis))
    final, sample = basis.clone(), torch.arange(len(rows), device=rows.device)
    for _ in range(10 * (m + dim)):
        # Enter the most violated row in the tableau's metric: this takes half as many exchanges as the lowest slack.
        entering = (slack / (1.0 + tableau.square().sum(-1)).sqrt()).argmin(-1, keepdim=True)
        lowest = slack.gather(-1, entering)
        pivots = tableau.take_along_dim(entering.unsqueeze(-1), 1).squeeze(1)
        ratio, leaving = torch.where(pivots > _PIVOT, weight.clamp(min=0.0) / pivots, torch.inf).min(-1, keepdim=True)
        live = ((lowest < -1e-13) & ratio.isfinite()).squeeze(-1)
        count = int(live.sum())
        if count < (1.0 - _LEAVING) * len(live) or count == 0:
            final[sample] = basis
            if count == 0:
                break
            kept = live.nonzero().squeeze(-1)
            tableau, slack, weight, basis, sample = (each[kept] for each in (tableau, slack, weight, basis, sample))
            lowest, entering, pivots, ratio, leaving = (
                each[kept] for each in (lowest, entering, pivots, ratio, leaving)
            )
            live = live[kept]
        still = ~live.unsqueeze(-1)
        pivot = pivots.gather(-1, leaving).masked_fill(still, torch.inf)
        column = tableau.take_along_dim(leaving.unsqueeze(1), -1).squeeze(-1)
        slack = torch.addcmul(slack, column, lowest / pivot, value=-1.0)
        weight = (weight - ratio.masked_fill(still, 0.0) * pivots).scatter(
            -1, leaving, torch.where(still, weight.gather(-1, leaving), ratio)
        )
        change = pivots.scatter_add(-1, leaving, torch.full_like(pivot, -1.0)) / pivot
        tableau = torch.addcmul(tableau, column.unsqueeze(-1), change.unsqueeze(1), value=-1.0)
        basis = basis.scatter(-1, leaving, torch.where(still, basis.gather(-1, leaving), entering))
    # The tableau has accumulated rounding. Solve again from the basis itself.
    held = rows.take_along_dim(final.unsqueeze(-1), 1)
    solution = torch.linalg.solve_ex(held, bounds.gather(-1, final).unsqueeze(-1))[0].squeeze(-1)
    weight = torch.linalg.solve_ex(held.mT, slope.unsqueeze(-1))[0].squeeze(-1)
    feasible = (times(rows, solution) <= bounds + _ROUNDING).all(-1)
    multipliers = torch.zeros_like(bounds).scatter(-1, final, weight.clamp(min=0.0))
    return solution, multipliers, feasible & (weight >= -_ROUNDING).all(-1)


def _by_projection(rows: Tensor, bounds: Tensor, slope: Tensor, name: SampleName, named: int) -> tuple[Tensor, Tensor]:
    """As `maximize_on_rows`."""
    solution, multipliers = torch.zeros_like(slope), torch.zeros_like(bounds)
    left, size = torch.arange(len(slope), device=slope.device), _FIRST
    for _ in range(_MAX_STEPS):
        start = solution[left]
        ahead = start + size * slope[left]
        point, weight = project_on_rows(rows[left], bounds[left], ahead, name.part(left.tolist()), named)
        solution[left], multipliers[left] = point, weight / size
        # <slope, z - y> <= <y - start, z - y> / R for all points z of the set, which is not much larger than the box.
        loss = torch.linalg.vector_norm(point - start, dim=-1) * 2.0 * slope.shape[-1] ** 0.5 / size
        left = left[loss > _LOSS]
        if len(left) == 0:
            break
        size *= _GROWTH
    return solution, multipliers
