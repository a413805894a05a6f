"""Gauges by their gradients.

The gauge L of a set around a centre is homogeneous of degree 1, so its value is <gradient, direction> (Euler). The
gauge of an intersection is the largest of the gauges of its parts.
"""

from __future__ import annotations

import torch
from torch import Tensor


def box_gauge_gradient(direction: Tensor, center: Tensor | None) -> Tensor:
    """Gradient (..., d) of the gauge of the box around `center`: the row of the face that the ray meets first.

    For None, the centre is the origin and the gauge is max_i |u_i|.
    """
    direction = direction.detach()
    sign = direction.sign()
    slope = sign if center is None else sign / (1.0 - sign * center)
    first = (slope * direction).argmax(-1, keepdim=True)
    return torch.zeros_like(slope).scatter(-1, first, slope.gather(-1, first))


def largest_gauge(direction: Tensor, *gradients: Tensor) -> tuple[Tensor, Tensor]:
    """Gauge (...) and gradient (..., d) of an intersection, from the gradients of the gauges of its parts."""
    direction, gradient = direction.detach(), gradients[0]
    gauge = (gradient.detach() * direction).sum(-1)
    for other in gradients[1:]:
        value = (other.detach() * direction).sum(-1)
        gradient = torch.where((value > gauge).unsqueeze(-1), other, gradient)
        gauge = torch.maximum(gauge, value)
    return gauge, gradient
