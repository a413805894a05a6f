"""Linear sets whose rows are sign or subset patterns of one weight vector.

The sets have 2^d, 2^d - 1 and 1 rows, but within the orthant of a given point only one of them matters. So projection
and oracle are one scalar dual problem (`RowProblem`), and the gauge needs only the row that the ray meets first.
"""

from __future__ import annotations

import functools
import itertools
from abc import abstractmethod

import torch
from torch import Tensor

from constraints.base import Coefficients, Constraint, ExplicitSet
from constraints.errors import check_bound
from constraints.jacobian import JacobianProduct, deflated_jacobian
from constraints.numerics import one_where_zero, safe_sqrt
from constraints.scalar_dual import RowProblem


class _WeightPatterns(Constraint):
    """Rows pattern_k * weight(obs), all with the same bound > 0. ValueError for another bound."""

    def __init__(self, weight: Coefficients, bound: float, dim: int):
        super().__init__(dim)
        check_bound(bound)
        self.weight = weight
        self.bound = bound

    @abstractmethod
    def _row_patterns(self, device: torch.device) -> Tensor:
        """The rows' patterns (m, d), entries in {-1, 0, 1}."""

    @abstractmethod
    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        """The row (..., d) with the largest value in the orthant of `side` (..., d)."""

    def explicit(self, obs: Tensor) -> ExplicitSet:
        rows = self.weight(obs).unsqueeze(-2) * self._row_patterns(obs.device)
        return ExplicitSet(rows, torch.full_like(rows[..., 0], self.bound), [])

    def _excess(self, obs: Tensor, action: Tensor) -> Tensor:
        """Ax - b (..., m) with unit rows; a zero row stays as it is."""
        weight = self.weight(obs)
        patterns = self._row_patterns(action.device)
        norm = (weight**2 @ (patterns**2).T).sqrt()
        return ((weight * action) @ patterns.T - self.bound) / one_where_zero(norm)

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        # The largest of `_excess`, by sums: matrix products round a sample by the size of its batch, and an
        # environment's check must not depend on the others in its batch.
        weight = self.weight(obs)
        patterns = self._row_patterns(action.device)
        norm = (weight.square().unsqueeze(-2) * patterns.abs()).sum(-1).sqrt()
        value = ((weight * action).unsqueeze(-2) * patterns).sum(-1)
        return ((value - self.bound) / one_where_zero(norm)).amax(-1)

    def _penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        return safe_sqrt(self._excess(obs, action).clamp(min=0.0).square().sum(-1))

    def row_problem(self, obs: Tensor, target: Tensor) -> RowProblem:
        """The problem of the one row that can hold the projection of `target`, or the oracle's answer for it.

        It is mirrored to the orthant of the target, because the solution never has the opposite sign.
        """
        return RowProblem(target.abs(), self._row(self.weight(obs), target).abs(), self.bound)

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        solution = self.row_problem(obs, action).solve()

        def product(vector: Tensor) -> Tensor:
            return deflated_jacobian(solution.moves(), torch.copysign(solution.row(), action))(vector)

        return torch.copysign(solution.point, action), product

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        return torch.copysign(self.row_problem(obs, gradient).solve(0.0).point, gradient)

    def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        weight, direction = self.weight(obs), direction.detach()
        if center is None:
            return [self._row(weight, direction.sign()) / self.bound]
        # Along center + t direction the largest row value is convex and starts below the bound; its row changes only
        # where a coordinate crosses 0. The row that reaches the bound is the one after the last crossing below it.
        turns = center * direction < 0.0
        crossing = torch.where(turns, -center / direction, 0.0).clamp(max=1e300)
        point = torch.addcmul(center.unsqueeze(-2), crossing.unsqueeze(-1), direction.unsqueeze(-2))
        # A coordinate that crosses is 0. Its rounding, times a large weight, would exceed the bound.
        point.masked_fill_(crossing.unsqueeze(-2) == crossing.unsqueeze(-1), 0.0)
        value = (self._row(weight.unsqueeze(-2), point) * point).sum(-1)
        last = ((value <= self.bound) * crossing).amax(-1, keepdim=True)
        before = torch.where(center == 0.0, direction, center)
        row = self._row(weight, torch.where(turns & (crossing <= last), direction, before).sign())
        return [row / (self.bound - (row * center).sum(-1, keepdim=True))]


class WeightedL1(_WeightPatterns):
    """sum |w_i a_i| <= bound in the box: 2^d rows (R+O03, R+O10, R+O30, HC+O)."""

    def _row_patterns(self, device: torch.device) -> Tensor:
        return _all_patterns((-1.0, 1.0), self.dim, device)

    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        return weight.abs() * side.sign()

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        weight = self.weight(obs)
        norm = weight.norm(dim=-1)  # of every row
        return ((weight * action).abs().sum(-1) - self.bound) / one_where_zero(norm)


class WeightedPositivePart(_WeightPatterns):
    """sum max(w_i a_i, 0) <= bound in the box: 2^d - 1 rows (R+M, H+M, W+M)."""

    origin_centered = False

    def _row_patterns(self, device: torch.device) -> Tensor:
        return _all_patterns((0.0, 1.0), self.dim, device)[1:]

    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        return weight * (weight * side > 0.0)

    def _center(self, obs: Tensor) -> Tensor:
        # Among the rows of all subsets, only prefixes of the weights sorted downwards limit the radius. Many points
        # attain it; this one is continuous in obs.
        weight = self.weight(obs)
        ordered = weight.abs().sort(-1, descending=True).values
        total, norm = ordered.cumsum(-1), ordered.square().cumsum(-1).sqrt()
        radius = ((self.bound + total) / (norm + total)).amin(-1, keepdim=True).clamp(max=1.0)
        room = 1.0 - radius
        return -(radius**2 * weight / (2.0 * self.bound)).clamp(-room, room)


class HalfSpace(_WeightPatterns):
    """normal.a <= bound in the box: one row (HC+MA)."""

    origin_centered = False

    def __init__(self, normal: Coefficients, bound: float, dim: int):
        super().__init__(normal, bound, dim)

    def _row_patterns(self, device: torch.device) -> Tensor:
        return torch.ones(1, self.dim, dtype=torch.float64, device=device)

    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        return weight

    def _mirrored(self, obs: Tensor, target: Tensor, metric: float) -> tuple[RowProblem, Tensor]:
        """The problem in coordinates 1 + a sign(w), which run from 0 to 2, and the signs (..., d)."""
        weight = self.weight(obs)
        size = weight.abs()
        sign = torch.copysign(torch.ones_like(weight), weight)
        bound = size.sum(-1, keepdim=True) + self.bound
        return RowProblem(sign * target + metric, size, bound, top=2.0), sign

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        problem, sign = self._mirrored(obs, action, 1.0)
        solution = problem.solve()

        def product(vector: Tensor) -> Tensor:
            return deflated_jacobian(solution.moves(), sign * solution.row())(vector)

        return sign * (solution.point - 1.0), product

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        problem, sign = self._mirrored(obs, gradient, 0.0)
        return sign * (problem.solve(0.0).point - 1.0)

    def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        weight = self.weight(obs)
        slack = self.bound if center is None else self.bound - (weight * center).sum(-1, keepdim=True)
        return [weight / slack]

    def _center(self, obs: Tensor) -> Tensor:
        weight = self.weight(obs)
        total, norm = weight.abs().sum(-1, keepdim=True), weight.norm(dim=-1, keepdim=True)
        radius = ((self.bound + total) / (norm + total)).clamp(max=1.0)
        return -(1.0 - radius) * weight.sign()


@functools.lru_cache
def _all_patterns(entries: tuple[float, float], dim: int, device: torch.device) -> Tensor:
    """Every pattern (2^dim, dim) of the two entries."""
    rows = list(itertools.product(entries, repeat=dim))
    return torch.tensor(rows, dtype=torch.float64, device=device)
