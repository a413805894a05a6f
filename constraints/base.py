"""The interface of a feasible action set, and every mapping that follows from its gauge.

A feasible set is `A(obs)`, convex, inside the action box [-1, 1]^d. Tensors may have any leading dimensions; those of
`obs (..., n)` and `action (..., d)` broadcast against each other. Whatever the input's dtype, the mathematics is done
in float64 (joint velocities reach 1e6, and feasibility is held to 1e-6) and the result returned in the dtype of the
action: the cost at these sizes is the number of operations, not their width.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from constraints.density import refuse_second_derivatives
from constraints.ray import Ray, differentiable_gauge

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
    solved_on_cpu: bool = False
    """True where a solver on the CPU is asked, so that a GPU has to wait: no CUDA graph can hold such a set."""

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
        """Closest feasible point (..., d) and the product with the projection's Jacobian there.

        NaN where the action is NaN, at least in that coordinate: a broken policy must not become feasible unnoticed.
        """

    @abstractmethod
    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        """Gauge (...) of the whole set, box included, and its gradient (..., d) with respect to `direction`.

        The gradient is differentiable in `direction`, the gauge need not be. Both are 0 where `direction` is;
        `center` is None for the origin.
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
        with torch.no_grad():
            obs64, action64 = self._broadcast(obs, action)
            solution = self._project(obs64, action64)
        if torch.is_grad_enabled() and action.requires_grad:
            return _Projection.apply(action.expand(action64.shape), solution)
        return solution[0].to(action.dtype)

    def center(self, obs: Tensor) -> Tensor:
        """Interior point (..., d): Chebyshev centre of a linear set, an ellipse's centre otherwise, the origin where
        both are present (paper, "alpha-Projection Layer")."""
        if not obs.is_floating_point():
            raise TypeError(f"expected float32 or float64 observations, got {obs.dtype}")
        with torch.no_grad():
            center = self._center(obs.detach().double())
            return center.expand(*obs.shape[:-1], self.dim).to(obs.dtype)

    def gauge(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> Tensor:
        """Minkowski functional L (...) >= 0 around an interior `center` (None: the origin must be interior).

        `center + direction / L` is on the boundary; L is convex and positively homogeneous of degree 1.
        """
        obs64, direction64 = self._broadcast(obs, direction)
        center64 = None if center is None else center.detach().double()
        # L is homogeneous: scaled to length 1, squares of even the tiniest direction stay above zero.
        largest = direction64.detach().abs().amax(-1)
        size = torch.where(largest > 0.0, largest, 1.0)
        gauge, gradient = self._gauge_and_gradient(obs64, direction64.detach() / size.unsqueeze(-1), center64)
        return differentiable_gauge(direction64, gauge * size, gradient).to(direction.dtype)

    def ray(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Ray:
        """The ray from the centre through `action`: one evaluation of the gauge that serves a map and its density.

        Offsets are at most 1e150 long, as the squares of longer ones are infinite.
        """
        obs64, action64 = self._broadcast(obs, action)
        if center is None and not self.origin_centered:
            center = self.center(obs64)
        center64 = None if center is None else center.detach().double()
        offset = action64 if center64 is None else action64 - center64
        return Ray(action, center64, offset, *self._gauge_and_gradient(obs64, offset, center64))

    def alpha_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """alpha-projection: the feasible point (..., d) closest to `action` on its ray from the centre."""
        return self.ray(obs, action, center).alpha_map()

    def radial_map(self, obs: Tensor, action: Tensor, center: Tensor | None = None) -> Tensor:
        """Radial squashing c + tanh(L)/L (action - c) (..., d) (paper, Eq. radial squashing); smooth at c."""
        return self.ray(obs, action, center).radial_map()

    def radial_log_prob(self, obs: Tensor, action: Tensor, log_prob: Tensor, center: Tensor | None = None) -> Tensor:
        """Log-density (...) of `radial_map(obs, action)`, given the log-density `log_prob` (...) of `action`."""
        return self.ray(obs, action, center).radial_log_prob(log_prob)

    def alpha_log_prob(
        self, obs: Tensor, action: Tensor, mean: Tensor, std: Tensor, center: Tensor | None = None
    ) -> Tensor:
        """Log-density (...) of `alpha_map(obs, action)` for `action` ~ N(mean, diag std^2).

        Source: paper, "alpha-projection with SAC", with the solid angle of dimension d.

        With respect to volume where `action` is feasible, to the boundary's surface measure where it is not.
        """
        return self.ray(obs, action, center).alpha_log_prob(mean, std)

    def linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        """argmax (..., d) over the set of <c, gradient> (NFWPO's Frank-Wolfe step, paper Eq. Frank-Wolfe direction)."""
        with torch.no_grad():
            obs64, gradient64 = self._broadcast(obs, gradient)
            # Only the direction matters: at length 1 the squares of tiny gradients stay above zero.
            largest = gradient64.abs().amax(-1, keepdim=True)
            gradient64 = gradient64 / torch.where(largest > 0.0, largest, 1.0)
            return keep_nan(self._linear_oracle(obs64, gradient64), gradient64).to(gradient.dtype)

    # ---------------------------------------------------------------- shared pieces

    def _broadcast(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        if action.shape[-1] != self.dim:
            raise ValueError(f"expected {self.dim} action coordinates, got {action.shape[-1]}")
        if not action.is_floating_point():
            raise TypeError(f"expected float32 or float64 actions, got {action.dtype}")
        obs, action = obs.detach().double(), action.double()
        if obs.shape[:-1] != action.shape[:-1]:
            action = action.expand(*torch.broadcast_shapes(obs.shape[:-1], action.shape[:-1]), self.dim)
        return obs, action


def box_gauge_gradient(direction: Tensor, center: Tensor | None) -> Tensor:
    """Gradient (..., d) of the box's gauge: the row of the face that the ray meets first."""
    direction = direction.detach()
    sign = direction.sign()
    slope = sign if center is None else sign / (1.0 - sign * center)
    first = (slope * direction).argmax(-1, keepdim=True)
    return torch.zeros_like(slope).scatter(-1, first, slope.gather(-1, first))


def largest_gauge(direction: Tensor, *gradients: Tensor) -> tuple[Tensor, Tensor]:
    """Gauge (...) and gradient (..., d) of an intersection, from the gradients of the gauges of its parts.

    A gauge is homogeneous, so its value is <gradient, direction> (Euler).
    """
    direction, gradient = direction.detach(), gradients[0]
    gauge = (gradient.detach() * direction).sum(-1)
    for other in gradients[1:]:
        value = (other.detach() * direction).sum(-1)
        gradient = torch.where((value > gauge).unsqueeze(-1), other, gradient)
        gauge = torch.maximum(gauge, value)
    return gauge, gradient


def deflated_jacobian(curvature: Tensor, *normals: Tensor) -> JacobianProduct:
    """Jacobian product of a projection by implicit differentiation of its KKT conditions.

    curvature (..., d): diagonal inverse Hessian of the Lagrangian, 0 (or False) on coordinates that are held fixed.
    normals (..., d): gradient of each active constraint, 0 where it is inactive. Each takes the direction it blocks
    out of J: J <- J - (J n)(J n)' / (n' J n).
    """

    def product(vector: Tensor) -> Tensor:
        out = curvature * vector
        removed: list[tuple[Tensor, Tensor]] = []
        for normal in normals:
            column = curvature * normal
            pivot = (normal * column).sum(-1, keepdim=True)
            if removed:
                own = pivot
                for other, other_pivot in removed:
                    column = column - other * ((other * normal).sum(-1, keepdim=True) / other_pivot)
                pivot = (normal * column).sum(-1, keepdim=True)
                # No freedom left along this normal, which those before it span: nothing to remove.
                column = column * (pivot > 1e-12 * own)
            pivot = pivot.clamp(min=1e-300)  # 0 where the normal is inactive, and then so is the column
            out = out - column * ((normal * out).sum(-1, keepdim=True) / pivot)
            removed.append((column, pivot))
        return out

    return product


class _Projection(torch.autograd.Function):
    """Gives a projection, solved outside autograd, its exact (symmetric) Jacobian."""

    @staticmethod
    def forward(ctx, action: Tensor, solution: tuple[Tensor, JacobianProduct]) -> Tensor:
        projected, ctx.jacobian_product = solution
        return projected.to(action.dtype)

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        return ctx.jacobian_product(grad.double()).to(grad.dtype), None


def keep_nan(solution: Tensor, source: Tensor) -> Tensor:
    """The solution (..., d), all NaN where the source (..., d) has one."""
    return torch.where(source.isnan().any(-1, keepdim=True), torch.nan, solution)


def safe_sqrt(square: Tensor) -> Tensor:
    """sqrt with gradient 0 at 0."""
    positive = square > 0.0
    return torch.where(positive, torch.where(positive, square, 1.0).sqrt(), square)
