"""Ellipses around the origin, cut by the box: diagonal in any dimension and general in two (R+T)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from constraints.base import Constraint, Ellipse, ExplicitSet
from constraints.checks import check_semidefinite
from constraints.coefficients import Bound, BoundCoefficient, Coefficient, Coefficients, check_not_negative, flat
from constraints.implicit import Boundary
from constraints.jacobian import JacobianProduct, deflated_jacobian
from constraints.numerics import keep_nan, safe_sqrt
from constraints.scalar_dual import BoxProblem, RowProblem, minimize_under_ellipse

_ROUNDING = 1e-13  # a point outside the box by no more than this counts as inside
_FLAT = 1e-280  # a'Qa below this may be 0 up to rounding: the ellipse does not end in the direction a
_MAX_STEPS = 40  # Newton needs 3 to 10


class Scales(NamedTuple):
    """Coefficients of sum s_i a_i^2 <= bound."""

    scale: Tensor  # (..., d)
    bound: Tensor | float  # (..., 1)


class DiagonalEllipse(Constraint):
    """sum s_i a_i^2 <= bound in the box, s = scale(obs) >= 0; some or all s_i may be 0.

    The bound is a number or a function of obs. ValueError for a number that is not positive and finite.
    """

    def __init__(self, scale: Coefficients, bound: Bound, dim: int):
        super().__init__(dim)
        self.scale, self.bound = scale, bound
        self._scale_at = Coefficient("scale", scale, (dim,), check_not_negative)
        self._bound_at = BoundCoefficient("bound", bound)

    def _at(self, obs: Tensor) -> Scales:
        return Scales(self._scale_at(obs), self._bound_at(obs))

    def explicit(self, obs: Tensor) -> ExplicitSet:
        ellipse = Ellipse(torch.diag_embed(self._scale_at(obs)), obs.new_zeros(self.dim), flat(self._bound_at(obs)))
        return ExplicitSet(obs.new_zeros(0, self.dim), obs.new_zeros(0), [ellipse])

    def _violation(self, at: Scales, action: Tensor) -> Tensor:
        scale, bound = at
        return ellipse_excess((scale * action**2).sum(-1), scale.sum(-1), flat(bound), self.dim)

    def _project(self, at: Scales, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        return minimize_in_ellipse(BoxProblem(action.abs()), action, 1.0, *at)

    def _boundaries(self, at: Scales, point: Tensor) -> list[Boundary]:
        normal = at.scale * point / at.bound
        return [Boundary((normal * point).sum(-1) - 1.0, 2.0 * normal)]

    def _linear_oracle(self, at: Scales, gradient: Tensor) -> Tensor:
        return minimize_in_ellipse(BoxProblem(gradient.abs()), gradient, 0.0, *at)[0]

    def _gauge_gradients(self, at: Scales, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        scale, bound = at
        bent = None if center is None else scale * center
        return [ellipse_gauge_gradient(direction, scale * direction, center, bent, bound)]


class PlanarEllipse(Constraint):
    """a'Qa <= bound in the box, Q = matrix(obs) (..., 2, 2) positive semi-definite; a slab where Q is singular (R+T).

    Projection and oracle are exact, by cases: the box alone, the ellipse alone, or one of the box's four faces. The
    bound is a number or a function of obs. ValueError for a number that is not positive and finite.
    """

    def __init__(self, matrix: Coefficients, bound: Bound):
        super().__init__(2)
        self.matrix, self.bound = matrix, bound
        self._matrix_at = Coefficient("matrix", matrix, (2, 2), check_semidefinite)
        self._bound_at = BoundCoefficient("bound", bound)

    def _at(self, obs: Tensor) -> _Planar:
        matrix = self._matrix_at(obs)
        return _Planar(matrix.diagonal(dim1=-2, dim2=-1), matrix[..., 0, 1:], self._bound_at(obs))

    def explicit(self, obs: Tensor) -> ExplicitSet:
        ellipse = Ellipse(self._matrix_at(obs), obs.new_zeros(2), flat(self._bound_at(obs)))
        return ExplicitSet(obs.new_zeros(0, 2), obs.new_zeros(0), [ellipse])

    def _violation(self, at: _Planar, action: Tensor) -> Tensor:
        return ellipse_excess(at.value(action).squeeze(-1), at.diagonal.sum(-1), flat(at.bound), 2)

    def _project(self, planar: _Planar, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        boxed = action.clamp(-1.0, 1.0)
        in_ellipse = planar.value(boxed) <= planar.bound
        on_ellipse, mu = planar.project(action)
        in_box = on_ellipse.abs().amax(-1, keepdim=True) <= 1.0 + _ROUNDING

        # On a face, mirrored to a_i = 1, the best point is the point of the feasible interval nearest to the action's
        # other coordinate. Squared distances leave out |action|^2: for a far point, rounding would hide their
        # differences.
        own, other = _mirrored(action), _mirrored(action.flip(-1))
        low, high, met = planar.faces()
        moved = torch.minimum(torch.maximum(other, low), high)
        nearness = moved * (moved - 2.0 * other) - 2.0 * own
        face = nearness.masked_fill(~met, torch.inf).flatten(-2).argmin(-1, keepdim=True)
        on_face = _on_face(face, moved.flatten(-2).gather(-1, face))
        slides = ((moved > low) & (moved < high)).flatten(-2).gather(-1, face)

        solution = torch.where(in_ellipse, boxed, torch.where(in_box, on_ellipse, on_face))

        def product(vector: Tensor) -> Tensor:
            in_metric = planar.in_metric(vector, mu)
            normal = planar.times(on_ellipse)
            column = planar.in_metric(normal, mu)
            pivot = (normal * column).sum(-1, keepdim=True).clamp(min=1e-300)
            tangent = in_metric - column * ((normal * in_metric).sum(-1, keepdim=True) / pivot)
            clipped = vector * (action.abs() < 1.0)
            along = vector * slides * torch.cat((face > 1, face < 2), -1)
            return torch.where(in_ellipse, clipped, torch.where(in_box, tangent, along))

        solution = within_ellipse(solution, planar.times(solution), planar.bound)
        return keep_nan(solution, action), product

    def _boundaries(self, planar: _Planar, point: Tensor) -> list[Boundary]:
        normal = planar.times(point) / planar.bound
        return [Boundary((normal * point).sum(-1) - 1.0, 2.0 * normal)]

    def _linear_oracle(self, planar: _Planar, gradient: Tensor) -> Tensor:
        # The maximiser over the ellipse alone is along inv(Q) gradient = adj(Q) gradient / det Q.
        ascent = planar.adjugate_times(gradient)
        on_ellipse = ascent * (planar.bound / planar.value(ascent).clamp(min=1e-300)).sqrt()
        in_box = on_ellipse.abs().amax(-1, keepdim=True) <= 1.0 + _ROUNDING

        own, other = _mirrored(gradient), _mirrored(gradient.flip(-1))
        low, high, met = planar.faces()
        moved = torch.where(other > 0.0, high, low)
        value, face = (own + other * moved).masked_fill(~met, -torch.inf).flatten(-2).max(-1, keepdim=True)
        on_face = _on_face(face, moved.flatten(-2).gather(-1, face))
        best = in_box & ((on_ellipse * gradient).sum(-1, keepdim=True) >= value)
        solution = torch.where(best, on_ellipse, on_face)
        return within_ellipse(solution, planar.times(solution), planar.bound)

    def _gauge_gradients(self, planar: _Planar, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        bent = None if center is None else planar.times(center)
        return [ellipse_gauge_gradient(direction, planar.times(direction), center, bent, planar.bound)]


class _Planar(NamedTuple):
    """One symmetric matrix (..., 2, 2) by its entries, and a bound. Vectors are (..., 2), scalars (..., 1)."""

    diagonal: Tensor  # (..., 2)
    cross: Tensor  # (..., 1)
    bound: Tensor | float  # (..., 1)

    def times(self, vector: Tensor) -> Tensor:
        return torch.addcmul(self.diagonal * vector, self.cross, vector.flip(-1))

    def adjugate_times(self, vector: Tensor) -> Tensor:
        return torch.addcmul(self.diagonal.flip(-1) * vector, self.cross, vector.flip(-1), value=-1.0)

    def value(self, vector: Tensor) -> Tensor:
        return (vector * self.times(vector)).sum(-1, keepdim=True)

    def determinant(self) -> Tensor:
        return (self.diagonal.prod(-1, keepdim=True) - self.cross.square()).clamp(min=0.0)

    def in_metric(self, vector: Tensor, mu: Tensor) -> Tensor:
        """inv(1 + mu Q) vector."""
        trace = self.diagonal.sum(-1, keepdim=True)
        scale = 1.0 + mu * (trace + mu * self.determinant())
        return torch.addcmul(vector, mu, self.adjugate_times(vector)) / scale

    def project(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Projection (..., 2) on the ellipse alone, and its multiplier mu (..., 1).

        The point is inv(1 + mu Q) action, whose value a'Qa is numerator / scale^2 with both polynomials in mu. Newton's
        method is applied to 1 / sqrt(value), which is concave and increasing in mu, so from the left it never passes
        the root.
        """
        trace, determinant = self.diagonal.sum(-1, keepdim=True), self.determinant()
        adjugate = self.adjugate_times(action)
        start = self.value(action)
        half_slope = determinant * action.square().sum(-1, keepdim=True)
        half_bend = determinant * (action * adjugate).sum(-1, keepdim=True)
        root_bound = self.bound**0.5
        mu = torch.zeros_like(start)
        for _ in range(_MAX_STEPS):
            turn = mu * determinant
            slope = torch.addcmul(half_slope, mu, half_bend)
            scale = 1.0 + mu * (trace + turn)
            value = start + mu * (half_slope + slope)
            rise = torch.addcmul((trace + 2.0 * turn) * value, scale, slope, value=-1.0).clamp_(min=1e-300)
            step = (value.sqrt().div_(root_bound) - scale).mul_(value).div_(rise).clamp_(min=0.0)
            mu = mu + step
            # A GPU takes all steps, as in minimize_under_ellipse. A NaN counts as settled.
            if action.is_cpu and not (step > 1e-12 * mu).any():
                break
        return torch.addcmul(action, mu, adjugate) / (1.0 + mu * (trace + mu * determinant)), mu

    def faces(self) -> tuple[Tensor, Tensor, Tensor]:
        """The feasible interval (low, high) of the other coordinate on the faces a_1 = 1 and a_2 = 1, and whether there
        is one, each (..., 2, 1). The faces a_i = -1 have the mirrored intervals."""
        held, moved = self.diagonal, self.diagonal.flip(-1).clamp(min=1e-200)
        discriminant = self.cross.square() - moved * (held - self.bound)
        root = discriminant.clamp(min=0.0).sqrt()
        low, high = ((-self.cross - root) / moved).clamp(min=-1.0), ((root - self.cross) / moved).clamp(max=1.0)
        met = (discriminant >= 0.0) & (low <= high)
        return low.unsqueeze(-1), high.unsqueeze(-1), met.unsqueeze(-1)


def _mirrored(vector: Tensor) -> Tensor:
    """Each coordinate and its negative (..., 2, 2)."""
    return torch.stack((vector, -vector), -1)


def _on_face(face: Tensor, moved: Tensor) -> Tensor:
    """Point (..., 2) with the other coordinate `moved` (mirrored) on face 0 to 3: a_1 = 1, a_1 = -1, a_2 = 1, -1."""
    point = torch.where(
        face < 2, torch.cat((torch.ones_like(moved), moved), -1), torch.cat((moved, torch.ones_like(moved)), -1)
    )
    return point * (1 - 2 * (face % 2))


def minimize_in_ellipse(
    problem: RowProblem | BoxProblem, target: Tensor, shift: float, scale: Tensor, bound: Tensor | float
) -> tuple[Tensor, JacobianProduct]:
    """Minimiser (..., d) of sum(shift a^2 / 2 - target a) over a problem's set and sum(scale a^2) <= bound.

    The problem must hold |target|. Also returns the product with the minimiser's Jacobian with respect to the target.
    """
    point, solution, mu = minimize_under_ellipse(problem, shift, scale, bound)
    point = torch.copysign(within_ellipse(point, scale * point, bound), target)

    def product(vector: Tensor) -> Tensor:
        curvature = solution.moves() / (mu * scale + shift)
        return deflated_jacobian(curvature, torch.copysign(solution.row(), target), scale * point * (mu > 0.0))(vector)

    return point, product


def within_ellipse(point: Tensor, bent: Tensor, bound: Tensor | float) -> Tensor:
    """The point (..., d), shrunk if rounding took it out of point'Q point <= bound; `bent` is Q point."""
    value = (point * bent).sum(-1, keepdim=True)
    return point * (bound / value.clamp(min=bound)).sqrt()


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
    # The comparisons let a NaN pass. A flat direction does not bound the ray.
    curvature = (direction * bent_direction).sum(-1, keepdim=True)
    if center is None or bent_center is None:
        flat = curvature < _FLAT
        root = (torch.where(flat, 1.0, curvature) * bound).sqrt()
        return torch.where(flat, 0.0, bent_direction / root)
    slope = (bent_center * direction).sum(-1, keepdim=True)
    slack = bound - (bent_center * center).sum(-1, keepdim=True)
    square = slope**2 + curvature * slack
    flat = square < _FLAT
    root = torch.where(flat, 1.0, square).sqrt()
    return torch.where(flat, 0.0, (bent_center + (slope * bent_center + slack * bent_direction) / root) / slack)
