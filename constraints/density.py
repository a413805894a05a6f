"""Log-densities of a policy after the radial and alpha maps (paper, "Incorporating Action Constraints to SAC").

Both are exact up to rounding, and so are their first gradients: the two functions with a singular or cancelling
closed form carry their own backward pass. Second derivatives are refused, not silently wrong.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_NODES = 32  # Gauss-Legendre nodes on the window of the ray integral
_DROP = 30.0  # the window ends where the log of the integrand has fallen by at least this much


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
        excess_over_gauge = torch.where(small, gauge / fraction, 1 / tanh - 1 / gauge)
        ctx.save_for_backward((dim - 1) * excess_over_gauge - (dim + 1) * tanh)
        log_cosh = gauge + torch.log1p(torch.expm1(-2 * gauge) / 2)
        return (1 - dim) * torch.log1p(excess) - 2 * log_cosh

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return grad * slope, None


def radial_log_det(gauge: Tensor, dim: int) -> Tensor:
    """log |det J| of the radial map v -> tanh(L) / L v, that is (d - 1) log(tanh L / L) + log sech^2 L.

    The determinant of the paper's Eq. (Jacobian of radial squashing), by Euler's identity for the homogeneous L.

    Args:
        gauge: (...) L >= 0 of the action before the map.
        dim: d, the dimension of the action.
    Returns:
        (...) the log-determinant, at most 0; its gradient at L = 0 is 0.
    """
    return _RadialLogDet.apply(gauge, dim)


@functools.lru_cache
def _quadrature(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return tuple(torch.as_tensor(x / 2, dtype=dtype, device=device) for x in (nodes + 1, weights))


class _LogRayIntegral(torch.autograd.Function):
    @staticmethod
    def forward(ctx, slope: Tensor, intercept: Tensor, dim: int) -> Tensor:
        # In w = A t the log of the integrand is h(w) = k log(w / A) - (w + B)^2 on w >= A, with k = d - 1: concave.
        k = dim - 1
        start, shift = slope.double(), intercept.double()
        root = torch.sqrt(shift.square() + 2 * k)
        mode = torch.maximum((root - shift) / 2, start)
        at_mode = mode + shift
        # From the mode, h falls by at least y^2 (1 + k / 2 mode^2) to the left, and to the right by at least
        # each of s y + y^2 and k r^2 / (2 + 4 r / 3), where s = -h'(mode) and r = y / mode.
        left = torch.minimum(mode - start, torch.sqrt(_DROP / (1 + k / 2 / mode.square())))
        fall = (2 * at_mode - k / mode).clamp_min(0)
        right = 2 * _DROP / (fall + torch.sqrt(fall.square() + 4 * _DROP))
        if k > 0:
            right = torch.minimum(
                right, mode * ((2 * _DROP / 3 + math.sqrt(4 * _DROP**2 / 9 + 2 * k * _DROP)) / k)
            )
        width = left + right

        nodes, weights = _quadrature(torch.float64, slope.device)
        y = torch.addcmul(-left[..., None], width[..., None], nodes)
        ratio = 1 + y / mode[..., None]  # t over its value at the mode
        lower = ratio.pow(k - 1) * torch.exp(-y * (y + 2 * at_mode[..., None]))
        mass = (lower * ratio) @ weights * width
        inverse = lower @ weights * width / mode / mass  # E[1 / (A t)]

        rise = k * torch.log(mode / start)
        log_integral = rise - at_mode.square() + torch.log(mass / start)
        # Integration by parts turns both derivatives into sums of one sign (no difference of moments):
        # d/dA = -(1 / I)(e + d I) / A,  d/dB = -(1 / I)(e + (d - 1) I_{d-1}) / A,  e = exp(-(A + B)^2).
        edge = torch.exp((mode - start) * (mode + start + 2 * shift) - rise) / mass  # e / (A I)
        ctx.save_for_backward(-(edge + dim / start), -(edge + k * inverse))
        ctx.dtypes = slope.dtype, intercept.dtype
        return log_integral.to(torch.promote_types(*ctx.dtypes))

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        by_slope, by_intercept = ctx.saved_tensors
        slope_type, intercept_type = ctx.dtypes
        return (grad * by_slope).to(slope_type), (grad * by_intercept).to(intercept_type), None


def log_ray_integral(slope: Tensor, intercept: Tensor, dim: int) -> Tensor:
    """log of the integral from 1 to infinity of t^(d-1) exp(-(A t + B)^2) dt.

    Gauss-Legendre quadrature on a window around the mode, which holds all but e^-30 of the integrand whatever A, B.

    Args:
        slope: (...) A > 0.
        intercept: (...) B, of the same shape.
        dim: d >= 1.
    """
    return _LogRayIntegral.apply(slope, intercept, dim)


def alpha_boundary_log_density(
    boundary_offset: Tensor, gauge_gradient: Tensor, center: Tensor, mean: Tensor, std: Tensor
) -> Tensor:
    """Log-density, per unit of surface, of N(mean, diag std^2) after the alpha map, at a point of the boundary.

    q(b) = 1 / |grad L| * integral from 1 to infinity of N(c + t (b - c)) t^(d-1) dt: the paper's q dsigma, with
    dOmega = r0^(1-d) cos(theta) dsigma (its print has r0^-1, the case d = 2). Computed in float64 throughout.

    Args:
        boundary_offset: (..., d) b - c, with gauge L(b - c) = 1, so never zero.
        gauge_gradient: (..., d) gradient of L there, or anywhere else on the ray.
        center, mean, std: (..., d) c, and the Gaussian before the map.
    Returns:
        (...) log q(b), in the type of the arguments.
    """
    dim = boundary_offset.shape[-1]
    scale = std.double()
    ray = boundary_offset.double() / scale
    start = (center.double() - mean.double()) / scale
    # |start + t ray|^2 / 2 = (A t + B)^2 + |residual|^2 / 2, the residual being orthogonal to the ray
    length = torch.linalg.vector_norm(ray, dim=-1, keepdim=True)
    along = (start * ray).sum(-1, keepdim=True) / length
    residual = start - along / length * ray
    log_ray = log_ray_integral(length[..., 0] * math.sqrt(0.5), along[..., 0] * math.sqrt(0.5), dim)
    log_normal = (-0.5 * residual.square() - scale.log()).sum(-1) - dim / 2 * math.log(2 * math.pi)
    log_density = log_ray + log_normal - torch.linalg.vector_norm(gauge_gradient.double(), dim=-1).log()
    return log_density.to(boundary_offset.dtype)
