"""The interface of a feasible action set.

A feasible set is `A(obs)`, convex, inside the action box [-1, 1]^d. Tensors may have any leading dimensions; those of
`obs (..., n)` and `action (..., d)` broadcast against each other. Inputs are float32 or float64 and results have the
dtype of the action. The mathematics is float64 throughout: joint velocities reach 1e6, and feasibility holds to 1e-6.
That costs little, because the time depends on the number of operations and not on their precision.

Gradients with respect to the action are closed forms. Gradients with respect to the observation, a centre and the
parameters of learned coefficients exist as well. They cost more time and are computed only if one of these tensors
requires gradients. Pass `obs.detach()` to avoid them.
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from constraints.checks import ON_BOUNDARY, ROUNDING, check_observation, check_precision, check_tensor
from constraints.coefficients import FirstCalls
from constraints.errors import name_samples, require
from constraints.gauge import box_gauge_gradient, largest_gauge
from constraints.implicit import Boundary, Solver, differentiable_projection, tensors_of
from constraints.jacobian import JacobianProduct, with_jacobian
from constraints.numerics import is_traced, keep_nan, one_where_zero, refuse_transforms, with_gradient
from constraints.ray import Ray
from constraints.sample import hit_and_run

OnEmpty = Literal["error", "least"]

AT_FACE = 1.0 - 1e-9
"""The box holds a coordinate of a projection from this absolute value on: rounding may have moved it off the face."""

_DERIVED = (
    *("center", "gauge", "ray", "alpha_map", "radial_map", "gauge_map"),
    *("radial_log_prob", "gauge_log_prob", "alpha_log_prob"),
)
"""Methods that a subclass must not override. Maps and densities call each other's parts, so some calls would bypass the
override: an actor would train with one centre and be evaluated with another."""


class Ellipse(NamedTuple):
    """(a - center)' matrix (a - center) <= bound."""

    matrix: Tensor  # (..., d, d)
    center: Tensor  # (..., d)
    bound: Tensor | float  # (...)


class ExplicitSet(NamedTuple):
    """The inequalities of a set: rows @ a <= bounds, and ellipses. The box is not included."""

    rows: Tensor  # (..., m, d)
    bounds: Tensor  # (..., m)
    ellipses: list[Ellipse]


class Constraint(ABC):
    """A feasible set A(obs) inside the box [-1, 1]^dim. ValueError for dim < 1, TypeError if it is not an integer.

    A subclass implements the protected methods. They receive float64 tensors; `action` (or `direction`, `gradient`) has
    the common leading shape already. `at` is what `_at(obs)` returned: the observation, unless `_at` is overridden.
    """

    origin_centered: bool = True
    """True if `center(obs)` is the origin for every obs. No centre needs to be stored then."""
    on_empty: OnEmpty = "error"
    """What happens if no action satisfies the constraint, "error" or "least"; see `GeneralConstraint`."""
    solved_on_cpu: bool = False
    """True if a solver runs on the CPU. A GPU has to wait for it, and a CUDA graph cannot contain it."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Raise TypeError for an override of a method in `_DERIVED`."""
        super().__init_subclass__(**kwargs)
        if wrong := [name for name in _DERIVED if getattr(cls, name) is not getattr(Constraint, name)]:
            raise TypeError(
                f"{cls.__name__} overrides {', '.join(wrong)}, but some calls would bypass that: override _center or"
                " _gauge_gradients (general sets: _part_gauges; an ellipse's centre: c), or write a map (core/maps.py)"
            )

    def __init__(self, dim: int):
        if dim < 1:
            raise ValueError(f"dim must be at least 1, got {dim}")
        self.dim = operator.index(dim)
        self._center_calls = FirstCalls()

    # ---------------------------------------------------------------- what a subclass implements

    def _at(self, obs: Tensor) -> Any:
        """The coefficients at `obs` (..., n), for the other protected methods, or the observation itself.

        Coefficients are a NamedTuple of float64 tensors (..., k) and numbers.
        """
        return obs

    @abstractmethod
    def _violation(self, at: Any, action: Tensor) -> Tensor:
        """Excess (...) over the constraint, without the box."""

    @abstractmethod
    def _project(self, at: Any, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        """Closest feasible point (..., d) and the product with the projection's Jacobian there.

        A NaN in the action must give a NaN in the point, at least in that coordinate. Otherwise a broken policy would
        become feasible unnoticed.
        """

    def _boundaries(self, at: Any, point: Tensor) -> list[Boundary]:
        """The surfaces, without those of the box, that can be active at the projection `point` (..., d).

        Gradients of projections with respect to the observation or the coefficients need them. RuntimeError if the set
        does not define them.
        """
        raise RuntimeError(
            f"projections of {type(self).__name__} have no gradient with respect to the observation or to learned"
            " coefficients; pass obs.detach(), or coefficients without gradients"
        )

    def _free(self, point: Tensor) -> Tensor:
        """Mask (..., d) of the coordinates of `point` that neither the box nor a kink of the set holds."""
        return point.abs() < AT_FACE

    @abstractmethod
    def _gauge_gradients(self, at: Any, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        """Gradients (..., d) of the gauges of the set's parts with respect to `direction`, without the box.

        They are differentiable in `direction`, the centre and the coefficients, and 0 where `direction` is 0. `center`
        is None for the origin.
        """

    @abstractmethod
    def _linear_oracle(self, at: Any, gradient: Tensor) -> Tensor:
        """Feasible point (..., d) with the largest inner product with `gradient`."""

    def _penalty(self, at: Any, action: Tensor) -> Tensor:
        """The paper's penalty (...), with finite gradients everywhere. A set with several rows overrides this."""
        return self._violation(at, action).clamp(min=0.0)

    def _center(self, at: Any) -> Tensor:
        """Interior point (..., d), or (d,) if it is the same for every obs. Unused if `origin_centered`."""
        raise NotImplementedError(f"{type(self).__name__} must define _center, or set origin_centered = True")

    def _sample(self, obs: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        """Points (..., count, d), uniform in the set. A set with a closed form overrides this."""
        repeated = obs.unsqueeze(-2)
        return hit_and_run(
            lambda direction, point: self.gauge(repeated, direction, point),
            lambda gradient: self.linear_oracle(obs, gradient),
            self.center(obs),
            count,
            generator,
        )

    def explicit(self, obs: Tensor) -> ExplicitSet:
        """The set's rows and ellipses at obs (..., n). TypeError by default; a part of an `Intersection` needs it."""
        raise TypeError(f"{type(self).__name__} does not define explicit(), which returns its rows and ellipses")

    # ---------------------------------------------------------------- the interface

    def violation(self, obs: Tensor, action: Tensor) -> Tensor:
        """Largest excess (...) over any constraint, box included; the action is feasible where it is <= 0.

        In the penalty's units: linear rows are scaled to unit norm (a zero row is not scaled); an ellipse counts
        sqrt(a'Qa) - sqrt(b), with Q and b scaled so that tr Q = dim.
        """
        obs64, action64 = self._broadcast(obs, action)
        box = action64.abs().amax(-1) - 1.0
        return torch.maximum(box, self._violation(self._at(obs64), action64)).to(action.dtype)

    def contains(self, obs: Tensor, action: Tensor, tolerance: float = 1e-6) -> Tensor:
        """Whether (...) the action is feasible up to `tolerance`, in the units of `violation`; False for a NaN."""
        return self.violation(obs, action) <= tolerance

    def penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        """Penalty (...) of the '+' algorithms on an action in the box (paper, "Algorithms").

        For rows, it is the norm of max(Ax - b, 0) after scaling the rows to unit norm. For an ellipse, it is
        max(sqrt(x'Qx) - sqrt(b), 0) after scaling Q and b so that tr Q = dim. For both, it is the sum.
        """
        obs64, action64 = self._broadcast(obs, action)
        return self._penalty(self._at(obs64), action64).to(action.dtype)

    def features(self, obs: Tensor) -> Tensor:
        """The numbers (..., k), float64, that determine the set at obs (..., n).

        They are those of its coefficients that depend on obs. If the set has no coefficients (`_at` is not overridden),
        they are the observation.
        """
        check_observation(obs)
        # The observations get three extra leading axes, and so do coefficients that depend on them. Constants have at
        # most two axes in all, so the number of axes tells them apart.
        obs64, lead = obs.double(), obs.shape[:-1]
        values = [value for value in tensors_of(self._at(obs64[None, None, None])) if value.dim() >= 3 + len(lead)]
        rows = [value.reshape(*lead, value.shape[3 + len(lead) :].numel()) for value in values]
        return torch.cat([obs64[..., :0], *rows], -1)

    def project(self, obs: Tensor, action: Tensor) -> Tensor:
        """Closest feasible point (..., d) in the Euclidean norm, with its exact Jacobian in `action`."""
        obs64, action64 = self._broadcast(obs, action)
        at = self._at(obs64)
        if is_traced(*tensors_of(at)):
            return self._differentiable_projection(at, action64).to(action.dtype)
        projected, jacobian = self._project(at, action64.detach())
        if projected.requires_grad:
            self._boundaries(at, projected)
        if torch.is_grad_enabled() and action.requires_grad:
            return with_jacobian(action.expand(action64.shape), projected, jacobian)
        return projected.to(action.dtype)

    def least_violation(self, obs: Tensor) -> Tensor:
        """Smallest violation (...) of all actions in the box at obs (..., n); 0 if the set is not empty."""
        check_observation(obs)
        return obs.new_zeros(obs.shape[:-1])  # closed forms contain the origin

    def center(self, obs: Tensor) -> Tensor:
        """Interior point (..., d) of the set, in the dtype of `obs` (paper, "alpha-Projection Layer").

        It is the Chebyshev centre of a linear set, the centre of an ellipse, and the origin if both are present. The
        docstrings of the general sets, such as `LinearConstraint`, define their centres.
        """
        check_observation(obs)
        if self.origin_centered:
            return obs.new_zeros(*obs.shape[:-1], self.dim)
        center = self._center(self._at(obs.double()))
        return center.expand(*obs.shape[:-1], self.dim).to(obs.dtype)

    def gauge(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> Tensor:
        """Minkowski functional L (...) >= 0 around an interior `center` (None: the origin must be interior).

        `center + direction / L` is on the boundary; L is convex and positively homogeneous of degree 1.
        """
        obs64, direction64 = self._broadcast(obs, direction)
        at = self._at(obs64)
        center64 = None if center is None else self._given_center(at, center)
        # L is homogeneous. At length 1, the squares of even the tiniest direction stay above zero.
        size = one_where_zero(direction64.detach().abs().amax(-1))
        if is_traced(center64, *tensors_of(at)):
            unit = direction64 / size.unsqueeze(-1)
            gradient = self._gauge_and_gradient(at, unit, center64)[1]
            return ((gradient * unit).sum(-1) * size).to(direction.dtype)
        gauge, gradient = self._gauge_and_gradient(at, direction64.detach() / size.unsqueeze(-1), center64)
        return with_gradient(direction64, gauge * size, gradient).to(direction.dtype)

    def ray(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Ray:
        """The ray from the centre that maps `action`: one evaluation of the gauge serves a map and its density.

        Offsets must be at most 1e150 long, because squares of longer ones overflow.
        """
        obs64, action64 = self._broadcast(obs, action)
        at = self._at(obs64)
        if center is None:
            center64 = None if self.origin_centered else self._center(at)
        else:
            center64 = self._given_center(at, center)
        offset = action64 if center64 is None else action64 - center64
        traced = is_traced(center64, *tensors_of(at))
        return Ray(
            action, center64, offset, lambda direction: self._gauge_and_gradient(at, direction, center64), traced
        )

    def alpha_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """alpha-projection: the feasible point (..., d) closest to `action` on its ray from the centre."""
        return self.ray(obs, action, center).alpha_map()

    def radial_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """Radial squashing c + tanh(L)/L (action - c) (..., d) (paper, Eq. radial squashing); smooth at c."""
        return self.ray(obs, action, center).radial_map()

    def gauge_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """Gauge map c + max_i |u_i| / L(u) u (..., d) of u = `action` in the box (Tabas and Zhang 2022).

        It stretches the box around 0 to the set around c, ray by ray: 0 goes to c and the box's boundary to the set's.
        """
        return self.ray(obs, action, center).gauge_map()

    def radial_log_prob(self, obs: Tensor, action: Tensor, log_prob: Tensor, center: Tensor | None = None) -> Tensor:
        """Log-density (...) of `radial_map(obs, action)`, given the log-density `log_prob` (...) of `action`."""
        check_tensor("log_prob", log_prob)
        return self.ray(obs, action, center).radial_log_prob(log_prob)

    def gauge_log_prob(self, obs: Tensor, action: Tensor, log_prob: Tensor, center: Tensor | None = None) -> Tensor:
        """Log-density (...) of `gauge_map(obs, action)`, given the log-density `log_prob` (...) of `action`."""
        check_tensor("log_prob", log_prob)
        return self.ray(obs, action, center).gauge_log_prob(log_prob)

    def alpha_log_prob(
        self, obs: Tensor, action: Tensor, mean: Tensor, std: Tensor, center: Tensor | None = None
    ) -> Tensor:
        """Log-density (...) of `alpha_map(obs, action)` for `action` ~ N(mean, diag std^2).

        The density is with respect to volume where `action` is feasible, and to the boundary's surface measure
        elsewhere.
        Source: paper, "alpha-projection with SAC", with the solid angle of dimension d.
        """
        check_tensor("mean", mean)
        check_tensor("std", std)
        return self.ray(obs, action, center).alpha_log_prob(mean, std)

    def linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        """argmax (..., d) over the set of <c, gradient> (NFWPO's Frank-Wolfe step, paper Eq. Frank-Wolfe direction).

        The result has no gradients. RuntimeError if the observation or learned coefficients require them.
        """
        check_tensor("gradient", gradient)
        refuse_transforms("linear_oracle")
        obs64, gradient64 = self._broadcast(obs, gradient.detach())
        at = self._at(obs64)
        if torch.is_grad_enabled() and any(value.requires_grad for value in tensors_of(at)):
            raise RuntimeError("linear_oracle has no derivatives; pass obs.detach(), or coefficients without gradients")
        # Only the direction matters. At length 1, the squares of tiny gradients stay above zero.
        gradient64 = gradient64 / one_where_zero(gradient64.abs().amax(-1, keepdim=True))
        return keep_nan(self._linear_oracle(at, gradient64), gradient64).to(gradient.dtype)

    def sample(self, obs: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Feasible points (..., count, d), uniform in each set A(obs), in the dtype of `obs`.

        Random numbers come from `generator` (default: PyTorch's). A set without a closed form takes 4 d (d + 4) steps
        with two gauges each, which is slow for d >= 30. ValueError for count < 1.
        """
        refuse_transforms("sample")
        if operator.index(count) < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        check_observation(obs)
        with torch.no_grad():
            return self._sample(obs.detach().double(), count, generator).to(obs.dtype)

    # ---------------------------------------------------------------- shared pieces

    def _differentiable_projection(self, at: Any, action: Tensor) -> Tensor:
        """The projection (..., d) with gradients with respect to the action and the tensors in `at`."""
        return differentiable_projection(Solver(self._project, self._boundaries, self._free), at, action)

    def _gauge_and_gradient(self, at: Any, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        """Gauge (...) of the whole set, box included, and its gradient (..., d), both 0 where `direction` is.

        The gradient is differentiable as `_gauge_gradients` says, the gauge is not.
        """
        box = box_gauge_gradient(direction, center)
        return largest_gauge(direction, box, *self._gauge_gradients(at, direction, center))

    def _given_center(self, at: Any, center: Tensor) -> Tensor:
        """The caller's centre (..., d) in float64. ValueError for a wrong shape; `_check_center` checks the values."""
        check_tensor("center", center)
        if center.shape[-1:] != (self.dim,):
            raise ValueError(f"expected {self.dim} coordinates of the centre, got shape {tuple(center.shape)}")
        center = center.double()
        if self._center_calls.wanted():
            self._check_center(at, center)
        return center

    @torch.no_grad()
    def _check_center(self, at: Any, center: Tensor) -> None:
        """Raise a ConstraintError for a centre that is not inside the set; a NaN is passed on."""
        if self._center_calls.readable(center):
            outside = torch.maximum(center.abs().amax(-1) - 1.0, self._violation(at, center)) >= -ON_BOUNDARY
            if outside.any():  # a set may be thinner than that; its own centre is valid all the same
                own = torch.zeros_like(center) if self.origin_centered else self._center(at)
                outside = outside & ((center - own).abs().amax(-1) > ROUNDING)
            require(~outside.flatten(), "the centre is not inside the set", name_samples(outside.shape))

    def _broadcast(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Both in float64, the action with the common leading shape. ValueError or TypeError for a wrong action."""
        check_tensor("obs", obs)
        check_tensor("action", action)
        if action.shape[-1:] != (self.dim,):
            raise ValueError(f"expected {self.dim} action coordinates, got shape {tuple(action.shape)}")
        check_precision("actions", action)
        obs, action = obs.double(), action.double()
        if obs.shape[:-1] != action.shape[:-1]:
            try:
                lead = torch.broadcast_shapes(obs.shape[:-1], action.shape[:-1])
            except RuntimeError:
                shapes = f"{tuple(obs.shape)} and {tuple(action.shape)}"
                raise ValueError(f"leading shapes of obs and action do not broadcast: {shapes}") from None
            action = action.expand(*lead, self.dim)
        return obs, action
