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

    def radial_log_prob(self, log_prob: Tensor) -> Tensor:
        """Log-density (...) of `radial_map()`, given the log-density `log_prob` (...) of the action."""
        gauge = differentiable_gauge(self.offset, self.gauge, self.gradient)
        return (log_prob.double() - radial_log_det(gauge, self.offset.shape[-1])).to(log_prob.dtype)

    def alpha_log_prob(self, mean: Tensor, std: Tensor) -> Tensor:
        """Log-density (...) of `alpha_map()` for an action from N(mean, diag std^2), each (..., d).

        With respect to volume where the action is feasible, to the boundary's surface measure where it is not.
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
        boundary = alpha_boundary_log_density(
            to_boundary,
            torch.where(spread, 1.0, self.gradient),
            origin,
            mean.expand_as(offset),
            std.expand_as(offset),
        )
        return torch.where(inside, interior, boundary).to(self.action.dtype)

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
