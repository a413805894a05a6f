"""The base class of general sets, which checks the coefficients that their functions return."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from constraints.base import Constraint, ExplicitSet, OnEmpty
from constraints.checks import (
    ON_BOUNDARY,
    check_each_alone,
    check_function,
    check_observation,
    check_tensor,
    checked,
)
from constraints.ellipse import ellipse_gauge_gradient
from constraints.errors import ConstraintError, EmptySetError, name_samples, require
from constraints.general.active_set import project_on_rows
from constraints.general.centers import deep_points, interior_points
from constraints.general.depth import least_excess, widened
from constraints.general.derivatives import projection_jacobian, with_derivatives
from constraints.general.linear_programs import maximize_on_rows
from constraints.general.projection import closest_points, optimal_points
from constraints.general.scaled_sets import ScaledSets, guessed_points, scale_sets
from constraints.jacobian import JacobianProduct
from constraints.numerics import is_mapped, is_traced, is_transformed, refuse_transforms, times

Result = TypeVar("Result")


class At:
    """A set at observations (..., n): the tensors of its coefficients, and its rows and ellipses on demand."""

    def __init__(
        self, obs: Tensor, tensors: list[Tensor], write: Callable[[], ExplicitSet], parts: tuple[Any, ...] = ()
    ):
        self.obs, self.parts = obs, parts
        self._tensors, self._write = tensors, write

    def __iter__(self) -> Iterator[Tensor]:
        return iter(self._tensors)

    @property
    def lead(self) -> tuple[int, ...]:
        """The leading shape of the observations."""
        return tuple(self.obs.shape[:-1])

    @cached_property
    def written(self) -> ExplicitSet:
        """The set's rows and ellipses."""
        return self._write()


class GeneralConstraint(Constraint):
    """A set of rows and ellipses. A subclass implements `explicit`, `_coefficients`, `_violation` and `_part_gauges`.

    `on_empty` decides what happens if no action satisfies the constraint. "error" raises an EmptySetError that names
    the sample. With "least", the set consists of the actions in the box with the least violation, up to 5e-7, and
    `violation` still reports that violation. ValueError for any other value.
    """

    origin_centered = False
    solved_on_cpu = True

    def __init__(self, dim: int, on_empty: OnEmpty = "error"):
        super().__init__(dim)
        if on_empty not in ("error", "least"):
            raise ValueError(f"unknown on_empty {on_empty!r} (choices: error, least)")
        self.on_empty = on_empty
        self._compared: set[str] = set()

    @torch.no_grad()
    def least_violation(self, obs: Tensor) -> Tensor:
        check_observation(obs)
        at = self.at(obs.double())
        sets = scale_sets(at.written, at.lead, check=False)
        # A zero row reads 0 <= b. Every action violates it by -b.
        fixed = torch.where(sets.solid, 0.0, -sets.bounds).amax(-1)
        return torch.maximum(least_excess(sets), fixed).clamp(min=0.0).view(at.lead).to(obs)

    @abstractmethod
    def _coefficients(self, obs: Tensor) -> At:
        """The coefficients at obs (..., n), checked."""

    def _values(self, function: Callable[[Tensor], Any], what: str, shape: tuple[int, ...], obs: Tensor) -> Tensor:
        """The values of a function at obs (..., n), as `checked` returns them."""
        check_function(what.removesuffix("(obs)"), function)
        values = checked(function(obs), what, shape, obs)
        if what not in self._compared and obs.shape[:-1].numel() > 1 and not is_transformed():
            self._compared.add(what)
            check_each_alone(function, values, what, len(shape), obs)
        return values

    @abstractmethod
    def _part_gauges(self, at: At, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        """As `_gauge_gradients`, but with a ConstraintError if the centre is not interior."""

    def _at(self, obs: Tensor) -> At | Tensor:
        # Transforms of torch.func see the solvers from outside, as one function of the observation.
        return obs if is_transformed() else self._coefficients(obs)

    def at(self, at: At | Tensor) -> At:
        """The coefficients for what `_at` returned, which may be the observation."""
        if not isinstance(at, Tensor):
            return at
        if is_mapped():
            raise RuntimeError(
                f"{type(self).__name__} supports torch.func.vmap only in project; its other methods take batches of"
                " any leading shape without vmap"
            )
        return self._coefficients(at)

    def _check_center(self, at: At | Tensor, center: Tensor) -> None:
        pass  # checked in every call that uses it, below and in the subclasses

    def _gauge_and_gradient(self, at: At | Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        if center is not None:
            inside = center.abs().amax(-1) < 1.0 - ON_BOUNDARY
            require(inside.flatten(), "the centre is not inside the box", name_samples(tuple(inside.shape)))
            center, direction = torch.broadcast_tensors(center, direction)
        return super()._gauge_and_gradient(at, direction, center)

    def _gauge_gradients(self, at: At | Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        at = self.at(at)
        try:
            return self._part_gauges(at, direction, center)
        except ConstraintError:
            if self.on_empty != "least":
                raise
        # No centre is inside an empty set. It may be inside the widened set that replaces it.
        self._refuse_derivatives(at, "where the set is empty")
        lead = tuple(direction.shape[:-1])
        sets = widened(scale_sets(at.written, lead, check=False), flat=True)
        middle = torch.zeros_like(direction) if center is None else center
        require(sets.depth(middle.reshape(-1, self.dim).cpu()) > 0.0, "the centre is not inside the set", sets.name)
        along, offset = direction.reshape(-1, 1, self.dim).cpu(), middle.reshape(-1, 1, self.dim).cpu()
        slack = sets.bounds - times(sets.rows, offset.squeeze(1))
        first = (times(sets.rows, along.detach().squeeze(1)) / slack).argmax(-1, keepdim=True)
        row = sets.rows.take_along_dim(first.unsqueeze(-1), 1).squeeze(1) / slack.gather(-1, first)
        offset = offset - sets.center
        bent, bent_along = times(sets.matrix, offset), times(sets.matrix, along)
        ellipses = ellipse_gauge_gradient(along, bent_along, offset, bent, 1.0)
        return [part.view(direction.shape).to(direction.device) for part in (row, *ellipses.unbind(1))]

    def _project(self, at: At | Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        at = self.at(at)
        self._refuse_derivatives(at, "here")
        target, finite = self._finite(action)
        sets, (solution, metric, multipliers) = self._solve(
            at, action.shape[:-1], lambda sets: closest_points(sets, target)
        )

        def product(vector: Tensor) -> Tensor:
            jacobian = projection_jacobian(sets, solution, metric, multipliers)
            return times(jacobian, vector.reshape(-1, self.dim).cpu()).view(vector.shape).to(vector)

        # An infinite point has no closest one.
        answer = torch.where(finite, solution, torch.nan)
        return answer.view(action.shape).to(action.device), product

    def _differentiable_projection(self, at: At | Tensor, action: Tensor) -> Tensor:
        if isinstance(at, Tensor):
            return super()._differentiable_projection(at, action)
        target, finite = self._finite(action)

        def solve(sets: ScaledSets) -> Tensor:
            with torch.no_grad():
                solution = closest_points(sets.detach(), target.detach())
            return with_derivatives(sets, target, *solution)

        solution = self._solve(at, action.shape[:-1], solve)[1]
        return torch.where(finite, solution, torch.nan).view(action.shape).to(action.device)

    def _linear_oracle(self, at: At | Tensor, gradient: Tensor) -> Tensor:
        at = self.at(at)
        self._refuse_derivatives(at, "here")
        slope, finite = self._finite(gradient)
        size = slope.abs().amax(-1, keepdim=True)
        slope = torch.where(size > 0.0, slope / size, 0.0)

        def solve(sets: ScaledSets) -> Tensor:
            if sets.curved:
                return optimal_points(sets, slope, linear=True)[0]
            corner = sets.given_rows + torch.arange(self.dim, device=slope.device) + self.dim * (slope < 0.0)
            point, _ = maximize_on_rows(sets.rows, sets.bounds, slope, corner, sets.name, sets.given_rows)
            # The point may be outside the set by the linear program's rounding.
            return project_on_rows(sets.rows, sets.bounds, point, sets.name, sets.given_rows)[0]

        solution = self._solve(at, gradient.shape[:-1], solve)[1]
        return torch.where(finite, solution, torch.nan).view(gradient.shape).to(gradient.device)

    def _center(self, at: At | Tensor) -> Tensor:
        at = self.at(at)
        refuse_transforms(f"the centre of {type(self).__name__}")

        def solve(sets: ScaledSets) -> Tensor:
            if not sets.curved:
                return deep_points(sets)
            center, guess = interior_points(sets.detach()), guessed_points(sets)
            if not torch.equal(center, guess):
                self._refuse_derivatives(
                    at, "where the centre of its ellipse, or the origin, is not deep inside the set"
                )
                return center
            return guess

        return self._solve(at, at.lead, solve, interior=True)[1].view(*at.lead, self.dim).to(at.obs.device)

    def _solve(
        self, at: At, lead: tuple[int, ...], solve: Callable[[ScaledSets], Result], interior: bool = False
    ) -> tuple[ScaledSets, Result]:
        """The sets of a batch of shape `lead`, and the result of `solve` on them.

        With `on_empty="least"`, widened sets replace empty ones. `interior`: also widen sets without interior. With
        ellipses, this is always done.
        """
        try:
            sets = scale_sets(at.written, lead)
            return sets, solve(sets)
        except EmptySetError:
            if self.on_empty != "least":
                raise
        self._refuse_derivatives(at, "where the set is empty")
        sets = scale_sets(at.written, lead, check=False)
        sets = widened(sets, flat=interior or sets.curved)
        return sets, solve(sets)

    def _finite(self, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors (..., d) as a batch (n, d) on the CPU, 0 if not finite, and a mask (n, 1) of finite ones."""
        flat = vector.reshape(-1, self.dim).cpu()
        finite = flat.isfinite().all(-1, keepdim=True)
        return torch.where(finite, flat, 0.0), finite

    def _refuse_derivatives(self, at: At, where: str) -> None:
        if is_traced(*at):
            raise RuntimeError(
                f"{type(self).__name__} has no gradient with respect to the observation or to learned coefficients "
                f"{where}; pass obs.detach(), or coefficients without gradients"
            )


def check_obs(obs: Tensor) -> None:
    """Raise a ConstraintError for a NaN or infinite observation, a TypeError if it is not a tensor."""
    check_tensor("obs", obs)
    valid = obs.isfinite().all(-1)
    require(valid.flatten(), "the observation is NaN or infinite", name_samples(tuple(valid.shape)))
