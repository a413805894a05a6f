"""Weighted L1 ball and diagonal ellipse at once (H+O+S, W+O+S)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from constraints.base import Constraint, ExplicitSet
from constraints.coefficients import Bound, Coefficients
from constraints.ellipse import DiagonalEllipse, Scales, minimize_in_ellipse
from constraints.implicit import Boundary
from constraints.jacobian import JacobianProduct
from constraints.weighted import WeightedL1, Weights


class _Both(NamedTuple):
    weight: Tensor  # (..., d)
    weight_bound: Tensor | float  # (..., 1)
    scale: Tensor  # (..., d)
    scale_bound: Tensor | float  # (..., 1)

    @property
    def row(self) -> Weights:
        return Weights(self.weight, self.weight_bound)

    @property
    def ellipse(self) -> Scales:
        return Scales(self.scale, self.scale_bound)


class WeightedL1AndEllipse(Constraint):
    """sum |w_i a_i| <= weight_bound and sum s_i a_i^2 <= scale_bound in the box.

    Bounds are numbers or functions of obs. Projection and oracle search for the ellipse's multiplier; for each of its
    values, the row's multiplier is exact.
    """

    def __init__(self, weight: Coefficients, weight_bound: Bound, scale: Coefficients, scale_bound: Bound, dim: int):
        super().__init__(dim)
        self.l1 = WeightedL1(weight, weight_bound, dim)
        self.ellipse = DiagonalEllipse(scale, scale_bound, dim)

    def _at(self, obs: Tensor) -> _Both:
        return _Both(*self.l1._at(obs), *self.ellipse._at(obs))

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return self.l1.explicit(obs)._replace(ellipses=self.ellipse.explicit(obs).ellipses)

    def _violation(self, at: _Both, action: Tensor) -> Tensor:
        return torch.maximum(self.l1._violation(at.row, action), self.ellipse._violation(at.ellipse, action))

    def _penalty(self, at: _Both, action: Tensor) -> Tensor:
        return self.l1._penalty(at.row, action) + self.ellipse._penalty(at.ellipse, action)

    def _project(self, at: _Both, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        return minimize_in_ellipse(self.l1.row_problem(at.row, action), action, 1.0, *at.ellipse)

    def _boundaries(self, at: _Both, point: Tensor) -> list[Boundary]:
        return [*self.l1._boundaries(at.row, point), *self.ellipse._boundaries(at.ellipse, point)]

    def _free(self, point: Tensor) -> Tensor:
        return self.l1._free(point)

    def _linear_oracle(self, at: _Both, gradient: Tensor) -> Tensor:
        return minimize_in_ellipse(self.l1.row_problem(at.row, gradient), gradient, 0.0, *at.ellipse)[0]

    def _gauge_gradients(self, at: _Both, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        row = self.l1._gauge_gradients(at.row, direction, center)
        return row + self.ellipse._gauge_gradients(at.ellipse, direction, center)
