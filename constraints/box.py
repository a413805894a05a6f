"""The action box alone (R+N)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from constraints.base import Constraint, ExplicitSet
from constraints.jacobian import JacobianProduct, deflated_jacobian
from constraints.sample import uniform


class Box(Constraint):
    """The box [-1, 1]^dim."""

    def _at(self, obs: Tensor) -> tuple[()]:
        return ()

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return ExplicitSet(obs.new_zeros(0, self.dim), obs.new_zeros(0), [])

    def _violation(self, at: Any, action: Tensor) -> Tensor:
        return action.abs().amax(-1) - 1.0

    def _penalty(self, at: Any, action: Tensor) -> Tensor:
        return 0.0 * action.sum(-1)  # keeps the autograd graph that a training loss expects

    def _project(self, at: Any, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        return action.clamp(-1.0, 1.0), deflated_jacobian((action.abs() < 1.0).double())

    def _gauge_gradients(self, at: Any, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        return []

    def _linear_oracle(self, at: Any, gradient: Tensor) -> Tensor:
        return gradient.sign()

    def _sample(self, obs: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        return 2.0 * uniform((*obs.shape[:-1], count, self.dim), obs, generator) - 1.0
