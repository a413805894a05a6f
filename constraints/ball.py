"""A ball (R+L2). Inside the box, all of its methods are closed forms; only the box alone is cheaper."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from constraints.coefficients import Bound
from constraints.ellipse import DiagonalEllipse, ellipse_gauge_gradient
from constraints.gauge import largest_gauge
from constraints.jacobian import JacobianProduct
from constraints.sample import uniform_in_ball


class _InBox(NamedTuple):
    """A ball inside the box, whose bound does not depend on the observation."""

    bound: float


class Ball(DiagonalEllipse):
    """sum a_i^2 <= bound in the box; the bound is a number or a function of obs.

    With a number up to 1, the ball lies inside the box: every method is then one formula that ignores the box. With any
    other bound, the class works as a DiagonalEllipse. ValueError for a number that is not positive and finite.
    """

    def __init__(self, bound: Bound, dim: int):
        super().__init__(self._ones, bound, dim)
        self._in_box = None if callable(bound) or bound > 1.0 else _InBox(float(bound))

    def _ones(self, obs: Tensor) -> Tensor:
        return obs.new_ones(self.dim)

    def _at(self, obs: Tensor) -> Any:
        return self._in_box or super()._at(obs)

    def _violation(self, at: Any, action: Tensor) -> Tensor:
        if self._in_box is None:
            return super()._violation(at, action)
        return action.norm(dim=-1) - at.bound**0.5  # the trace of Q = I is dim already

    def _project(self, at: Any, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        if self._in_box is None:
            return super()._project(at, action)
        radius = at.bound**0.5
        norm = action.norm(dim=-1, keepdim=True)
        shrink = radius / norm.clamp(min=radius)

        def product(vector: Tensor) -> Tensor:
            unit = action / norm.clamp(min=radius)
            tangent = vector - unit * (unit * vector).sum(-1, keepdim=True)
            return torch.where(norm > radius, shrink * tangent, vector)

        return action * shrink, product

    def _linear_oracle(self, at: Any, gradient: Tensor) -> Tensor:
        if self._in_box is None:
            return super()._linear_oracle(at, gradient)
        return torch.nn.functional.normalize(gradient, dim=-1, eps=1e-300) * at.bound**0.5

    def _gauge_and_gradient(self, at: Any, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        if self._in_box is None:
            return super()._gauge_and_gradient(at, direction, center)
        return largest_gauge(direction, ellipse_gauge_gradient(direction, direction, center, center, at.bound))

    def _sample(self, obs: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        if self._in_box is None:
            return super()._sample(obs, count, generator)
        return self._in_box.bound**0.5 * uniform_in_ball((*obs.shape[:-1], count, self.dim), obs, generator)
