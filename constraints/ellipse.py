"""Ellipses around the origin, cut by the box: diagonal in any dimension (R+L2) and general in two (R+T)."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.base import (
    Coefficients,
    Constraint,
    ExplicitSet,
    JacobianProduct,
    box_gauge_gradient,
    deflated_jacobian,
    largest_gauge,
    safe_sqrt,
)
from constraints.separable import minimize_under_ellipse


class DiagonalEllipse(Constraint):
    """sum s_i a_i^2 <= bound in the box, s = scale(obs) >= 0; some or all s_i may be 0 (R+L2: s = 1)."""

    def __init__(self, scale: Coefficients, bound: float, dim: int):
        super().__init__(dim)
        _check_bound(bound)
        self.scale = scale
        self.bound = bound

    def explicit(self, obs: Tensor) -> ExplicitSet:
        ellipse = torch.diag_embed(self.scale(obs)), obs.new_zeros(self.dim), self.bound
        return obs.new_zeros(0, self.dim), obs.new_zeros(0), [ellipse]

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        scale = self.scale(obs)
        return ellipse_excess((scale * action**2).sum(-1), scale.sum(-1), self.bound, self.dim)

    def _penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        return self._violation(obs, action).clamp(min=0.0)

    def _solve(self, obs: Tensor, target: Tensor, shift: float) -> tuple[Tensor, Tensor]:
        def clipped(metric: Tensor) -> tuple[Tensor, Tensor, None]:
            solution = (target / metric.clamp(min=1e-300)).clamp(-1.0, 1.0)
            return solution, solution.abs() < 1.0, None

        return minimize_under_ellipse(clipped, target, shift, self.scale(obs), self.bound)

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        solution, mu = self._solve(obs, action, 1.0)
        curvature = (solution.abs() < 1.0) / (1.0 + mu * self.scale(obs))
        return self._pull_in(obs, solution), deflated_jacobian(curvature, self.normal(obs, solution, mu))

    def normal(self, obs: Tensor, solution: Tensor, mu: Tensor) -> Tensor:
        """Normal (..., d) of the ellipse where its multiplier says that it is active, 0 elsewhere."""
        return torch.where(mu > 0.0, self.scale(obs) * solution, 0.0)

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        return self._pull_in(obs, self._solve(obs, gradient, 0.0)[0])

    def gauge_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> Tensor:
        """Gradient (..., d) of the gauge of the ellipse, the box left out."""
        scale = self.scale(obs)
        bent = None if center is None else scale * center
        return ellipse_gauge_gradient(direction, scale * direction, center, bent, self.bound)

    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        return largest_gauge(
            direction, box_gauge_gradient(direction, center), self.gauge_gradient(obs, direction, center)
        )


class PlanarEllipse(Constraint):
    """a'Qa <= bound in the box, Q = matrix(obs) (..., 2, 2) positive semi-definite; a slab where Q is singular (R+T).

    Projection and oracle are exact by cases: the box alone, the ellipse alone, or one of the box's four faces.
    """

    def __init__(self, matrix: Coefficients, bound: float):
        super().__init__(2)
        _check_bound(bound)
        self.matrix = matrix
        self.bound = bound

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return obs.new_zeros(0, 2), obs.new_zeros(0), [(self.matrix(obs), obs.new_zeros(2), self.bound)]

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        matrix = self.matrix(obs)
        value = (action * _times(matrix, action)).sum(-1)
        return ellipse_excess(value, matrix.diagonal(dim1=-2, dim2=-1).sum(-1), self.bound, 2)

    def _penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        return self._violation(obs, action).clamp(min=0.0)

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        matrix = self.matrix(obs).expand(*action.shape[:-1], 2, 2)
        boxed = action.clamp(-1.0, 1.0)
        on_ellipse, tangent_jacobian = self._project_on_ellipse(matrix, action)
        low, high = self._face_intervals(matrix)
        along = action.flip(-1).unsqueeze(-1)
        moved = along.clamp(low, high)

        points = torch.cat((boxed.unsqueeze(-2), on_ellipse.unsqueeze(-2), _face_points(moved)), -2)
        # A rounding excess over the box is pulled in below; faces have their own, exact, candidates.
        valid = (
            (boxed * _times(matrix, boxed)).sum(-1, keepdim=True) <= self.bound,
            on_ellipse.abs().amax(-1, keepdim=True) <= 1.0 + 1e-12,
            (low <= high).flatten(-2),
        )
        distance = (points - action.unsqueeze(-2)).square().sum(-1)
        case = torch.where(torch.cat(valid, -1), distance, torch.inf).argmin(-1, keepdim=True)
        solution = points.take_along_dim(case.unsqueeze(-1), -2).squeeze(-2)

        # On a face only the other coordinate moves, unless the ellipse holds it too; in the box both may.
        slides = _face_points(((moved > low) & (moved < high)).double(), fixed=0.0)
        inside = (action.abs() < 1.0).double().unsqueeze(-2)
        free = torch.cat((inside, torch.zeros_like(inside), slides), -2)
        free = free.take_along_dim(case.unsqueeze(-1), -2).squeeze(-2)

        def product(vector: Tensor) -> Tensor:
            return torch.where(case == 1, tangent_jacobian(vector), free * vector)

        return self._pull_in(obs, solution), product

    def _project_on_ellipse(self, matrix: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        """Projection on the ellipse alone, in the axes of `matrix`, and its Jacobian product."""
        first, cross, second = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
        angle = 0.5 * torch.atan2(2.0 * cross, first - second)
        cos, sin = angle.cos(), angle.sin()
        axes = torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), -2)
        spread = torch.hypot(0.5 * (first - second), cross)
        mean = 0.5 * (first + second)
        scale = torch.stack((mean + spread, (mean - spread).clamp(min=0.0)), -1)
        target = _times(axes.mT, action)

        def unbounded(metric: Tensor) -> tuple[Tensor, Tensor, None]:
            return target / metric, torch.ones_like(metric), None

        solution, mu = minimize_under_ellipse(unbounded, target, 1.0, scale, self.bound)
        jacobian = deflated_jacobian(1.0 / (1.0 + mu * scale), torch.where(mu > 0.0, scale * solution, 0.0))
        return _times(axes, solution), lambda vector: _times(axes, jacobian(_times(axes.mT, vector)))

    def _face_intervals(self, matrix: Tensor) -> tuple[Tensor, Tensor]:
        """Feasible interval (low, high) of the other coordinate on the faces a_i = +-1, each (..., 2, 2) over
        (i, sign); empty (low > high) where the face is infeasible."""
        held = matrix.diagonal(dim1=-2, dim2=-1).unsqueeze(-1)
        moved = held.flip(-2)
        cross = matrix[..., 0, 1, None, None] * torch.tensor([1.0, -1.0], dtype=matrix.dtype, device=matrix.device)
        discriminant = cross**2 - moved * (held - self.bound)
        root = discriminant.clamp(min=0.0).sqrt()
        curved = moved > 0.0
        safe = torch.where(curved, moved, 1.0)
        low = torch.where(curved, (-cross - root) / safe, -1.0).clamp(min=-1.0)
        high = torch.where(curved, (-cross + root) / safe, 1.0).clamp(max=1.0)
        met = torch.where(curved, discriminant >= 0.0, held <= self.bound)
        return torch.where(met, low, 2.0), torch.where(met, high, -2.0)

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        matrix = self.matrix(obs).expand(*gradient.shape[:-1], 2, 2)
        # The maximiser over the ellipse alone, along inv(Q) gradient = adj(Q) gradient / det Q.
        diagonal = matrix.diagonal(dim1=-2, dim2=-1)
        ascent = diagonal.flip(-1) * gradient - matrix[..., 0, 1, None] * gradient.flip(-1)
        size = (ascent * _times(matrix, ascent)).sum(-1, keepdim=True)
        on_ellipse = ascent * (self.bound / size).sqrt()
        low, high = self._face_intervals(matrix)
        ends = torch.cat((_face_points(low), _face_points(high)), -2)
        met = (low <= high).flatten(-2)
        origin = torch.zeros_like(gradient)
        points = torch.cat((torch.stack((origin, on_ellipse), -2), ends), -2)
        inside = on_ellipse.abs().amax(-1, keepdim=True) <= 1.0 + 1e-12
        valid = torch.cat((torch.ones_like(inside), inside, met, met), -1)
        value = torch.where(valid, (points * gradient.unsqueeze(-2)).sum(-1), -torch.inf)
        best = value.argmax(-1, keepdim=True).unsqueeze(-1)
        return self._pull_in(obs, points.take_along_dim(best, -2).squeeze(-2))

    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        matrix = self.matrix(obs)
        bent = None if center is None else _times(matrix, center)
        return largest_gauge(
            direction,
            box_gauge_gradient(direction, center),
            ellipse_gauge_gradient(direction, _times(matrix, direction), center, bent, self.bound),
        )


def ellipse_excess(value: Tensor, trace: Tensor, bound: Tensor | float, dim: int) -> Tensor:
    """sqrt(a'Qa) - sqrt(bound) (...) with Q and bound scaled so that tr Q = dim; a zero Q stays as it is.

    value (...) = a'Qa and trace (...) = tr Q before scaling.
    """
    positive = trace > 1e-200
    factor = torch.where(positive, dim / torch.where(positive, trace, 1.0), 1.0).sqrt()
    return factor * (safe_sqrt(value) - bound**0.5)


def ellipse_gauge_gradient(
    direction: Tensor, bent_direction: Tensor, center: Tensor | None, bent_center: Tensor | None, bound: Tensor | float
) -> Tensor:
    """Gradient (..., d) of the gauge of a'Qa <= bound around `center` (None: the origin); `bent_x` is Qx.

    1 / L is the positive root of the quadratic in t at center + t direction.
    """
    curvature = (direction * bent_direction).sum(-1, keepdim=True)
    if center is None or bent_center is None:
        met = curvature > 0.0
        root = (torch.where(met, curvature, 1.0) * bound).sqrt()
        return torch.where(met, bent_direction / root, 0.0)
    slope = (bent_center * direction).sum(-1, keepdim=True)
    slack = bound - (bent_center * center).sum(-1, keepdim=True)
    square = slope**2 + curvature * slack
    met = square > 0.0
    root = torch.where(met, square, 1.0).sqrt()
    return torch.where(met, (bent_center + (slope * bent_center + slack * bent_direction) / root) / slack, 0.0)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix * vector.unsqueeze(-2)).sum(-1)


def _face_points(moved: Tensor, fixed: float = 1.0) -> Tensor:
    """Points (..., 4, 2) on the faces a_i = +-fixed, from the other coordinate (..., 2, 2) over (i, sign)."""
    sign = torch.tensor([fixed, -fixed], dtype=moved.dtype, device=moved.device).expand_as(moved)
    points = torch.stack((sign, moved), -1)
    return torch.cat((points[..., 0, :, :], points[..., 1, :, :].flip(-1)), -2)


def _check_bound(bound: float) -> None:
    if bound <= 0.0:
        raise ValueError(f"bound must be positive for the origin to be interior, got {bound}")
