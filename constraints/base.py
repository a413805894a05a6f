"""The interface of a feasible action set, and every mapping that follows from its gauge.

A feasible set is `A(obs)`, convex, inside the action box [-1, 1]^d. Tensors may have any leading dimensions; those of
`obs (..., n)` and `action (..., d)` broadcast against each other. Whatever the input's dtype, the mathematics is done
in float64 (joint velocities reach 1e6, and feasibility is held to 1e-6) and the result returned in the dtype of the
action: the cost at these sizes is the number of operations, not their width.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from constraints.density import alpha_boundary_log_density, radial_log_det

Coefficients = Callable[[Tensor], Tensor]
"""Maps observations (..., n) to a constraint's state-dependent coefficients (..., d) or (..., d, d)."""

JacobianProduct = Callable[[Tensor], Tensor]
"""Multiplies the symmetric Jacobian of a projection with a vector (..., d)."""

ExplicitSet = tuple[Tensor, Tensor, list[tuple[Tensor, Tensor, Tensor | float]]]
"""Rows A (..., m, d), bounds b (..., m) and ellipses (Q (..., d, d), c (..., d), bound (...)): A a <= b and
(a - c)' Q (a - c) <= bound, the box left out."""


class Constraint(ABC):
    """A feasible set A(obs) inside the box [-1, 1]^dim.

    A subclass implements the protected methods. They receive float64 tensors, `action` (or `direction`, `gradient`)
    already expanded to the common leading shape, and `_project`, `_center` and `_linear_oracle` run without autograd.
    """

    origin_centered: bool = True
    """True where `center(obs)` is the origin for every obs, so that no centre needs to be stored."""

    def __init__(self, dim: int):
        if dim < 1:
            raise ValueError(f"dim must be at least 1, got {dim}")
        self.dim = dim

    # ---------------------------------------------------------------- what a subclass gives

    @abstractmethod
    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        """Excess (...) over the constraint, the box left out."""

    @abstractmethod
    def _penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        """The paper's penalty (...), with finite gradients everywhere."""

    @abstractmethod
    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        """Closest feasible point (..., d) and the product with the projection's Jacobian there."""

    @abstractmethod
    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        """Gauge (...) of the whole set, box included, and its gradient (..., d) with respect to `direction`.

        Both are differentiable in `direction`, finite also at 0, where they are 0. `direction` has largest entry 1
        unless it is 0; `center` is None for the origin.
        """

    @abstractmethod
    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        """Feasible point (..., d) with the largest inner product with `gradient`."""

    def _center(self, obs: Tensor) -> Tensor:
        """Interior point (..., d) or one (d,) for every obs."""
        return obs.new_zeros(self.dim)

    def explicit(self, obs: Tensor) -> ExplicitSet:
        """The set written out in rows and ellipses, as a part of an `Intersection` must be."""
        raise TypeError(f"{type(self).__name__} does not write out its rows and ellipses")

    # ---------------------------------------------------------------- the interface

    def violation(self, obs: Tensor, action: Tensor) -> Tensor:
        """Largest excess (...) over any constraint, box included; feasible where <= 0.

        In the penalty's units: linear rows have unit norm (a zero row counts as it stands), an ellipse counts
        sqrt(a'Qa) - sqrt(b) with Q and b scaled so that tr Q = dim.
        """
        obs64, action64 = self._broadcast(obs, action)
        box = action64.abs().amax(-1) - 1.0
        return torch.maximum(box, self._violation(obs64, action64)).to(action.dtype)

    def penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        """Penalty (...) of the '+' algorithms on a box action (paper, "Algorithms"): the norm of max(Ax - b, 0) with
        unit rows, max(sqrt(x'Qx) - sqrt(b), 0) with tr Q = dim, and the sum where both are present."""
        obs64, action64 = self._broadcast(obs, action)
        return self._penalty(obs64, action64).to(action.dtype)

    def project(self, obs: Tensor, action: Tensor) -> Tensor:
        """Closest feasible point (..., d) in the Euclidean norm, with its exact Jacobian in `action`."""
        obs64, action64 = self._broadcast(obs, action.detach())
        with torch.no_grad():
            projected, jacobian_product = self._project(obs64, action64)
            solution = _keep_nan(projected, action64), jacobian_product
        if torch.is_grad_enabled() and action.requires_grad:
            return _Projection.apply(action.expand(action64.shape), solution)
        return solution[0].to(action.dtype)

    def center(self, obs: Tensor) -> Tensor:
        """Interior point (..., d): Chebyshev centre of a linear set, an ellipse's centre otherwise, the origin where
        both are present (paper, "alpha-Projection Layer")."""
        with torch.no_grad():
            center = self._center(obs.detach().double())
            return center.expand(*obs.shape[:-1], self.dim).to(obs.dtype)

    def gauge(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> Tensor:
        """Minkowski functional L (...) >= 0 around an interior `center` (None: the origin must be interior).

        `center + direction / L` is on the boundary; L is convex and positively homogeneous of degree 1.
        """
        obs64, direction64 = self._broadcast(obs, direction)
        center64 = None if center is None else center.detach().double()
        return self._gauge64(obs64, direction64, center64)[0].to(direction.dtype)

    def alpha_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """alpha-projection: the feasible point (..., d) closest to `action` on its ray from the centre."""
        offset, center64, gauge, _ = self._ray(obs, action, center)
        mapped = offset / gauge.clamp(min=1.0).unsqueeze(-1)
        return (mapped if center64 is None else center64 + mapped).to(action.dtype)

    def radial_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """Radial squashing c + tanh(L)/L (action - c) (..., d) (paper, Eq. radial squashing); smooth at c."""
        offset, center64, gauge, _ = self._ray(obs, action, center)
        # Below 1e-3 the series is exact to rounding, and division by zero is avoided at the centre.
        near = gauge < 1e-3
        safe = torch.where(near, 1.0, gauge)
        factor = torch.where(near, 1.0 - gauge**2 / 3.0 + 2.0 / 15.0 * gauge**4, torch.tanh(safe) / safe)
        mapped = factor.unsqueeze(-1) * offset
        return (mapped if center64 is None else center64 + mapped).to(action.dtype)

    def radial_log_prob(self, obs: Tensor, action: Tensor, log_prob: Tensor, center: Tensor | None = None) -> Tensor:
        """Log-density (...) of `radial_map(obs, action)`, given the log-density `log_prob` (...) of `action`."""
        gauge = self._ray(obs, action, center)[2]
        return (log_prob.double() - radial_log_det(gauge, self.dim)).to(log_prob.dtype)

    def alpha_log_prob(
        self, obs: Tensor, action: Tensor, mean: Tensor, std: Tensor, center: Tensor | None = None
    ) -> Tensor:
        """Log-density (...) of `alpha_map(obs, action)` for `action` ~ N(mean, diag std^2).

        Source: paper, "alpha-projection with SAC", with the solid angle of dimension d.

        With respect to volume where `action` is feasible, to the boundary's surface measure where it is not.
        """
        offset, center64, gauge, gradient = self._ray(obs, action, center)
        mean, std = mean.double(), std.double()
        residual = (action.double() - mean) / std
        interior = -(0.5 * residual**2 + std.log()).sum(-1) - 0.5 * self.dim * math.log(2.0 * math.pi)
        inside = gauge <= 1.0
        # Harmless stand-ins inside keep the unused branch, and so its gradient, finite.
        spread = inside.unsqueeze(-1)
        to_boundary = torch.where(spread, 1.0, offset / torch.where(inside, 1.0, gauge).unsqueeze(-1))
        origin = torch.zeros_like(offset) if center64 is None else center64.expand_as(offset)
        boundary = alpha_boundary_log_density(
            to_boundary,
            torch.where(spread, 1.0, gradient),
            origin,
            mean.expand_as(offset),
            std.expand_as(offset),
        )
        return torch.where(inside, interior, boundary).to(action.dtype)

    def linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        """argmax (..., d) over the set of <c, gradient> (NFWPO's Frank-Wolfe step, paper Eq. Frank-Wolfe direction)."""
        obs64, gradient64 = self._broadcast(obs, gradient.detach())
        with torch.no_grad():
            # Only the direction matters: at length 1 the squares of tiny gradients stay above zero.
            largest = gradient64.abs().amax(-1, keepdim=True)
            gradient64 = gradient64 / torch.where(largest > 0.0, largest, 1.0)
            return _keep_nan(self._linear_oracle(obs64, gradient64), gradient64).to(gradient.dtype)

    # ---------------------------------------------------------------- shared pieces

    def _broadcast(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        if action.shape[-1] != self.dim:
            raise ValueError(f"expected {self.dim} action coordinates, got {action.shape[-1]}")
        lead = torch.broadcast_shapes(obs.shape[:-1], action.shape[:-1])
        return obs.detach().double(), action.double().expand(*lead, self.dim)

    def _gauge64(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        # L is homogeneous: scaling the direction first keeps squares and products in range at any length.
        largest = direction.detach().abs().amax(-1)
        scale = torch.where(largest > 0.0, largest, 1.0)
        gauge, gradient = self._gauge_and_gradient(obs, direction / scale.unsqueeze(-1), center)
        return gauge * scale, gradient

    def _ray(self, obs: Tensor, action: Tensor, center: Tensor | None):
        """(action - center, center or None for the origin, gauge of the offset, the gauge's gradient)."""
        obs64, action64 = self._broadcast(obs, action)
        if center is None and not self.origin_centered:
            center = self.center(obs64)
        center64 = None if center is None else center.detach().double()
        offset = action64 if center64 is None else action64 - center64
        gauge, gradient = self._gauge64(obs64, offset, center64)
        return offset, center64, gauge, gradient

    def _pull_in(self, obs: Tensor, action: Tensor) -> Tensor:
        """Removes a rounding excess by moving towards the origin, which must be interior."""
        return action / self._gauge64(obs, action, None)[0].clamp(min=1.0).unsqueeze(-1)


def box_gauge_gradient(direction: Tensor, center: Tensor | None) -> Tensor:
    """Gradient (..., d) of the box's gauge: the row of the face that the ray meets first."""
    sign = direction.detach().sign()
    slope = sign if center is None else sign / (1.0 - sign * center)
    first = (slope * direction.detach()).argmax(-1, keepdim=True)
    return torch.zeros_like(slope).scatter(-1, first, slope.gather(-1, first))


def largest_gauge(direction: Tensor, *gradients: Tensor) -> tuple[Tensor, Tensor]:
    """Gauge (...) and gradient (..., d) of an intersection, from the gradients of the gauges of its parts.

    A gauge is homogeneous, so its value is <gradient, direction> (Euler).
    """
    gradient = gradients[0]
    gauge = (gradient * direction).sum(-1)
    for other in gradients[1:]:
        value = (other * direction).sum(-1)
        larger = value > gauge
        gauge = torch.where(larger, value, gauge)
        gradient = torch.where(larger.unsqueeze(-1), other, gradient)
    return gauge, gradient


def deflated_jacobian(curvature: Tensor, *normals: Tensor) -> JacobianProduct:
    """Jacobian product of a projection by implicit differentiation of its KKT conditions.

    curvature (..., d): diagonal inverse Hessian of the Lagrangian, 0 on coordinates that are held fixed.
    normals (..., d): gradient of each active constraint, 0 where it is inactive. Each takes the direction it blocks
    out of J: J <- J - (J n)(J n)' / (n' J n).
    """

    def product(vector: Tensor) -> Tensor:
        removed: list[tuple[Tensor, Tensor]] = []

        def apply(v: Tensor) -> Tensor:
            out = curvature * v
            for column, pivot in removed:
                out = out - column * ((column * v).sum(-1, keepdim=True) / pivot)
            return out

        for normal in normals:
            column = apply(normal)
            pivot = (normal * column).sum(-1, keepdim=True)
            # No freedom left along this normal (it is inactive, or spanned by those before it): nothing to remove.
            blocked = pivot > 1e-12 * (normal * curvature * normal).sum(-1, keepdim=True)
            removed.append((torch.where(blocked, column, 0.0), torch.where(blocked, pivot, 1.0)))
        return apply(vector)

    return product


class _Projection(torch.autograd.Function):
    """Gives a projection, solved outside autograd, its exact (symmetric) Jacobian."""

    @staticmethod
    def forward(ctx, action: Tensor, solution: tuple[Tensor, JacobianProduct]) -> Tensor:
        projected, ctx.jacobian_product = solution
        return projected.to(action.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor):
        return ctx.jacobian_product(grad.double()).to(grad.dtype), None


def _keep_nan(solution: Tensor, source: Tensor) -> Tensor:
    """NaN wherever the source has one: a broken policy must not turn into a feasible action unnoticed."""
    return torch.where(source.isnan().any(-1, keepdim=True), torch.nan, solution)


def safe_sqrt(square: Tensor) -> Tensor:
    """sqrt with gradient 0 at 0."""
    positive = square > 0.0
    return torch.where(positive, torch.where(positive, square, 1.0).sqrt(), square)
