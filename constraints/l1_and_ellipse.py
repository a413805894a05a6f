"""Weighted L1 ball and diagonal ellipse at once (H+O+S, W+O+S)."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.base import (
    Coefficients,
    Constraint,
    ExplicitSet,
    JacobianProduct,
    box_gauge_gradient,
    largest_gauge,
)
from constraints.ellipse import DiagonalEllipse, minimize_in_ellipse
from constraints.weighted import WeightedL1


class WeightedL1AndEllipse(Constraint):
    """sum |w_i a_i| <= weight_bound and sum s_i a_i^2 <= scale_bound in the box.

    Projection and oracle have two multipliers: the row's is exact for each value of the ellipse's.
    """

    def __init__(self, weight: Coefficients, weight_bound: float, scale: Coefficients, scale_bound: float, dim: int):
        super().__init__(dim)
        self.l1 = WeightedL1(weight, weight_bound, dim)
        self.ellipse = DiagonalEllipse(scale, scale_bound, dim)

    def explicit(self, obs: Tensor) -> ExplicitSet:
        rows, bounds, _ = self.l1.explicit(obs)
        return rows, bounds, self.ellipse.explicit(obs)[2]

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

    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        return largest_gauge(
            direction,
            box_gauge_gradient(direction, center),
            self.l1.gauge_gradient(obs, direction, center),
            self.ellipse.gauge_gradient(obs, direction, center),
        )
