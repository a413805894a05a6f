"""Second-order cone programs in batch, by a primal-dual interior-point method.

Mehrotra's predictor-corrector steps with Nesterov and Todd's scaling (Vandenberghe 2010, "The CVXOPT linear and
quadratic cone program solvers"). The method treats an ellipse as a cone. If it were treated as a smooth function of the
point, Newton's steps could stop at the boundary of a thin set, far from the solution.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.numerics import times

_MAX_STEPS = 60  # 6 to 20 are enough in most cases
_PATIENCE = 8  # steps without progress after which a sample ends
_RESIDUAL = 100.0  # the residual may be this many times the gap
_ACCEPTED = 1e3  # a sample that stalls has converged if its error is below this many times the accuracy


def solve_cone_programs(
    curvature: Tensor,
    gradient: Tensor,
    rows: Tensor,
    bounds: Tensor,
    matrix: Tensor,
    offset: Tensor,
    start: Tensor,
    accuracy: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """argmin y (n, d) of curvature |y|^2 / 2 - <gradient, y> subject to rows (n, m, d) @ y <= bounds (n, m) and
    u_0 >= |(u_1, ..., u_q)| for u = offset (n, k, 1 + q) - matrix (n, k, 1 + q, d) @ y.

    curvature is (n, 1); gradient and start (any point) are (n, d). The objective and constraints should be of order 1.
    A sample ends when the mean product of slack and multiplier is at most `accuracy` and the residual at most 100 times
    that. Also returns the multipliers (n, m + k) of the rows and the u_0, and whether (n,) the method converged. If it
    did not, the point is the best one found. From a strictly feasible start, all points are feasible.
    """
    m, (k, q, dim) = rows.shape[1], matrix.shape[1:]
    count = len(rows)
    stacked = torch.cat((rows, matrix.flatten(1, 2)), 1)
    limits = torch.cat((bounds, offset.flatten(1)), 1)
    root = curvature.sqrt().unsqueeze(-1) * torch.eye(dim, dtype=rows.dtype, device=rows.device)
    unit = torch.zeros_like(limits[:1])
    unit[:, :m] = 1.0
    unit[:, m::q] = 1.0

    def cone_part(vector: Tensor) -> Tensor:
        return vector[:, m:].unflatten(1, (k, q))

    # Start as on the central path: the product of slack and multiplier is the same for all constraints.
    point = start
    slack = limits - times(stacked, point)
    tail = torch.linalg.vector_norm(cone_part(slack)[..., 1:], dim=-1)
    depth = torch.cat((slack[:, :m], slack[:, m::q] - tail), 1).amin(-1, keepdim=True)
    slack = slack + torch.where(depth > 0.0, 0.0, 1.0 - depth) * unit
    cone = cone_part(slack)
    mirrored = torch.cat((cone[..., :1], -cone[..., 1:]), -1) / _cone_size(cone).square()
    dual = slack.amax(-1, keepdim=True) * torch.cat((1.0 / slack[:, :m], mirrored.flatten(1)), 1)
    best, best_dual = point.clone(), dual.clone()
    least, improved = rows.new_full((count,), torch.inf), rows.new_zeros(count, dtype=torch.long)
    sample = torch.arange(count, device=rows.device)  # unfinished ones
    for number in range(_MAX_STEPS):
        stationary = curvature * point - gradient + times(stacked.mT, dual)
        infeasible = slack + times(stacked, point) - limits
        gap = (slack * dual).sum(-1) / (m + k)
        residual = torch.maximum(stationary.abs().amax(-1), infeasible.abs().amax(-1))
        error = torch.maximum(gap, residual / _RESIDUAL)
        better = error < least[sample]
        found = sample[better]
        best[found], best_dual[found], least[found], improved[found] = (
            point[better],
            dual[better],
            error[better],
            number,
        )
        # A sample without progress, or with a value that is not finite, has reached the limit of its conditioning.
        live = (
            ((least[sample] > accuracy) & error.isfinite() & (number - improved[sample] < _PATIENCE))
            .nonzero()
            .squeeze(-1)
        )
        if len(live) == 0:
            break
        if len(live) <= 0.7 * len(sample):
            sample, point, slack, dual = sample[live], point[live], slack[live], dual[live]
            curvature, gradient, stacked, limits = curvature[live], gradient[live], stacked[live], limits[live]
            root, stationary, infeasible, gap = root[live], stationary[live], infeasible[live], gap[live]

        scaling = _Scaling(slack, dual, m, k)
        scaled = scaling.divide(stacked)
        # By QR: the normal equations would square the condition number.
        basis, triangle = torch.linalg.qr(torch.cat((scaled, root), 1))
        basis = basis[:, : scaled.shape[1]]
        shift = scaling.divide(infeasible.unsqueeze(-1)).squeeze(-1)

        def step(
            complementarity: Tensor, scaled=scaled, basis=basis, triangle=triangle, shift=shift, stationary=stationary
        ) -> tuple[Tensor, Tensor, Tensor]:
            """Newton step of the point, the scaled slacks and the scaled multipliers."""
            right = torch.linalg.solve_triangular(triangle.mT, -stationary.unsqueeze(-1), upper=False)
            right = right - basis.mT @ (shift - complementarity).unsqueeze(-1)
            move = torch.linalg.solve_triangular(triangle, right, upper=True).squeeze(-1)
            dual_move = times(scaled, move) + shift - complementarity
            return move, -complementarity - dual_move, dual_move

        middle = scaling.middle
        _, slack_move, dual_move = step(middle)
        length = scaling.longest(slack_move, dual_move, 1.0)
        predicted = ((middle + length * slack_move) * (middle + length * dual_move)).sum(-1) / (m + k)
        centering = (predicted / gap).clamp(0.0, 1.0) ** 3 * gap
        bend = scaling.product(slack_move, dual_move) - centering.unsqueeze(-1) * unit
        move, slack_move, dual_move = step(middle + scaling.quotient(bend))
        length = scaling.longest(slack_move, dual_move, 0.99)

        point = point + length * move
        slack = slack - length * (infeasible + times(stacked, move))
        dual = dual + length * scaling.divide(dual_move.unsqueeze(-1)).squeeze(-1)
    return best, torch.cat((best_dual[:, :m], best_dual[:, m::q]), 1), least <= _ACCEPTED * accuracy


class _Scaling:
    """Nesterov and Todd's W of slacks s and multipliers z (n, m + k (1 + q)), with W z = W^-1 s = `middle`.

    It is a diagonal on the rows, and a hyperbolic rotation times a factor on each cone.
    """

    def __init__(self, slack: Tensor, dual: Tensor, m: int, k: int):
        self.m, self.k = m, k
        self.diagonal = (slack[:, :m] / dual[:, :m]).sqrt()
        cone, cone_dual = self._cone_part(slack), self._cone_part(dual)
        size, dual_size = _cone_size(cone), _cone_size(cone_dual)
        self.factor = (size / dual_size).sqrt()
        cone, cone_dual = cone / size, cone_dual / dual_size
        twice = (2.0 + 2.0 * (cone * cone_dual).sum(-1, keepdim=True)).sqrt()
        first = (cone[..., :1] + cone_dual[..., :1]) / twice
        self.rotation = first, (cone[..., 1:] - cone_dual[..., 1:]) / twice
        self.middle = self.multiply(dual)
        self.middle_size = _cone_size(self._cone_part(self.middle))

    def multiply(self, vector: Tensor) -> Tensor:
        """W v for vectors (n, m + k (1 + q))."""
        first, rest = self.rotation
        cone = self._cone_part(vector)
        head, tail = cone[..., :1], cone[..., 1:]
        along = (rest * tail).sum(-1, keepdim=True)
        out = torch.cat((first * head + along, tail + (head + along / (1.0 + first)) * rest), -1)
        return torch.cat((self.diagonal * vector[:, : self.m], (self.factor * out).flatten(1)), 1)

    def divide(self, columns: Tensor) -> Tensor:
        """W^-1 of columns (n, m + k (1 + q), c)."""
        first, rest = (part.unsqueeze(-1) for part in self.rotation)
        cone = self._cone_part(columns)
        head, tail = cone[:, :, :1], cone[:, :, 1:]
        along = (rest * tail).sum(2, keepdim=True)
        out = torch.cat((first * head - along, tail + (along / (1.0 + first) - head) * rest), 2)
        rows = columns[:, : self.m] / self.diagonal.unsqueeze(-1)
        return torch.cat((rows, (out / self.factor.unsqueeze(-1)).flatten(1, 2)), 1)

    def product(self, left: Tensor, right: Tensor) -> Tensor:
        """Jordan product (n, m + k (1 + q))."""
        a, b = self._cone_part(left), self._cone_part(right)
        out = torch.cat(((a * b).sum(-1, keepdim=True), a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:]), -1)
        return torch.cat((left[:, : self.m] * right[:, : self.m], out.flatten(1)), 1)

    def quotient(self, vector: Tensor) -> Tensor:
        """v with `product(middle, v)` = vector."""
        cone, value = self._cone_part(self.middle), self._cone_part(vector)
        across = (cone[..., 1:] * value[..., 1:]).sum(-1, keepdim=True)
        head = (cone[..., :1] * value[..., :1] - across) / self.middle_size.square()
        out = torch.cat((head, (value[..., 1:] - head * cone[..., 1:]) / cone[..., :1]), -1)
        return torch.cat((vector[:, : self.m] / self.middle[:, : self.m], out.flatten(1)), 1)

    def longest(self, slack_move: Tensor, dual_move: Tensor, share: float) -> Tensor:
        """Step length (n, 1), at most 1: `share` of the way on which slacks and multipliers stay in their cones."""
        moves = torch.stack((slack_move, dual_move), 1)
        rows = -moves[..., : self.m] / self.middle[:, None, : self.m]
        moved = moves[..., self.m :].unflatten(2, (self.k, -1))
        size = self.middle_size.unsqueeze(1)
        cone = self._cone_part(self.middle).unsqueeze(1) / size
        first, rest = cone[..., :1], cone[..., 1:]
        head = first * moved[..., :1] - (rest * moved[..., 1:]).sum(-1, keepdim=True)
        tail = moved[..., 1:] - (head + moved[..., :1]) / (first + 1.0) * rest
        out = (torch.linalg.vector_norm(tail, dim=-1, keepdim=True) - head) / size
        inverse = torch.maximum(rows.flatten(1).amax(-1), out.flatten(1).amax(-1)).unsqueeze(-1)
        return share / inverse.clamp(min=share)

    def _cone_part(self, vector: Tensor) -> Tensor:
        return vector[:, self.m :].unflatten(1, (self.k, -1))


def _cone_size(cone: Tensor) -> Tensor:
    """sqrt(u_0^2 - |u_1, ..., u_q|^2) (..., 1) of points (..., 1 + q) in the cone."""
    head, tail = cone[..., :1], torch.linalg.vector_norm(cone[..., 1:], dim=-1, keepdim=True)
    return ((head - tail) * (head + tail)).sqrt()
