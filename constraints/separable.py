"""Scalar dual problems behind the closed forms: one row or one diagonal ellipse over a box, in batch.

Both minimise sum(metric a^2 / 2 - target a): metric 1 gives a projection, metric 0 a linear oracle.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_TINY = 1e-300
_HUGE = 1e150
_JUST_BELOW = 1.0 - 2.0**-52
# Newton needs 4 to 10 steps, rows with tied or degenerate gradients up to 30.
_MAX_STEPS = 40


class RowProblem:
    """min sum(metric a^2 / 2 - target a) subject to row.a <= bound and low <= a <= high, for any metric >= 0.

    All (..., d), bound (..., 1), which must be attainable. low and high do not cross 0 where the constraint has a kink.

    With a multiplier lam on the row, each coordinate stays at one end of its range until lam reaches `leave`, moves
    linearly, and stays at the other end from `arrive` on; where metric is 0 it jumps. row.a falls along lam, so the
    solution lies between the two of the 2d breakpoints whose row.a enclose the bound. The breakpoints `leave` are
    taken just before their value, so that a jump is interpolated like a move.
    """

    def __init__(self, target: Tensor, row: Tensor, bound: Tensor, low: Tensor, high: Tensor):
        self.target, self.row, self.bound, self.low, self.high = target, row, bound, low, high
        self._moving = row != 0.0
        falling = row > 0.0
        self._last = torch.where(falling, low, high)
        self._way_back = torch.where(falling, high, low) - self._last
        slope = torch.where(self._moving, row, 1.0)
        self._target_turn = (target / slope).clamp(-_HUGE, _HUGE)
        self._last_turn = (self._last / slope).clamp(-_HUGE, _HUGE)
        self._way_turn = (self._way_back / slope).clamp(-_HUGE, _HUGE)
        self._drop = (row * self._way_back).unsqueeze(-1)
        self._lowest = (row * self._last).sum(-1, keepdim=True)

    def solve(self, metric: Tensor) -> tuple[Tensor, Tensor]:
        """The solution (..., d), and the row where it holds the solution back, 0 elsewhere (..., d)."""
        free = torch.clamp(self.target / metric.clamp(min=_TINY), self.low, self.high)
        arrive = torch.addcmul(self._target_turn, metric, self._last_turn, value=-1.0)
        width = metric * self._way_turn
        leave = arrive - width
        turns = torch.cat((torch.zeros_like(self._lowest), leave * _JUST_BELOW, arrive), -1).clamp(min=0.0)
        ahead = arrive.unsqueeze(-2) - turns.unsqueeze(-1)
        ahead = ahead.div_(width.clamp(min=_TINY).unsqueeze(-2)).clamp_(0.0, 1.0)  # share of the way, (..., 2d + 1, d)

        value = (ahead @ self._drop).squeeze(-1) + self._lowest  # row.a at each breakpoint; the first has lam = 0
        # Enclosed by lam and not by value: breakpoints far apart may have values equal to rounding.
        over = value > self.bound
        upper = torch.where(over, turns, -torch.inf).argmax(-1, keepdim=True)
        lower = torch.where(over, torch.inf, turns).argmin(-1, keepdim=True)
        above, below = value.gather(-1, upper), value.gather(-1, lower)
        # Measured from below, a coordinate that the row presses against 0 keeps its relative precision.
        share = (self.bound - below) / (above - below).clamp(min=_TINY)
        start = ahead.take_along_dim(upper.unsqueeze(-1), -2).squeeze(-2)
        end = ahead.take_along_dim(lower.unsqueeze(-1), -2).squeeze(-2)
        held = torch.addcmul(self._last, torch.lerp(end, start, share), self._way_back)
        active = value[..., :1] > self.bound
        held_by = self.row * active
        return torch.where(held_by != 0.0, held, free), held_by

    def inside(self, solution: Tensor) -> Tensor:
        """Where a coordinate of the solution is strictly between low and high (..., d)."""
        return (solution > self.low) & (solution < self.high)

    def free(self, solution: Tensor, held_by: Tensor) -> Tensor:
        """Where a coordinate of the solution may move (..., d): neither at the box nor at an active kink.

        held_by (..., d): the row where it holds the solution back, 0 elsewhere.
        """
        return torch.where(held_by != 0.0, self.inside(solution), solution.abs() < 1.0)


InnerSolver = Callable[[Tensor], tuple[Tensor, Tensor, Tensor | None]]
"""Maps a metric (..., d) to the minimiser (..., d) over a polyhedron, where it moves with the metric (..., d), and the
row that holds it back, 0 where none does (..., d), or None where there is none at all."""


def minimize_under_ellipse(
    inner: InnerSolver, target: Tensor, shift: float, scale: Tensor, bound: float
) -> tuple[Tensor, Tensor]:
    """argmin (..., d) of sum(shift a^2 / 2 - target a) over `inner`'s polyhedron and sum(scale a^2) <= bound.

    scale (..., d) >= 0. The solution is `inner`'s for the metric shift + mu scale; also returns the ellipse's
    multiplier mu (..., 1), 0 where the ellipse does not hold the solution back.

    The dual function is concave in mu, so the ellipse's value falls along mu: Newton's method on 1 / sqrt(value of the
    free coordinates), which is linear in mu for a sphere, within a bracket. Since scale_i a_i <= |target_i| / mu, the
    multiplier is at most |target|_1 / bound.
    """
    high = target.abs().sum(-1, keepdim=True) / bound
    low = mu = torch.zeros_like(high)
    # Where Newton's step leaves the bracket, its geometric middle; the first such is at a guess for the ellipse alone.
    guess_square = (target.square() / scale.clamp(min=bound)).sum(-1, keepdim=True) / bound
    floor = guess_square / high.clamp(min=_TINY)
    for _ in range(_MAX_STEPS):
        metric = shift + mu * scale
        solution, free, row = inner(metric)
        pull = scale * solution
        energy = pull * solution
        excess = energy.sum(-1, keepdim=True) - bound
        # A NaN counts as settled.
        unsettled = torch.where(mu > 0.0, excess.abs(), excess) > 1e-13 * bound
        # Asking the device costs more than it saves on CUDA.
        if not target.is_cuda and not unsettled.any():
            break
        over = excess > 0.0
        low, high = torch.where(over, mu, low), torch.where(over, high, mu)
        curvature = free / metric.clamp(min=_TINY)
        bend = curvature * pull
        fall = (bend * pull).sum(-1, keepdim=True)
        if row is not None:
            lean = (bend * row).sum(-1, keepdim=True)
            fall = fall - lean.square() / (curvature * row.square()).sum(-1, keepdim=True).clamp(min=_TINY)
        moving = (free * energy).sum(-1, keepdim=True)
        newton = mu + moving / fall * ((moving / (moving - excess)).sqrt() - 1.0)
        middle = (torch.maximum(low, torch.minimum(floor, 1e-3 * high)) * high).sqrt()
        step = torch.where((newton > low) & (newton < high), newton, middle)
        mu = torch.where(unsettled, step, mu)
    return solution, mu
