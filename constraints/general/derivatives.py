"""Derivatives of projections on sets of rows and ellipses, by implicit differentiation of their KKT conditions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from constraints.general.scaled_sets import ScaledSets
from constraints.numerics import one_where_zero, refuse_second_derivatives, times

# Constraints with less slack than this are active in the Jacobian.
_ACTIVE = 1e-9
# A unit normal depends on others if its part outside their span is shorter than this.
_IN_SPAN = 1e-6
# Singular values of unit normals, and residuals of sums of them, below this are 0 up to rounding.
_RANK = 1e-7


def projection_jacobian(sets: ScaledSets, solution: Tensor, hessian: Tensor, multipliers: Tensor) -> Tensor:
    """Jacobian (n, d, d) of the projection with respect to the target: the inverse Hessian on the free subspace.

    The free subspace is orthogonal to the normals of the active constraints. An active constraint with multiplier 0 is
    a kink and does not count, with one exception: if such constraints block each other within the subspace that the
    others leave, as at the apex of a pyramid, they all count.
    """
    return _on_free_space(_free_space(sets, solution, multipliers)[0], hessian)


def with_derivatives(
    traced: ScaledSets, target: Tensor, solution: Tensor, hessian: Tensor, multipliers: Tensor
) -> Tensor:
    """The projection `solution` (n, d) of the target (n, d), differentiable in the target and in the sets.

    The solution a satisfies target - a - sum lam_j grad g_j(a) = 0 and, for the constraints that hold it, g_j(a) = 0.
    With a and lam held fixed, changes of the target and the sets change the first by du and the slacks -g_j(a) by dw.
    Then da = F du + (1 - F H) N+ dw, with the Jacobian F, the Hessian H and the pseudo-inverse N+ of the normals.
    """
    sets = traced.detach()
    with torch.no_grad():
        free, holding = _free_space(sets, solution, multipliers)
        jacobian = _on_free_space(free, hessian)
        normals = sets.slack(solution)[1]
        length = one_where_zero(normals.norm(dim=-1))
        units = (normals / length.unsqueeze(-1)) * holding.unsqueeze(-1)
        inverse = torch.linalg.pinv(units, rtol=_RANK) / length.unsqueeze(1)
        by_slack = inverse - jacobian @ (hessian @ inverse)
    slack, gradients = traced.slack(solution)
    force = target - times(gradients.mT, multipliers)
    return _Solved.apply(force, slack, solution, jacobian, by_slack)


class _Solved(torch.autograd.Function):
    """The solution (n, d) as a function of force (n, d) and slack (n, m) with these Jacobians."""

    @staticmethod
    def forward(ctx, force: Tensor, slack: Tensor, solution: Tensor, by_force: Tensor, by_slack: Tensor) -> Tensor:
        ctx.save_for_backward(by_force, by_slack)
        return solution.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        by_force, by_slack = ctx.saved_tensors
        return times(by_force.mT, grad), times(by_slack.mT, grad), None, None, None


def _on_free_space(free: Tensor, hessian: Tensor) -> Tensor:
    """The inverse (n, d, d) of the Hessian (n, d, d) on the space that `free` (n, d, d) projects on."""
    identity = torch.eye(free.shape[-1], dtype=free.dtype, device=free.device)
    return free @ torch.linalg.solve(free @ hessian @ free + identity - free, free)


def _free_space(sets: ScaledSets, solution: Tensor, multipliers: Tensor) -> tuple[Tensor, Tensor]:
    """Projector (n, d, d) on the space in which the solution moves, and which constraints (n, m + k) hold it."""
    value, gradient = sets.ellipse_values(solution)
    length = one_where_zero(gradient.norm(dim=-1))
    normals = torch.cat((sets.rows, gradient / length.unsqueeze(-1)), 1)
    slack = torch.cat((sets.bounds - times(sets.rows, solution), (1.0 - value) / length), 1)
    holding = multipliers > 0.0
    free = _null_projector(normals, holding)
    other = (slack <= _ACTIVE) & ~holding
    residual = (normals @ free) * other.unsqueeze(-1)
    residual = torch.where(residual.norm(dim=-1, keepdim=True) > _IN_SPAN, residual, 0.0)
    degenerate = ((residual != 0.0).any(-1).sum(-1) > 1).nonzero().squeeze(-1)
    if len(degenerate) > 0:
        for i in degenerate.tolist():
            holding[i] |= _blocked(residual[i])
        free[degenerate] = _null_projector(normals[degenerate], holding[degenerate])
    return free, holding


def _null_projector(normals: Tensor, holding: Tensor) -> Tensor:
    """Projector (n, d, d) on the space orthogonal to the rows of normals (n, m, d) where holding (n, m)."""
    count = int(holding.sum(-1).max()) if holding.numel() > 0 else 0
    first = holding.long().argsort(dim=-1, descending=True, stable=True)[:, :count]
    held = normals.take_along_dim(first.unsqueeze(-1), 1) * holding.gather(-1, first).unsqueeze(-1)
    _, size, axes = torch.linalg.svd(held, full_matrices=False)
    axes = axes * (size > _RANK).unsqueeze(-1)
    return torch.eye(normals.shape[-1], dtype=normals.dtype, device=normals.device) - axes.mT @ axes


def _blocked(normals: Tensor) -> Tensor:
    """Which (m,) of the normals (m, d) are orthogonal to every v with normals @ v <= 0.

    These are the normals whose negative is a sum of the others with weights >= 0.
    """
    from scipy.optimize import nnls

    blocked = normals.new_zeros(len(normals), dtype=torch.bool)
    present = (normals != 0.0).any(-1).nonzero().squeeze(-1)
    cone = normals[present].T.numpy()
    for i in present.tolist():
        wanted = -normals[i].numpy()
        blocked[i] = bool(nnls(cone, wanted)[1] <= _RANK * np.linalg.norm(wanted))
    return blocked
