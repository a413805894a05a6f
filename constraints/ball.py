"""A ball inside the box (R+L2). Everything is a closed form; only the box alone is cheaper."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.base import Constraint, Ellipse, ExplicitSet
from constraints.ellipse import ellipse_gauge_gradient
from constraints.gauge import largest_gauge
from constraints.jacobian import JacobianProduct
from constraints.sample import uniform_in_ball


class Ball(Constraint):
    """sum a_i^2 <= bound <= 1, so the box is never active. ValueError for another bound."""

    def __init__(self, bound: float, dim: int):
        super().__init__(dim)
        if not 0.0 < bound <= 1.0:
            raise ValueError(f"a ball in the box has a bound in (0, 1], got {bound}")
        self.bound = bound
        self.radius = bound**0.5

    def explicit(self, obs: Tensor) -> ExplicitSet:
        identity = torch.eye(self.dim, dtype=obs.dtype, device=obs.device).expand(*obs.shape[:-1], -1, -1)
        ellipse = Ellipse(identity, obs.new_zeros(self.dim), self.bound)
        return ExplicitSet(obs.new_zeros(0, self.dim), obs.new_zeros(0), [ellipse])

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        return action.norm(dim=-1) - self.radius  # the trace of the identity is dim already

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        norm = action.norm(dim=-1, keepdim=True)
        shrink = self.radius / norm.clamp(min=self.radius)

        def product(vector: Tensor) -> Tensor:
            unit = action / norm.clamp(min=self.radius)
            tangent = vector - unit * (unit * vector).sum(-1, keepdim=True)
            return torch.where(norm > self.radius, shrink * tangent, vector)

        return action * shrink, product

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        return torch.nn.functional.normalize(gradient, dim=-1, eps=1e-300) * self.radius

    def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        return [ellipse_gauge_gradient(direction, direction, center, center, self.bound)]

    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        # The box is never active.
        return largest_gauge(direction, *self._gauge_gradients(obs, direction, center))

    def _sample(self, obs: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        return self.radius * uniform_in_ball((*obs.shape[:-1], count, self.dim), obs, generator)
