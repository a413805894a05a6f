"""Convex programs with rows and ellipses, in batch, by a feasible primal-dual interior-point method.

Mehrotra's predictor-corrector steps on the perturbed KKT conditions (Nocedal and Wright 2006, Sec. 19.3), with the
curvature of the quadratics in the Newton matrix. Every point is strictly feasible: the way to the boundary along a
step is known exactly, for quadratics too.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import SampleName, require

_MAX_STEPS = 100
_GAP = 1e-14
_RESIDUAL = 1e-11
# What a sample that stalls short of the above, at the limits of its conditioning, must at least have reached.
_ACCEPTED_GAP = 1e-10


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

    curvature is (n, 1), gradient and the strictly feasible start are (n, d). The objective and constraints should be of
    order 1. Also returns the multipliers of the quadratics (n, k). Raises a ConstraintError, naming the sample by
    `name`, where the method fails.
    """
    matrix, linear, constant = quadratics
    identity = curvature.unsqueeze(-1) * torch.eye(rows.shape[-1], dtype=rows.dtype)
    m = rows.shape[1]

    def evaluate(point: Tensor) -> tuple[Tensor, Tensor]:
        """Slacks (n, m + k) and the constraints' gradients (n, m + k, d)."""
        bent = _times(matrix, point.unsqueeze(1))
        value = ((bent + linear) * point.unsqueeze(1)).sum(-1) + constant
        return torch.cat((bounds - _times(rows, point), -value), -1), torch.cat((rows, 2.0 * bent + linear), 1)

    point = start
    slack, jacobian = evaluate(point)
    dual = 1.0 / slack.clamp(min=1.0)
    best, best_dual, least = point, dual, torch.full_like(point[:, 0], torch.inf)
    for _ in range(_MAX_STEPS):
        stationary = curvature * point - gradient + _times(jacobian.mT, dual)
        gap, residual = (slack * dual).mean(-1), stationary.abs().amax(-1)
        error = torch.maximum(gap / _GAP, residual / _RESIDUAL)
        better = error < least
        best = torch.where(better.unsqueeze(-1), point, best)
        best_dual = torch.where(better.unsqueeze(-1), dual, best_dual)
        least = torch.where(better, error, least)
        # What is not finite any more has reached the limit of its conditioning.
        if bool(((error <= 1.0) | ~error.isfinite()).all()):
            break

        hessian = identity + 2.0 * (dual[:, m:, None, None] * matrix).sum(1)
        newton = hessian + jacobian.mT @ ((dual / slack).unsqueeze(-1) * jacobian)
        scale = newton.diagonal(dim1=-2, dim2=-1).rsqrt()
        factor = torch.linalg.lu_factor_ex(newton * scale.unsqueeze(-1) * scale.unsqueeze(-2))[:2]
        state = factor, scale, stationary, jacobian, slack, dual

        move, dual_move = _direction(slack * dual, torch.zeros_like(slack), *state)
        slope, bend = _along(rows, matrix, jacobian, move)
        length = _longest(slack, slope, bend, dual, dual_move, 1.0)
        predicted = ((slack - length * (slope + length * bend)) * (dual + length * dual_move)).mean(-1)
        # A gap far below the residual would leave slacks too small to ever let the residual go.
        floor = torch.minimum(gap, 0.1 * residual).clamp(min=0.1 * _GAP)
        centering = torch.maximum((predicted / gap).clamp(0.0, 1.0) ** 3 * gap, floor).unsqueeze(-1)
        # Second-order terms of complementarity and of the quadratics along the predicted step.
        bend = bend * length.square()
        move, dual_move = _direction(slack * dual - (slope + bend) * dual_move * length - centering, bend, *state)
        slope, bend = _along(rows, matrix, jacobian, move)
        length = _longest(slack, slope, bend, dual, dual_move, 0.99)

        length = torch.where((error > 1.0).unsqueeze(-1), length, 0.0)
        point, dual = point + length * move, dual + length * dual_move
        slack, jacobian = evaluate(point)
        # Rounding must not carry a slack of 1e-16 beyond 0.
        slack = slack.clamp(min=1e-18)
    require(least * _GAP <= _ACCEPTED_GAP, "the interior-point method failed; the set is too thin", name)
    return best, best_dual[:, m:]


def _direction(
    complementarity: Tensor,
    bend: Tensor,
    factor: tuple[Tensor, Tensor],
    scale: Tensor,
    stationary: Tensor,
    jacobian: Tensor,
    slack: Tensor,
    dual: Tensor,
) -> tuple[Tensor, Tensor]:
    """Newton step of the point and of the multipliers that removes the residual `stationary` and `complementarity`,
    when slacks fall by `bend` more than linearly."""
    right = -stationary - _times(jacobian.mT, (dual * bend - complementarity) / slack)
    move = torch.linalg.lu_solve(*factor, (right * scale).unsqueeze(-1)).squeeze(-1) * scale
    return move, (dual * (_times(jacobian, move) + bend) - complementarity) / slack


def _along(rows: Tensor, matrix: Tensor, jacobian: Tensor, move: Tensor) -> tuple[Tensor, Tensor]:
    """First- and second-order coefficient (n, m + k) of the constraints' values along the move."""
    bend = (_times(matrix, move.unsqueeze(1)) * move.unsqueeze(1)).sum(-1)
    return _times(jacobian, move), torch.cat((torch.zeros_like(rows[..., 0]), bend), -1)


def _longest(slack: Tensor, slope: Tensor, bend: Tensor, dual: Tensor, dual_move: Tensor, share: float) -> Tensor:
    """Step length (n, 1) up to 1 that goes `share` of the way to where a slack or a multiplier would be 0."""
    # slack = slope t + bend t^2, as a root for 1 / t, which may be 0.
    inverse = (slope + (slope.square() + 4.0 * bend * slack).sqrt()) / (2.0 * slack)
    return share / torch.maximum(inverse, -dual_move / dual).amax(-1, keepdim=True).clamp(min=share)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
