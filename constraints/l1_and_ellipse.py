"""Weighted L1 ball and diagonal ellipse at once (H+O+S, W+O+S)."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.base import Coefficients, Constraint, ExplicitSet
from constraints.ellipse import DiagonalEllipse, minimize_in_ellipse
from constraints.jacobian import JacobianProduct
from constraints.weighted import WeightedL1


class WeightedL1AndEllipse(Constraint):
    """sum |w_i a_i| <= weight_bound and sum s_i a_i^2 <= scale_bound in the box.

    Projection and oracle have two multipliers. The row's is exact for each value of the ellipse's.
    """

    def __init__(self, weight: Coefficients, weight_bound: float, scale: Coefficients, scale_bound: float, dim: int):
        super().__init__(dim)
        self.l1 = WeightedL1(weight, weight_bound, dim)
        self.ellipse = DiagonalEllipse(scale, scale_bound, dim)

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return self.l1.explicit(obs)._replace(ellipses=self.ellipse.explicit(obs).ellipses)

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        return torch.maximum(self.l1._violation(obs, action), self.ellipse._violation(obs, action))

    def _penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        return self.l1._penalty(obs, action) + self.ellipse._penalty(obs, action)

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        problem = self.l1.row_problem(obs, action)
        return minimize_in_ellipse(problem, action, 1.0, self.ellipse.scale(obs), self.ellipse.bound)

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        problem = self.l1.row_problem(obs, gradient)
        return minimize_in_ellipse(problem, gradient, 0.0, self.ellipse.scale(obs), self.ellipse.bound)[0]

    def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        parts = self.l1, self.ellipse
        return [gradient for part in parts for gradient in part._gauge_gradients(obs, direction, center)]
