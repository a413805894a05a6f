"""The maps into a feasible set along rays from its centre, and the densities of a policy after them.

One evaluation of the gauge serves a map, its density and the gradients of both. Gradients are closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from constraints.density import alpha_boundary_log_density, radial_log_det
from constraints.gauge import box_gauge_gradient
from constraints.numerics import one_where_zero, refuse_second_derivatives, with_gradient

_TINY = 1e-150  # replaces a gauge of 0
# The gauge map's factor phi differs from direction to direction, so the gradient of log phi grows like 1 / |u| towards
# u = 0, and in two dimensions its variance would be infinite. Where max_i |u_i| is below this, the gradient stops
# growing. In two dimensions, one in a million uniform u is that near to 0.
_NEAR_CENTER = 1e-3


class Ray:
    """The ray from a centre c on which a map moves actions (..., d).

    The alpha and radial maps move an action on its own ray, along its offset v = action - c. The gauge map takes the
    action itself as the offset. Maps and `alpha_log_prob` are in the action's dtype, the other log-densities in the
    dtype of `log_prob`, and `gauge`, `gradient` and `log_reach` in float64.

    Args:
        action: (..., d) float32 or float64, before the map.
        center: (..., d) or (d,) float64, None for the origin.
        offset: (..., d) float64, action - c with all leading dimensions.
        gauge_of: returns the set's gauge L (...) around c and its gradient (..., d), for offsets (..., d).
        traced: whether results are differentiated with respect to more than the action: the centre and the set's
            coefficients. If True, plain autograd computes the gradients; if False, they are closed forms.
    """

    def __init__(
        self,
        action: Tensor,
        center: Tensor | None,
        offset: Tensor,
        gauge_of: Callable[[Tensor], tuple[Tensor, Tensor]],
        traced: bool = False,
    ):
        self.action, self.center, self.offset = action, center, offset
        self._gauge_of, self._traced = gauge_of, traced
        # The grad mode when the ray was made, whatever it is at the first use.
        self._grad_enabled = torch.is_grad_enabled() if traced else offset.requires_grad

    @property
    def gauge(self) -> Tensor:
        """Gauge L (...) of the offset, without gradients; `Constraint.gauge` has them."""
        return self._gauge_and_gradient[0]

    @property
    def gradient(self) -> Tensor:
        """Gradient (..., d) of the gauge at the offset, differentiable in it."""
        return self._gauge_and_gradient[1]

    @cached_property
    def _gauge_and_gradient(self) -> tuple[Tensor, Tensor]:
        with torch.set_grad_enabled(self._grad_enabled):
            gauge, gradient = self._gauge_of(self.offset)
        return gauge.detach(), gradient

    def _differentiable_gauge(self) -> Tensor:
        """The gauge L (...) of the offset, with gradients."""
        if self._traced:
            return (self.gradient * self.offset).sum(-1)
        return with_gradient(self.offset, self.gauge, self.gradient)

    def alpha_map(self) -> Tensor:
        """alpha-projection (..., d): the feasible point closest to the action on its ray."""
        if self._traced:
            return self._from_center(self.offset / self._differentiable_gauge().clamp(min=1.0).unsqueeze(-1))
        factor = self.gauge.clamp(min=1.0).reciprocal()
        return self._scaled(factor, -factor.square() * (self.gauge > 1.0))

    def radial_map(self) -> Tensor:
        """Radial squashing (..., d), c + tanh(L)/L (action - c) (paper, Eq. radial squashing)."""
        if self._traced:
            return self._from_center(self.offset * _tanh_ratio(self._differentiable_gauge()).unsqueeze(-1))
        gauge = self.gauge.clamp(min=_TINY)
        tanh = gauge.tanh()
        factor = tanh / gauge
        # Near 0 the slope is only right to 1e-16 / L; it multiplies an offset of size L.
        return self._scaled(factor, (1.0 - tanh.square() - factor) / gauge)

    def gauge_map(self) -> Tensor:
        """Gauge map (..., d), c + phi u with phi = max_i |u_i| / L(u), of u = `action` in the box.

        It has no derivative at u = 0. Value and gradient there are those for phi = 1.
        """
        if self._traced:
            offset = self._action64()
            return self._from_center(offset * self._traced_stretch(_unit(offset)).unsqueeze(-1))
        stretch = self._stretch
        mapped = _Scale.apply(self._action64(), stretch.factor, stretch.direction, stretch.factor, stretch.slope)
        return self._from_center(mapped)

    def radial_log_prob(self, log_prob: Tensor, unit_ball: bool = False, floor: float = 0.0) -> Tensor:
        """Log-density (...) of `radial_map()`, given the log-density `log_prob` (...) of the action.

        Args:
            unit_ball: measure in unit-ball coordinates, see `log_reach`.
            floor: added to the map's Jacobian determinant, whose exact value may be tiny, before the logarithm.
        """
        gauge = self._differentiable_gauge()
        log_det = radial_log_det(gauge, self.offset.shape[-1])
        if floor > 0.0:
            log_det = torch.logaddexp(log_det, torch.full_like(log_det, math.log(floor)))
        density = log_prob.double() - log_det
        if unit_ball:
            density = density + self.offset.shape[-1] * self.log_reach()
        return density.to(log_prob.dtype)

    def gauge_log_prob(self, log_prob: Tensor, unit_ball: bool = False) -> Tensor:
        """Log-density (...) of `gauge_map()`, given the log-density `log_prob` (...) of the action.

        phi is homogeneous of degree 0, so the determinant of the map's Jacobian is phi^d. The gradient of log phi is
        exact for max_i |u_i| >= 1e-3. Nearer to 0 it stops growing, and at 0 it is 0.

        Args:
            unit_ball: measure in unit-ball coordinates, see `log_reach`. The gauge cancels in them.
        """
        dim = self.offset.shape[-1]
        if self._traced:
            unit = _unit(self._action64(), _NEAR_CENTER)
            if unit_ball:
                log_scale = _largest(unit).log() - one_where_zero(unit.square().sum(-1)).log() / 2.0
            else:
                log_scale = self._traced_stretch(unit).log()
            return (log_prob.double() - dim * log_scale).to(log_prob.dtype)
        stretch = self._stretch
        if unit_ball:
            # log phi - log r = log max_i |u_i| - log |u|, with r = |u| / L(u) the distance to the boundary.
            square = one_where_zero(stretch.direction.square().sum(-1))
            value = -square.log() / 2.0
            gradient = stretch.face - stretch.direction / square.unsqueeze(-1)
        else:
            value, gradient = stretch.factor.log(), stretch.slope
        size = stretch.size.clamp(min=_NEAR_CENTER).unsqueeze(-1)
        log_scale = with_gradient(self._action64(), value, gradient / size)
        return (log_prob.double() - dim * log_scale).to(log_prob.dtype)

    def alpha_log_prob(
        self, mean: Tensor, std: Tensor, unit_ball: bool = False, boundary_weight: float = 1.0
    ) -> Tensor:
        """Log-density (...) of `alpha_map()` for an action from N(mean, diag std^2), each (..., d).

        The density is with respect to volume where the action is feasible, and to the boundary's surface measure
        elsewhere.

        Args:
            unit_ball: measure volume and surface in unit-ball coordinates, see `log_reach`.
            boundary_weight: weight of the surface measure beside the volume (paper, footnote on the entropy).
        """
        offset, mean, std = self.offset, mean.double(), std.double()
        residual = (self.action.double() - mean) / std
        interior = -(0.5 * residual**2 + std.log()).sum(-1) - 0.5 * offset.shape[-1] * math.log(2.0 * math.pi)
        inside = self.gauge <= 1.0
        # Inside, harmless stand-ins keep the unused branch finite, and its gradient too.
        spread = inside.unsqueeze(-1)
        gauge = self._differentiable_gauge()
        to_boundary = torch.where(spread, 1.0, offset / torch.where(inside, 1.0, gauge).unsqueeze(-1))
        origin = torch.zeros_like(offset) if self.center is None else self.center.expand_as(offset)
        # The boundary's element of surface is reach^d |grad L| times the unit sphere's. A gradient of length 1 here
        # leaves the factor reach^d, which the interior needs as well.
        normal = torch.full_like(offset, offset.shape[-1] ** -0.5) if unit_ball else self.gradient
        boundary = alpha_boundary_log_density(
            to_boundary, torch.where(spread, 1.0, normal), origin, mean.expand_as(offset), std.expand_as(offset)
        )
        density = torch.where(inside, interior, boundary - math.log(boundary_weight))
        if unit_ball:
            density = density + offset.shape[-1] * self.log_reach()
        return density.to(self.action.dtype)

    def log_reach(self) -> Tensor:
        """log r (...), with r = |v| / L the distance from the centre to the boundary along the ray; 0 at the centre.

        In unit-ball coordinates y = L(v) v / |v| every set is the unit ball, whatever the state and the units, so
        entropies can be compared. dy = dv / r^d, so the interior's log-density gains d log r.
        """
        gauge = self._differentiable_gauge()
        square = self.offset.square().sum(-1)
        away = square > 0.0
        return torch.where(away, square, 1.0).log() / 2.0 - torch.where(away, gauge, 1.0).log()

    def _scaled(self, factor: Tensor, slope: Tensor) -> Tensor:
        """c + factor (action - c), where the factor is a function of L with derivative `slope`."""
        return self._from_center(_Scale.apply(self.offset, factor, self.offset, slope, self.gradient.detach()))

    def _from_center(self, mapped: Tensor) -> Tensor:
        return (mapped if self.center is None else self.center + mapped).to(self.action.dtype)

    def _action64(self) -> Tensor:
        """The action (..., d) in float64 with all leading dimensions: the offset that the gauge map scales."""
        return self.action.double().expand_as(self.offset)

    def _traced_stretch(self, unit: Tensor) -> Tensor:
        """phi (...) of the gauge map at `unit`, with gradients by plain autograd; 1 at 0."""
        gauge = (self._gauge_of(unit)[1] * unit).sum(-1)
        at_center = (unit == 0.0).all(-1)
        return torch.where(at_center, 1.0, _largest(unit) / torch.where(at_center, 1.0, gauge))

    @cached_property
    def _stretch(self) -> _Stretch:
        with torch.no_grad():
            offset = self._action64()
            size = offset.abs().amax(-1)
            direction = offset / one_where_zero(size).unsqueeze(-1)
            gauge, gradient = self._gauge_of(direction)
            # A NaN gauge stays NaN.
            factor = torch.where(size == 0.0, 1.0, gauge).reciprocal()
            face = box_gauge_gradient(direction, None)
            return _Stretch(size, direction, face, factor, face - factor.unsqueeze(-1) * gradient)


def _unit(offset: Tensor, near: float = 0.0) -> Tensor:
    """The offset u (..., d), divided by max_i |u_i|; 0 at 0.

    The derivative treats the divisor as a constant, and as at least `near`.
    """
    size = offset.detach().abs().amax(-1, keepdim=True)
    unit = offset.detach() / one_where_zero(size)
    slope = one_where_zero(size.clamp(min=near)).reciprocal()
    return unit + slope * (offset - offset.detach())


def _largest(unit: Tensor) -> Tensor:
    """max_i |u_i| (...), with a gradient along the first such coordinate; 1 at 0."""
    value = (box_gauge_gradient(unit, None) * unit).sum(-1)
    return torch.where((unit == 0.0).all(-1), 1.0, value)


def _tanh_ratio(gauge: Tensor) -> Tensor:
    """tanh(L) / L (...) for plain autograd: by its series near 0, where the quotient's derivative would cancel."""
    small = gauge < 0.01
    square = torch.where(small, gauge, 0.0).square()
    series = 1.0 + square * (-1.0 / 3.0 + square * (2.0 / 15.0 - 17.0 / 315.0 * square))
    away = torch.where(small, 1.0, gauge)
    return torch.where(small, series, away.tanh() / away)


class _Stretch(NamedTuple):
    """Pieces of the gauge map and its density, for actions u.

    phi has the same value at u / max_i |u_i|. It is evaluated there, as 1 / L, so that no square underflows.
    """

    size: Tensor  # (...) max_i |u_i|
    direction: Tensor  # (..., d) u / size, 0 at u = 0
    face: Tensor  # (..., d) gradient of the size
    factor: Tensor  # (...) phi, 1 at u = 0
    slope: Tensor  # (..., d) size times the gradient of log phi, 0 at u = 0


class _Scale(torch.autograd.Function):
    """offset * factor, with the Jacobian factor I + slope direction gradient'."""

    @staticmethod
    def forward(ctx, offset: Tensor, factor: Tensor, direction: Tensor, slope: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(factor, direction, slope, gradient)
        return offset * factor.unsqueeze(-1)

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        factor, direction, slope, gradient = ctx.saved_tensors
        along = (direction * grad).sum(-1) * slope
        return torch.addcmul(grad * factor.unsqueeze(-1), along.unsqueeze(-1), gradient), None, None, None, None
