"""Convex programs with rows and ellipses, in batch, by a primal-dual interior-point method.

Mehrotra's predictor-corrector steps on the perturbed KKT conditions (Nocedal and Wright 2006, Sec. 19.3), with the
curvature of the quadratic constraints in the Newton matrix.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import SampleName, require

_MAX_STEPS = 100
_GAP = 1e-14
_RESIDUAL = 1e-11
# What a sample that stalls short of the above, at the limits of its conditioning, must at least have reached.
_ACCEPTED = 1e-8


def minimize(
    curvature: Tensor,
    gradient: Tensor,
    rows: Tensor,
    bounds: Tensor,
    quadratics: tuple[Tensor, Tensor, Tensor],
    start: Tensor,
    name: SampleName,
) -> tuple[Tensor, Tensor]:
    """argmin y (n, d) of curvature |y|^2 / 2 - <gradient, y> subject to rows (n, m, d) @ y <= bounds (n, m) and
    y'P_k y + q_k.y + r_k <= 0, with quadratics P (n, k, d, d), q (n, k, d), r (n, k).

    curvature is (n, 1), gradient and the strictly feasible start are (n, d). The objective and constraints
    should be of order 1. Also returns the multipliers of the quadratics (n, k). Raises a ConstraintError, naming the
    sample by `name`, where the method fails.
    """
    matrix, linear, constant = quadratics
    identity = curvature.unsqueeze(-1) * torch.eye(rows.shape[-1], dtype=rows.dtype)
    m = rows.shape[1]

    def evaluate(point: Tensor) -> tuple[Tensor, Tensor]:
        """Constraint values (n, m + k) and their gradients (n, m + k, d)."""
        bent = _times(matrix, point.unsqueeze(1))
        value = ((bent + linear) * point.unsqueeze(1)).sum(-1) + constant
        return torch.cat((_times(rows, point) - bounds, value), -1), torch.cat((rows, 2.0 * bent + linear), 1)

    point = start
    value, jacobian = evaluate(point)
    slack = (-value).clamp(min=1e-2)
    dual = torch.ones_like(slack)
    best, best_dual, least = point, dual, torch.full_like(point[:, 0], torch.inf)
    for _ in range(_MAX_STEPS):
        stationary = curvature * point - gradient + _times(jacobian.mT, dual)
        primal = value + slack
        gap = (slack * dual).mean(-1)
        residual = torch.maximum(stationary.abs().amax(-1), primal.abs().amax(-1))
        error = torch.maximum(gap / _GAP, residual / _RESIDUAL)
        better = error < least
        best = torch.where(better.unsqueeze(-1), point, best)
        best_dual = torch.where(better.unsqueeze(-1), dual, best_dual)
        least = torch.where(better, error, least)
        # Beyond the gap that was asked for a sample only gathers rounding.
        if bool(((error <= 1.0) | ~error.isfinite()).all()):
            break

        ratio = dual / slack
        hessian = identity + 2.0 * (dual[:, m:, None, None] * matrix).sum(1)
        newton = hessian + jacobian.mT @ (ratio.unsqueeze(-1) * jacobian)
        scale = newton.diagonal(dim1=-2, dim2=-1).rsqrt()
        factor = torch.linalg.lu_factor_ex(newton * scale.unsqueeze(-1) * scale.unsqueeze(-2))[:2]
        state = factor, scale, stationary, jacobian, slack, dual

        move, slack_move, dual_move = _direction(slack * dual, primal, *state)
        length = _longest(slack, slack_move, dual, dual_move, 1.0)
        predicted = ((slack + length * slack_move) * (dual + length * dual_move)).mean(-1)
        centering = ((predicted / gap).clamp(0.0, 1.0) ** 3 * gap).clamp(min=0.1 * _GAP).unsqueeze(-1)
        # The second-order part of the quadratics along the step, like that of the complementarity.
        bend = (_times(matrix, move.unsqueeze(1)) * move.unsqueeze(1)).sum(-1) * length.square()
        primal = torch.cat((primal[:, :m], primal[:, m:] + bend), -1)
        move, slack_move, dual_move = _direction(slack * dual + slack_move * dual_move - centering, primal, *state)
        length = _longest(slack, slack_move, dual, dual_move, 0.99)

        length = torch.where((error > 1.0).unsqueeze(-1), length, 0.0)
        point, slack, dual = point + length * move, slack + length * slack_move, dual + length * dual_move
        value, jacobian = evaluate(point)
    require(least * _RESIDUAL <= _ACCEPTED, "the interior-point method failed; the set is too thin", name)
    return best, best_dual[:, m:]


def _direction(
    complementarity: Tensor,
    primal: Tensor,
    factor: tuple[Tensor, Tensor],
    scale: Tensor,
    stationary: Tensor,
    jacobian: Tensor,
    slack: Tensor,
    dual: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton step of the point, the slacks and the multipliers that removes the residuals and `complementarity`."""
    right = -stationary - _times(jacobian.mT, (dual * primal - complementarity) / slack)
    move = torch.linalg.lu_solve(*factor, (right * scale).unsqueeze(-1)).squeeze(-1) * scale
    slack_move = -primal - _times(jacobian, move)
    return move, slack_move, -(complementarity + dual * slack_move) / slack


def _longest(slack: Tensor, slack_move: Tensor, dual: Tensor, dual_move: Tensor, share: float) -> Tensor:
    """Step length (n, 1) up to 1 that keeps slacks and multipliers positive."""
    shrink = torch.maximum(-slack_move / slack, -dual_move / dual).amax(-1, keepdim=True)
    return share / shrink.clamp(min=share)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
