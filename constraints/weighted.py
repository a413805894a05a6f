"""Linear sets whose rows are sign or subset patterns of one weight vector.

The sets have 2^d, 2^d - 1 and 1 rows, but within the orthant of a given point only one of them matters. So projection
and oracle are one scalar dual problem (`RowProblem`), and the gauge needs only the row that the ray meets first.
"""

from __future__ import annotations

import functools
import itertools
from abc import abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor

from constraints.base import AT_FACE, Constraint, ExplicitSet
from constraints.coefficients import Bound, BoundCoefficient, Coefficient, Coefficients, flat
from constraints.errors import ConstraintError
from constraints.implicit import Boundary
from constraints.jacobian import JacobianProduct, deflated_jacobian
from constraints.numerics import one_where_zero, root_or_one, safe_sqrt
from constraints.scalar_dual import RowProblem

_TINY = 1e-300  # replaces the square of a divisor of 0
_MOST_WRITTEN = 16  # most coordinates of a set whose 2^d rows are written out
_MOST_COMPARED = 12  # most coordinates of a set whose rows are all evaluated at every action


class Weights(NamedTuple):
    """Coefficients of a set whose rows are patterns of one weight vector."""

    weight: Tensor  # (..., d)
    bound: Tensor | float  # (..., 1), of each row


class _WeightPatterns(Constraint):
    """Rows pattern_k * weight(obs), all with the same bound.

    The bound is a function or a number; ValueError for a number that is not positive and finite. `penalty` and
    `explicit` write out all rows; ConstraintError if WeightedL1 or WeightedPositivePart has more than 16 coordinates.
    """

    def __init__(self, weight: Coefficients, bound: Bound, dim: int):
        super().__init__(dim)
        self.weight, self.bound = weight, bound
        self._weight_at, self._bound_at = Coefficient("weight", weight, (dim,)), BoundCoefficient("bound", bound)

    def _at(self, obs: Tensor) -> Weights:
        return Weights(self._weight_at(obs), self._bound_at(obs))

    @abstractmethod
    def _row_patterns(self, device: torch.device) -> Tensor:
        """The rows' patterns (m, d), entries in {-1, 0, 1}."""

    @abstractmethod
    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        """The row (..., d) with the largest value in the orthant of `side` (..., d)."""

    def explicit(self, obs: Tensor) -> ExplicitSet:
        weight, bound = self._at(obs)
        rows = weight.unsqueeze(-2) * self._row_patterns(obs.device)
        return ExplicitSet(rows, torch.ones_like(rows[..., 0]) * bound, [])

    def _excess(self, at: Weights, action: Tensor) -> Tensor:
        """Ax - b (..., m) with unit rows; a zero row stays as it is."""
        weight, bound = at
        patterns = self._row_patterns(action.device)
        norm = root_or_one(weight**2 @ (patterns**2).T)
        return ((weight * action) @ patterns.T - bound) / norm

    def _violation(self, at: Weights, action: Tensor) -> Tensor:
        # The largest of `_excess`, by sums. The rounding of a matrix product depends on the size of the batch, and an
        # environment's check must not depend on the others in its batch.
        weight, bound = at
        patterns = self._row_patterns(action.device)
        norm = root_or_one((weight.square().unsqueeze(-2) * patterns.abs()).sum(-1))
        value = ((weight * action).unsqueeze(-2) * patterns).sum(-1)
        return ((value - bound) / norm).amax(-1)

    def _penalty(self, at: Weights, action: Tensor) -> Tensor:
        return safe_sqrt(self._excess(at, action).clamp(min=0.0).square().sum(-1))

    def row_problem(self, at: Weights, target: Tensor) -> RowProblem:
        """The problem with the one row that can be active at the projection of `target` or its oracle point.

        It is mirrored so that the target is positive, because no coordinate of the solution has the opposite sign.
        """
        return RowProblem(target.abs(), self._row(at.weight, target).abs(), at.bound)

    def _project(self, at: Weights, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        solution = self.row_problem(at, action).solve()

        def product(vector: Tensor) -> Tensor:
            return deflated_jacobian(solution.moves(), torch.copysign(solution.row(), action))(vector)

        return torch.copysign(solution.point, action), product

    def _boundaries(self, at: Weights, point: Tensor) -> list[Boundary]:
        row = self._row(at.weight, point.detach()) / at.bound
        return [Boundary((row * point).sum(-1) - 1.0, row)]

    def _free(self, point: Tensor) -> Tensor:
        # At 0 the row has a kink, which holds a coordinate that it presses there.
        return (point.abs() < AT_FACE) & (point != 0.0)

    def _linear_oracle(self, at: Weights, gradient: Tensor) -> Tensor:
        return torch.copysign(self.row_problem(at, gradient).solve(0.0).point, gradient)

    def _gauge_gradients(self, at: Weights, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        (weight, bound), direction = at, direction.detach()
        if center is None:
            return [self._row(weight, direction.sign()) / bound]
        # Along center + t direction the largest row value is convex and starts below the bound; its row changes only
        # where a coordinate crosses 0. The row that reaches the bound is the one after the last crossing below it.
        turns = center * direction < 0.0
        crossing = torch.where(turns, -center / direction, 0.0).clamp(max=1e300)
        point = torch.addcmul(center.unsqueeze(-2), crossing.unsqueeze(-1), direction.unsqueeze(-2))
        # A coordinate that crosses is exactly 0. Its rounding, times a large weight, would exceed the bound.
        point = point.masked_fill(crossing.unsqueeze(-2) == crossing.unsqueeze(-1), 0.0)
        value = (self._row(weight.unsqueeze(-2), point) * point).sum(-1)
        last = ((value <= bound) * crossing).amax(-1, keepdim=True)
        before = torch.where(center == 0.0, direction, center)
        row = self._row(weight, torch.where(turns & (crossing <= last), direction, before).sign())
        return [row / (bound - (row * center).sum(-1, keepdim=True))]


class WeightedL1(_WeightPatterns):
    """sum |w_i a_i| <= bound in the box: 2^d rows (R+O03, R+O10, R+O30, HC+O)."""

    def _row_patterns(self, device: torch.device) -> Tensor:
        return _all_patterns((-1.0, 1.0), self.dim, device)

    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        return weight.abs() * side.sign()

    def _violation(self, at: Weights, action: Tensor) -> Tensor:
        norm = at.weight.norm(dim=-1)  # of every row
        return ((at.weight * action).abs().sum(-1) - flat(at.bound)) / one_where_zero(norm)


class WeightedPositivePart(_WeightPatterns):
    """sum max(w_i a_i, 0) <= bound in the box: 2^d - 1 rows (R+M, H+M, W+M).

    With more than 12 coordinates, `violation` of an action inside the set is computed from only d of the rows. The
    result may be too negative, but its sign is right. Outside the set it is exact.
    """

    origin_centered = False

    def _row_patterns(self, device: torch.device) -> Tensor:
        return _all_patterns((0.0, 1.0), self.dim, device)[1:]

    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        return weight * (weight * side > 0.0)

    def _violation(self, at: Weights, action: Tensor) -> Tensor:
        if self.dim <= _MOST_COMPARED:
            return super()._violation(at, action)
        # For a point outside the set, the row that it exceeds most is a prefix of the coordinates sorted by a_i / w_i:
        # where s.w.a > bound, (s.w.a - bound) / |s w| is quasi-convex in the row's s.w.a and |s w|^2, and prefixes are
        # the corners of what these two can be. For a point inside, the nearest row is a subset-sum problem.
        weight, bound = at
        ratio = torch.where(weight == 0.0, -torch.inf, action / weight)
        order = ratio.argsort(-1, descending=True)
        weight, action = torch.broadcast_tensors(weight, action)
        weight, action = weight.gather(-1, order), action.gather(-1, order)
        norm = root_or_one(weight.square().cumsum(-1))
        return (((weight * action).cumsum(-1) - bound) / norm).amax(-1)

    def _center(self, at: Weights) -> Tensor:
        # Among the rows of all subsets, only prefixes of the weights in descending order limit the radius. Many points
        # have the largest radius; this one is continuous in obs.
        weight, bound = at
        ordered = weight.abs().sort(-1, descending=True).values
        # If all weights are 0, the quotient is large and the radius is the box's.
        total, norm = ordered.cumsum(-1), ordered.square().cumsum(-1).clamp(min=_TINY).sqrt()
        radius = ((bound + total) / (norm + total)).amin(-1, keepdim=True).clamp(max=1.0)
        room = 1.0 - radius
        return -(radius**2 * weight / (2.0 * bound)).clamp(-room, room)


class HalfSpace(_WeightPatterns):
    """normal.a <= bound in the box: one row (HC+MA)."""

    origin_centered = False

    def __init__(self, normal: Coefficients, bound: Bound, dim: int):
        super().__init__(normal, bound, dim)

    def _row_patterns(self, device: torch.device) -> Tensor:
        return torch.ones(1, self.dim, dtype=torch.float64, device=device)

    def _row(self, weight: Tensor, side: Tensor) -> Tensor:
        return weight

    def _mirrored(self, at: Weights, target: Tensor, metric: float) -> tuple[RowProblem, Tensor]:
        """The problem in coordinates 1 + a sign(w), which run from 0 to 2, and the signs (..., d)."""
        weight, size = at.weight, at.weight.abs()
        sign = torch.copysign(torch.ones_like(weight), weight)
        bound = size.sum(-1, keepdim=True) + at.bound
        return RowProblem(sign * target + metric, size, bound, top=2.0), sign

    def _project(self, at: Weights, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        problem, sign = self._mirrored(at, action, 1.0)
        solution = problem.solve()

        def product(vector: Tensor) -> Tensor:
            return deflated_jacobian(solution.moves(), sign * solution.row())(vector)

        return sign * (solution.point - 1.0), product

    def _free(self, point: Tensor) -> Tensor:
        return point.abs() < AT_FACE

    def _linear_oracle(self, at: Weights, gradient: Tensor) -> Tensor:
        problem, sign = self._mirrored(at, gradient, 0.0)
        return sign * (problem.solve(0.0).point - 1.0)

    def _gauge_gradients(self, at: Weights, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        weight, bound = at
        slack = bound if center is None else bound - (weight * center).sum(-1, keepdim=True)
        return [weight / slack]

    def _center(self, at: Weights) -> Tensor:
        weight, bound = at
        total, norm = weight.abs().sum(-1, keepdim=True), weight.norm(dim=-1, keepdim=True)
        radius = ((bound + total) / (norm + total).clamp(min=_TINY)).clamp(max=1.0)
        return -(1.0 - radius) * weight.sign()


def _all_patterns(entries: tuple[float, float], dim: int, device: torch.device) -> Tensor:
    """Every pattern (2^dim, dim) of the two entries; ConstraintError if they are too many to be written out."""
    if dim > _MOST_WRITTEN:
        raise ConstraintError(
            f"a set of {dim} coordinates has 2^{dim} rows, but penalty and explicit support at most {_MOST_WRITTEN}"
            " coordinates; violation(obs, action).clamp(min=0) is a penalty without this limit"
        )
    return _cached_patterns(entries, dim, device)


@functools.lru_cache
def _cached_patterns(entries: tuple[float, float], dim: int, device: torch.device) -> Tensor:
    # All callers share the tensors, and autograd cannot use tensors that were made in inference mode.
    with torch.inference_mode(False):
        rows = list(itertools.product(entries, repeat=dim))
        return torch.tensor(rows, dtype=torch.float64, device=device)
