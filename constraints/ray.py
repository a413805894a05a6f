"""The maps into a feasible set along rays from its centre, and the densities that a policy has after them.

One evaluation of the gauge serves the map, the density and the gradients of both.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from constraints.density import alpha_boundary_log_density, radial_log_det, refuse_second_derivatives

_TINY = 1e-150


class Ray:
    """The ray from a centre c through actions (..., d), with the set's gauge L of the offset `action - c`.

    `gauge` (...) and `gradient` (..., d) are those of the offset; `center` is None for the origin.
    """

    def __init__(self, action: Tensor, center: Tensor | None, offset: Tensor, gauge: Tensor, gradient: Tensor):
        self.action, self.center, self.offset = action, center, offset
        self.gauge, self.gradient = gauge.detach(), gradient

    def alpha_map(self) -> Tensor:
        """alpha-projection (..., d): the feasible point closest to the action on its ray."""
        factor = self.gauge.clamp(min=1.0).reciprocal()
        return self._scaled(factor, -factor.square() * (self.gauge > 1.0))

    def radial_map(self) -> Tensor:
        """Radial squashing (..., d), c + tanh(L)/L (action - c) (paper, Eq. radial squashing)."""
        gauge = self.gauge.clamp(min=_TINY)
        tanh = gauge.tanh()
        factor = tanh / gauge
        # Near 0 the slope is only right to 1e-16 / L; it multiplies an offset of size L.
        return self._scaled(factor, (1.0 - tanh.square() - factor) / gauge)

    def radial_log_prob(self, log_prob: Tensor, unit_ball: bool = False, floor: float = 0.0) -> Tensor:
        """Log-density (...) of `radial_map()`, given the log-density `log_prob` (...) of the action.

        Args:
            unit_ball: measure in unit-ball coordinates, see `log_reach`.
            floor: added to the map's Jacobian determinant, whose exact value may be tiny, before the logarithm.
        """
        gauge = differentiable_gauge(self.offset, self.gauge, self.gradient)
        log_det = radial_log_det(gauge, self.offset.shape[-1])
        if floor > 0.0:
            log_det = torch.logaddexp(log_det, torch.full_like(log_det, math.log(floor)))
        density = log_prob.double() - log_det
        if unit_ball:
            density = density + self.offset.shape[-1] * self.log_reach()
        return density.to(log_prob.dtype)

    def alpha_log_prob(
        self, mean: Tensor, std: Tensor, unit_ball: bool = False, boundary_weight: float = 1.0
    ) -> Tensor:
        """Log-density (...) of `alpha_map()` for an action from N(mean, diag std^2), each (..., d).

        With respect to volume where the action is feasible, to the boundary's surface measure where it is not.

        Args:
            unit_ball: measure volume and surface in unit-ball coordinates, see `log_reach`.
            boundary_weight: weight of the surface measure beside the volume (paper, footnote on the entropy).
        """
        offset, mean, std = self.offset, mean.double(), std.double()
        residual = (self.action.double() - mean) / std
        interior = -(0.5 * residual**2 + std.log()).sum(-1) - 0.5 * offset.shape[-1] * math.log(2.0 * math.pi)
        inside = self.gauge <= 1.0
        # Harmless stand-ins inside keep the unused branch, and so its gradient, finite.
        spread = inside.unsqueeze(-1)
        gauge = differentiable_gauge(offset, self.gauge, self.gradient)
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

        In unit-ball coordinates y = L(v) v / |v| every set is the unit ball, whatever the state and the units:
        entropies measured there mean the same everywhere. dy = dv / r^d, so the interior's log-density gains d log r.
        """
        gauge = differentiable_gauge(self.offset, self.gauge, self.gradient)
        square = self.offset.square().sum(-1)
        away = square > 0.0
        return torch.where(away, square, 1.0).log() / 2.0 - torch.where(away, gauge, 1.0).log()

    def _scaled(self, factor: Tensor, slope: Tensor) -> Tensor:
        """c + factor (action - c), where the factor is a function of L with derivative `slope`."""
        mapped = _Scale.apply(self.offset, factor, slope, self.gradient.detach())
        return (mapped if self.center is None else self.center + mapped).to(self.action.dtype)


class _Scale(torch.autograd.Function):
    @staticmethod
    def forward(ctx, offset: Tensor, factor: Tensor, slope: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(offset, factor, slope, gradient)
        return offset * factor.unsqueeze(-1)

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        offset, factor, slope, gradient = ctx.saved_tensors
        along = (offset * grad).sum(-1) * slope
        return torch.addcmul(grad * factor.unsqueeze(-1), along.unsqueeze(-1), gradient), None, None, None


class _Gauge(torch.autograd.Function):
    @staticmethod
    def forward(ctx, direction: Tensor, gauge: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return gauge.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        return grad.unsqueeze(-1) * ctx.saved_tensors[0], None, None


def differentiable_gauge(direction: Tensor, gauge: Tensor, gradient: Tensor) -> Tensor:
    """The `gauge` (...) of `direction` (..., d) with `gradient` (..., d) as its derivative."""
    return _Gauge.apply(direction, gauge.detach(), gradient.detach())
