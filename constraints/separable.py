"""Scalar dual problems behind the closed forms: one row or one diagonal ellipse over a box, in batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from constraints.base import deflated_jacobian

_TINY = 1e-300
_HUGE = 1e300
# Newton needs 4 to 10 steps, rows with tied or degenerate gradients up to 30.
_MAX_STEPS = 40


def minimize_under_row(
    target: Tensor, metric: Tensor, row: Tensor, bound: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """argmin (..., d) of sum(metric a^2 / 2 - target a) subject to row.a <= bound and low <= a <= high.

    metric (..., d) >= 0: ones give a projection, zeros a continuous knapsack. bound (..., 1) must be attainable.
    Also returns whether the row holds the solution back (..., 1).

    With a multiplier lam on the row, each coordinate stays at one end of its range until lam reaches `leave`, moves
    linearly, and stays at the other end from `arrive` on; where metric is 0 it jumps. row.a falls along lam, so the
    solution lies between the two of the 2d breakpoints whose row.a enclose the bound. Breakpoints at the same lam but
    on either side of a jump count as two, so that the jump is interpolated like a move.
    """
    free = (target / metric.clamp(min=_TINY)).clamp(low, high)
    moving = row != 0.0
    first = torch.where(moving, torch.where(row > 0.0, high, low), free)
    last = torch.where(moving, torch.where(row > 0.0, low, high), free)
    slope = torch.where(moving, row, 1.0)
    leave = ((target - metric * first) / slope).clamp(-_HUGE, _HUGE)
    arrive = ((target - metric * last) / slope).clamp(-_HUGE, _HUGE)
    width = (arrive - leave).clamp(min=_TINY).unsqueeze(-2)
    leaving = torch.nn.functional.pad(leave, (1, 0)).clamp(min=0.0).unsqueeze(-1)  # lam = 0 comes first
    arriving = arrive.clamp(min=0.0).unsqueeze(-1)
    before = ((leaving - leave.unsqueeze(-2)) / width).clamp(0.0, 1.0)
    after = 1.0 - ((arrive.unsqueeze(-2) - arriving) / width).clamp(0.0, 1.0)
    travelled = torch.cat((before, after), -2)  # (..., 2d + 1, d)

    value = (row * first).sum(-1, keepdim=True)
    value = value + (travelled * (row * (last - first)).unsqueeze(-2)).sum(-1)  # row.a at each breakpoint
    active = value[..., :1] > bound
    above, upper = torch.where(value >= bound, value, torch.inf).min(-1, keepdim=True)
    below, lower = torch.where(value <= bound, value, -torch.inf).max(-1, keepdim=True)
    gap = above - below
    share = torch.where(gap > 0.0, (above - bound) / gap, 0.0)
    start, end = (travelled.take_along_dim(index.unsqueeze(-1), -2).squeeze(-2) for index in (upper, lower))
    solution = first + (start + share * (end - start)) * (last - first)
    return torch.where(active, solution, free), active


InnerSolver = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
"""Maps a metric (..., d) to the minimiser (..., d) of sum(metric a^2 / 2 - target a) over a polyhedron, 1.0 on its
free coordinates (..., d) and the row that holds it back, 0 where none does (..., d)."""


def minimize_under_ellipse(
    inner: InnerSolver, target: Tensor, shift: float, scale: Tensor, bound: float
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """argmin (..., d) of sum(shift a^2 / 2 - target a) over `inner`'s polyhedron and sum(scale a^2) <= bound.

    shift 1 gives a projection, shift 0 a linear oracle; scale (..., d) >= 0. Returns the solution, the curvature
    free / (shift + mu scale) (..., d), and the normals (..., d) of the active row and of the active ellipse.

    The dual function is concave in the ellipse's multiplier mu, so the ellipse's value falls along mu: Newton's method
    on 1 / sqrt(value of the free coordinates), which is linear in mu for a sphere, within a bracket. Since
    scale_i a_i <= |target_i| / mu, the multiplier is at most |target|_1 / bound.
    """
    high = target.abs().sum(-1, keepdim=True) / bound
    low = mu = torch.zeros_like(high)
    for _ in range(_MAX_STEPS):
        metric = shift + mu * scale
        solution, free, row = inner(metric)
        curvature = free / metric.clamp(min=_TINY)
        pull = scale * solution
        energy = pull * solution
        value = energy.sum(-1, keepdim=True)
        over = value > bound
        # Written so that NaN counts as settled.
        settled = ~((value - bound).abs() > 1e-13 * bound) | ~(over | (mu > 0.0))
        # Asking the device costs more than it saves on CUDA.
        if not target.is_cuda and settled.all():
            break
        low, high = torch.where(over, mu, low), torch.where(over, high, mu)
        fall = 2.0 * (pull * deflated_jacobian(curvature, row)(pull)).sum(-1, keepdim=True)
        moving = (free * energy).sum(-1, keepdim=True)
        newton = mu + 2.0 * moving / fall * ((moving / (bound - value + moving)).sqrt() - 1.0)
        inside = (newton > low) & (newton < high)
        middle = (torch.maximum(low, 1e-9 * high) * high).sqrt()
        mu = torch.where(settled, mu, torch.where(inside, newton, middle))
    return solution, curvature, (row, torch.where(mu > 0.0, pull, 0.0))
