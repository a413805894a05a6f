"""Scalar dual problems behind the closed forms: one row or one diagonal ellipse over a box, in batch.

Both minimise sum(metric a^2 / 2 - target a): metric 1 gives a projection, metric 0 a linear oracle. Coordinates are
mirrored and shifted so that each runs from 0 and no weight is negative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

_TINY = 1e-300
_HUGE = 1e100
_LEAST_WEIGHT = 1e-30  # counts as 0 but keeps quotients finite
_JUST_BELOW = 1.0 - 2.0**-52
# Newton needs 3 to 10 steps, rows with tied or degenerate gradients up to 30.
_MAX_STEPS = 40
_SETTLED = 1e-10  # relative excess from where one more Newton step is exact


class Solution(NamedTuple):
    """Minimiser of a `RowProblem` and what its derivatives need."""

    point: Tensor  # (..., d)
    free: Tensor  # (..., d) bool: the coordinate moves with its target
    row: Tensor  # (..., d) the row where it holds the point back, 0 elsewhere


class RowProblem:
    """min sum(metric a^2 / 2 - target a) subject to weight.a <= bound and 0 <= a <= top, for any metric >= 0.

    target and weight >= 0 (..., d); bound >= 0 is a number or (..., 1); top is a number.

    With a multiplier lam on the row, each coordinate stays at `top` until lam reaches `leave`, falls linearly, and
    stays at 0 from `arrive` on; where metric is 0 it jumps. weight.a falls along lam, so the solution lies between the
    two of the 2d breakpoints whose weight.a enclose the bound. The breakpoints `leave` are taken just before their
    value, so that a jump is interpolated like a fall.
    """

    def __init__(self, target: Tensor, weight: Tensor, bound: Tensor | float, top: float = 1.0):
        self.target, self.weight, self.bound, self.top = target, weight, bound, top
        least = weight.clamp(min=_LEAST_WEIGHT)
        self._arrive = (target / least).clamp_(-_HUGE, _HUGE)
        self._fall = top / least
        self._drop = weight * top

    def solve(self, metric: Tensor | float) -> Solution:
        """The solution for a metric (..., d) or a number >= 0."""
        arrive = self._arrive
        width = (self._fall * metric).clamp_(min=_TINY)
        leave = (arrive - width).mul_(_JUST_BELOW)
        turns = torch.cat((leave, arrive), -1).clamp_(min=0.0)
        value = (self._shares(turns, width) * self._drop.unsqueeze(-2)).sum(-1)  # weight.a at each breakpoint
        # Enclosed by lam and not by value: breakpoints far apart may have values equal to rounding.
        over = value > self.bound
        last_over = (turns * over).amax(-1, keepdim=True)
        first_under = turns.masked_fill(over, _HUGE).amin(-1, keepdim=True)
        ends = self._shares(torch.cat((last_over, first_under), -1), width)
        start, end = ends.unbind(-2)
        above, below = (ends * self._drop.unsqueeze(-2)).sum(-1, keepdim=True).unbind(-2)
        # Measured from below, a coordinate that the row presses against 0 keeps its relative precision.
        part = (self.bound - below) / (above - below).clamp_(min=_TINY)
        share = torch.lerp(end, start, part.clamp(max=1.0))
        held = above > self.bound
        free = ((share > 0.0) | (self.target >= 0.0) & ~held) & (share < 1.0)
        return Solution(share * self.top, free, self.weight * held)

    def _shares(self, multiplier: Tensor, width: Tensor) -> Tensor:
        """What is left of each coordinate's range (..., k, d) under the multipliers (..., k)."""
        ahead = self._arrive.unsqueeze(-2) - multiplier.unsqueeze(-1)
        return ahead.div_(width.unsqueeze(-2)).clamp_(0.0, 1.0)


InnerSolver = Callable[[Tensor], Solution]
"""Maps a metric (..., d) to the minimiser over a polyhedron."""


def minimize_under_ellipse(
    inner: InnerSolver, target: Tensor, shift: float, scale: Tensor, bound: float
) -> tuple[Solution, Tensor]:
    """Minimiser of sum(shift a^2 / 2 - target a) over `inner`'s polyhedron and sum(scale a^2) <= bound.

    scale (..., d) >= 0. The solution is `inner`'s for the metric shift + mu scale; also returns the ellipse's
    multiplier mu (..., 1), 0 where the ellipse does not hold the solution back.

    The dual function is concave in mu, so the ellipse's value falls along mu: Newton's method on 1 / sqrt(value of the
    free coordinates), which is linear in mu for a sphere, within a bracket. Since scale_i a_i <= |target_i| / mu, the
    multiplier is at most |target|_1 / bound.
    """
    size = target.abs()
    high = size.sum(-1, keepdim=True) / bound
    low = mu = torch.zeros_like(high)
    # Where Newton's step leaves the bracket, its geometric middle; the first such is at a guess for the ellipse alone.
    guess_square = (size.square() / scale.clamp(min=bound)).sum(-1, keepdim=True) / bound
    floor = guess_square / high.clamp(min=_TINY)
    for _ in range(_MAX_STEPS):
        metric = mu * scale + shift
        solution = inner(metric)
        pull = scale * solution.point
        excess = (pull * solution.point).sum(-1, keepdim=True) - bound
        over = excess > 0.0
        low, high = torch.where(over, mu, low), torch.where(over, high, mu)
        moved = solution.free * pull
        moving = (moved * solution.point).sum(-1, keepdim=True)
        bend = moved / metric.clamp(min=_TINY)
        lean = (bend * solution.row).sum(-1, keepdim=True)
        stiffness = (solution.free * solution.row.square() / metric.clamp(min=_TINY)).sum(-1, keepdim=True)
        fall = (bend * pull).sum(-1, keepdim=True) - lean.square() / stiffness.clamp(min=_TINY)
        newton = mu + moving / fall * ((moving / (moving - excess)).sqrt() - 1.0)
        middle = (torch.maximum(low, torch.minimum(floor, 1e-3 * high)) * high).sqrt()
        # A NaN counts as settled, and so does an ellipse that holds nothing back.
        unsettled = torch.where(mu > 0.0, excess.abs(), excess) > _SETTLED * bound
        inside = (newton > low) & (newton < high)
        near = ~unsettled & (mu > 0.0) & inside
        mu = torch.where(near, newton, torch.where(unsettled, torch.where(inside, newton, middle), mu))
        # Asking the device would cost more than it saves, and a graph cannot be captured with the question.
        if target.is_cpu and not unsettled.any():
            break
    return inner(mu * scale + shift), mu
