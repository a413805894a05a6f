"""Log-densities of a policy after the radial and alpha maps (paper, "Action Constraints to SAC").

Both have their gradients in closed form. Autograd through the formulas would meet 0/0, or lose digits, and cost more.
They have first derivatives only; `create_graph=True` raises a RuntimeError.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from constraints.numerics import refuse_second_derivatives, refuse_transforms

_NODES = 28  # Gauss-Legendre nodes on the window of the ray integral
_DROP = 25.0  # the window ends where the log of the integrand has fallen by at least this much


class _RadialLogDet(torch.autograd.Function):
    @staticmethod
    def forward(ctx, gauge: Tensor, dim: int) -> Tensor:
        # With tanh L = L / (1 + q): log(tanh L / L) = -log1p(q), and its derivative is q / L - tanh L.
        # Lambert's continued fraction for q has positive terms only, so nothing cancels near L = 0.
        square, tanh = gauge.square(), gauge.tanh()
        fraction = square / 17 + 15
        for odd in (13, 11, 9, 7, 5, 3):
            fraction = square / fraction + odd
        small = gauge < 1
        excess = torch.where(small, square / fraction, gauge / tanh - 1)
        ctx.save_for_backward(
            (dim - 1) * torch.where(small, gauge / fraction - tanh, 1 / tanh - tanh - 1 / gauge) - 2 * tanh
        )
        log_cosh = gauge + torch.log1p(torch.expm1(-2 * gauge) / 2)
        return (1 - dim) * torch.log1p(excess) - 2 * log_cosh

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        refuse_second_derivatives()
        (slope,) = ctx.saved_tensors
        return grad * slope, None


def radial_log_det(gauge: Tensor, dim: int) -> Tensor:
    """log |det J| of the radial map v -> tanh(L) / L v, that is (d - 1) log(tanh L / L) + log sech^2 L.

    The determinant of the paper's Jacobian of radial squashing, by Euler's identity for the homogeneous L.

    Args:
        gauge: (...) L >= 0 of the action before the map.
        dim: d, the dimension of the action.
    Returns:
        (...) the log-determinant, at most 0; its gradient at L = 0 is 0.
    """
    refuse_transforms("the density of the radial map")
    return _RadialLogDet.apply(gauge, dim)


@functools.lru_cache
def _quadrature(device: torch.device) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    # All callers share the tensors, and autograd cannot use tensors that were made in inference mode.
    with torch.inference_mode(False):
        return torch.as_tensor((nodes + 1) / 2, device=device), torch.as_tensor(weights / 2, device=device)


def log_ray_integral(
    slope: Tensor, intercept: Tensor, dim: int, derivatives: bool = True
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """log I(A, B), I = integral from 1 to infinity of t^(d-1) exp(-(A t + B)^2) dt, and its two derivatives.

    Gauss-Legendre quadrature on a window around the mode, outside of which the integrand is below e^-25 of its peak,
    for any A and B. All terms are positive. The terms of the paper's recursion through erf cancel when B is large.

    Args:
        slope, intercept: (...) A > 0 and B, float64.
        dim: d >= 1.
        derivatives: whether to compute the two derivatives.
    Returns:
        log I, d log I / dA and d log I / dB, each (...), without autograd. Without `derivatives`, the last two are
        None.
    """
    # In w = A t, the log of the integrand is h(w) = k log(w / A) - (w + B)^2 on w >= A: concave (k = d - 1).
    k = dim - 1
    mode = torch.maximum((torch.sqrt(intercept.square() + 2 * k) - intercept) / 2, slope)
    at_mode = mode + intercept
    # From the mode, h falls by at least y^2 (1 + k / 2 mode^2) on the left, and on the right by at least each
    # of s y + y^2 and k r^2 / (2 + 4 r / 3), where s = -h'(mode) and r = y / mode.
    left = torch.minimum(mode - slope, torch.sqrt(_DROP / (1 + k / 2 / mode.square())))
    fall = (2 * at_mode - k / mode).clamp_min(0)
    right = 2 * _DROP / (fall + torch.sqrt(fall.square() + 4 * _DROP))
    if k > 0:
        reach = (2 * _DROP / 3 + math.sqrt(4 * _DROP**2 / 9 + 2 * k * _DROP)) / k
        right = torch.minimum(right, mode * reach)
    width = (left + right) / mode

    # In place: allocating the temporaries of a large batch costs more than filling them.
    nodes, weights = _quadrature(slope.device)
    r = width[..., None] * nodes
    r -= (left / mode)[..., None]
    gauss = r * mode.square()[..., None]
    gauss += (2 * mode * at_mode)[..., None]
    gauss *= r
    ratio = r.add_(1)  # t over its value at the mode
    lower = ratio.log().mul_(k - 1).sub_(gauss).exp_()  # the integrand with t^(d-2), then with t^(d-1)
    mass = (lower * ratio) @ weights * width

    rise = k * torch.log(mode / slope)
    log_integral = rise - at_mode.square() + torch.log(mass * (mode / slope))
    if not derivatives:
        return log_integral, None, None
    mean_inverse = lower @ weights * width / (mode * mass)  # E[1 / (A t)]
    # Integration by parts gives both derivatives as sums of terms of one sign; differences of moments would cancel.
    # -d/dA = (e / I + d) / A and -d/dB = (e / I + (d - 1) E[1 / t]) / A, with e = exp(-(A + B)^2).
    edge = torch.exp((mode - slope) * (at_mode + slope + intercept) - rise) / (mass * mode)  # e / (A I)
    return log_integral, -(edge + dim / slope), -(edge + k * mean_inverse)


class _AlphaBoundaryLogDensity(torch.autograd.Function):
    @staticmethod
    def forward(ctx, boundary_offset, gauge_gradient, center, mean, std):
        dim = boundary_offset.shape[-1]
        normal, std = gauge_gradient.double(), std.double()
        ray = boundary_offset.double() / std
        start = (center.double() - mean.double()) / std
        # |start + t ray|^2 / 2 = (A t + B)^2 + |residual|^2 / 2, with A = |ray| / sqrt 2, B = A foot, and the
        # residual orthogonal to the ray: a sum of squares, not a difference of large ones.
        square = ray.square().sum(-1, keepdim=True)
        foot = (start * ray).sum(-1, keepdim=True) / square
        residual = start - foot * ray
        slope = torch.sqrt(square / 2)
        derivatives = any(ctx.needs_input_grad)
        log_integral, by_slope, by_intercept = log_ray_integral(slope[..., 0], (slope * foot)[..., 0], dim, derivatives)
        normal_square = normal.square().sum(-1)
        ctx.save_for_backward(normal, normal_square, std, ray, foot, residual, slope, by_slope, by_intercept)
        per_axis = residual.square() / 2 + std.log() + 0.5 * math.log(2 * math.pi)
        return (log_integral - per_axis.sum(-1) - normal_square.log() / 2).to(boundary_offset.dtype)

    @staticmethod
    def backward(ctx, grad):
        refuse_second_derivatives()
        normal, normal_square, std, ray, foot, residual, slope, by_slope, by_intercept = ctx.saved_tensors
        grad = grad.double()
        # Derivatives by start and ray are -E[start + t ray] and -E[t (start + t ray)] under the integrand.
        weight = grad[..., None]
        offset = (grad * by_intercept)[..., None] / (2 * slope)  # -E[t + foot]
        moment = (grad * by_slope)[..., None] / (2 * slope)  # -E[t (t + foot)]
        by_start = offset * ray - weight * residual
        by_ray = moment * ray + (offset + weight * foot) * residual
        by_std = -(weight + by_ray * ray + by_start * (residual + foot * ray)) / std
        by_center = by_start / std
        by_normal = -normal * (grad / normal_square)[..., None]
        return by_ray / std, by_normal, by_center, -by_center, by_std


def alpha_boundary_log_density(
    boundary_offset: Tensor, gauge_gradient: Tensor, center: Tensor, mean: Tensor, std: Tensor
) -> Tensor:
    """Log-density, per unit of surface, of N(mean, diag std^2) after the alpha map, at a boundary point b.

    q(b) = 1 / |grad L| * integral from 1 to infinity of N(c + t (b - c)) t^(d-1) dt: the paper's q dsigma
    with dOmega = r0^(1-d) cos(theta) dsigma (it prints r0^-1, the case d = 2). Computed in float64 inside.

    Args:
        boundary_offset: (..., d) b - c, where the gauge L is 1, so it is never zero.
        gauge_gradient: (..., d) gradient of L there, or anywhere else on the ray.
        center, mean, std: (..., d) c, and the Gaussian before the map.
    Returns:
        (...) log q(b), in the dtype of `boundary_offset`.
    """
    refuse_transforms("the density of the alpha map")
    return _AlphaBoundaryLogDensity.apply(boundary_offset, gauge_gradient, center, mean, std)
