"""The base of sets of one's own, and checks of the coefficients that their functions return."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.base import Constraint
from constraints.checks import ON_BOUNDARY, checked
from constraints.errors import name_samples, require
from constraints.general.centers import chebyshev_centers, interior_points
from constraints.general.linear_programs import maximize_on_rows
from constraints.general.projection import closest_points, optimal_points, projection_jacobian
from constraints.general.scaled_sets import ScaledSets, scale_sets
from constraints.jacobian import JacobianProduct
from constraints.numerics import is_traced, times

__all__ = ["ON_BOUNDARY", "GeneralConstraint", "check_obs", "checked"]


class GeneralConstraint(Constraint):
    """A set that `explicit(obs)` writes out. A subclass adds that, `_violation` and `_gauge_gradients`."""

    origin_centered = False
    solved_on_cpu = True

    def _check_center(self, obs: Tensor, center: Tensor) -> None:
        pass  # in every call where it is used, below and in the subclasses

    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        if center is not None:
            inside = center.abs().amax(-1) < 1.0 - ON_BOUNDARY
            require(inside.flatten(), "the centre is not inside the box", name_samples(tuple(inside.shape)))
            center = center.expand_as(direction)
        return super()._gauge_and_gradient(obs, direction, center)

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        sets = self._scaled_sets(obs, action.shape[:-1])
        target = action.reshape(-1, self.dim).cpu()
        finite = target.isfinite().all(-1, keepdim=True)
        solution, metric, multipliers = closest_points(sets, torch.where(finite, target, 0.0))

        def product(vector: Tensor) -> Tensor:
            jacobian = projection_jacobian(sets, solution, metric, multipliers)
            return times(jacobian, vector.reshape(-1, self.dim).cpu()).view(vector.shape).to(vector)

        # There is no closest point to an infinite one.
        answer = torch.where(finite, solution, torch.nan)
        return answer.view(action.shape).to(action.device), product

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        sets = self._scaled_sets(obs, gradient.shape[:-1])
        slope = gradient.reshape(-1, self.dim).cpu()
        size = slope.abs().amax(-1, keepdim=True)
        finite = size.isfinite()
        slope = torch.where(finite & (size > 0.0), slope / size, 0.0)
        solution = optimal_points(sets, slope, linear=True)[0] if sets.curved else maximize_on_rows(sets, slope)
        return torch.where(finite, solution, torch.nan).view(gradient.shape).to(gradient.device)

    def _center(self, obs: Tensor) -> Tensor:
        sets = self._scaled_sets(obs, obs.shape[:-1])
        center = interior_points(sets) if sets.curved else chebyshev_centers(sets)
        return center.view(*obs.shape[:-1], self.dim).to(obs.device)

    def _scaled_sets(self, obs: Tensor, lead: tuple[int, ...]) -> ScaledSets:
        written = self.explicit(obs)
        ellipses = [value for ellipse in written.ellipses for value in ellipse]
        if is_traced(written.rows, written.bounds, *ellipses):
            raise RuntimeError(
                f"project, center and linear_oracle of {type(self).__name__} have no gradient with respect to the"
                " observation or to learned coefficients, and no torch.func transforms; pass obs.detach(), or"
                " coefficients without gradients"
            )
        return scale_sets(written, lead)


def check_obs(obs: Tensor) -> None:
    """Raise a ConstraintError for a NaN or infinite observation."""
    valid = obs.isfinite().all(-1)
    require(valid.flatten(), "the observation is NaN or infinite", name_samples(tuple(valid.shape)))
