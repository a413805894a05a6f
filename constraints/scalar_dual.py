"""Scalar dual problems behind the closed forms: one row or one diagonal ellipse over a box, in batch.

Both minimise sum(metric a^2 / 2 - target a): metric 1 gives a projection, metric 0 a linear oracle. Coordinates are
mirrored and shifted so that each runs from 0 and no weight is negative.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_TINY = 1e-300  # replaces a divisor of 0
_HUGE = 1e100  # replaces an infinite multiplier
_LEAST_WEIGHT = 1e-30  # counts as 0 but keeps quotients finite
_LEAST_METRIC = 1e-150  # metric of a coordinate that jumps; squares of its inverse stay finite
_LEAST_MULTIPLIER = 1e-100  # a Newton step from 0 to below this has no slope
_JUST_BELOW = 1.0 - 2.0**-52
_MAX_STEPS = 40  # Newton needs 3 to 10; rows with tied or degenerate gradients up to 30
_SETTLED = 1e-10  # relative excess below which one more Newton step is exact


class RowProblem:
    """min sum(metric a^2 / 2 - target a) subject to weight.a <= bound and 0 <= a <= top, for any metric >= 0.

    target and weight >= 0 (..., d); bound >= 0 is a number or (..., 1); top is a number.

    With a multiplier lam on the row, each coordinate stays at `top` until lam reaches `leave`, then falls linearly to 0
    at `arrive` and stays there; with metric 0 it jumps. weight.a falls with lam. Of the 2d breakpoints, two neighbours
    have values of weight.a that enclose the bound; the solution lies between them. The breakpoints `leave` are set just
    below their exact values, so that interpolation treats a jump like a fall.
    """

    def __init__(self, target: Tensor, weight: Tensor, bound: Tensor | float, top: float = 1.0):
        self.target, self.weight, self.bound, self.top = target, weight, bound, top
        least = weight.clamp(min=_LEAST_WEIGHT)
        self._fall = top / least
        self._arrive = (target / least).clamp_(-_HUGE, _HUGE)
        self._from = self._arrive.unsqueeze(-2)
        self._drop = (weight if top == 1.0 else weight * top).unsqueeze(-2)

    def solve(self, metric: Tensor | float | None = None) -> RowSolution:
        """The solution for a metric (..., d) or a number >= 0; None stands for 1."""
        width = self._fall if metric is None else (self._fall * metric).clamp_(min=_TINY)
        over_width = width.unsqueeze(-2)
        leave = (self._arrive - width).mul_(_JUST_BELOW)
        turns = torch.cat((leave, self._arrive), -1).clamp_(min=0.0)
        value = (self._shares(turns, over_width) * self._drop).sum(-1)  # weight.a at each breakpoint
        # lam orders the breakpoints, not the value: distant breakpoints may have values that are equal up to rounding.
        over = value > self.bound
        last_over = (turns * over).amax(-1, keepdim=True)
        first_under = turns.masked_fill(over, _HUGE).amin(-1, keepdim=True)
        ends = self._shares(torch.cat((last_over, first_under), -1), over_width)
        start, end = ends.unbind(-2)
        above, below = (ends * self._drop).sum(-1, keepdim=True).unbind(-2)
        # Interpolate from below: a coordinate that the row presses against 0 keeps its relative precision.
        part = (self.bound - below) / (above - below).clamp_(min=_TINY)
        return RowSolution(self, torch.lerp(end, start, part.clamp_(max=1.0)), above > self.bound)

    def _shares(self, multiplier: Tensor, over_width: Tensor) -> Tensor:
        """The share of its range (..., k, d) that the multipliers (..., k) leave to each coordinate."""
        return (self._from - multiplier.unsqueeze(-1)).div_(over_width).clamp_(0.0, 1.0)


class RowSolution(NamedTuple):
    """Minimiser of a RowProblem."""

    problem: RowProblem
    share: Tensor  # (..., d) of each coordinate's range
    held: Tensor  # (..., 1) whether the row holds it back

    @property
    def point(self) -> Tensor:
        """The minimiser (..., d)."""
        return self.share if self.problem.top == 1.0 else self.share * self.problem.top

    def moves(self) -> Tensor:
        """Which coordinates (..., d) move with their target. A coordinate at 0 moves unless the row presses it."""
        rests = (self.problem.target >= 0.0) & ~self.held
        return ((self.share > 0.0) | rests) & (self.share < 1.0)

    def row(self) -> Tensor:
        """The row (..., d) where it holds the minimiser back, 0 elsewhere."""
        return self.problem.weight * self.held


class BoxProblem:
    """min sum(metric a^2 / 2 - target a) subject to 0 <= a <= 1: a RowProblem without its row."""

    def __init__(self, target: Tensor):
        self.target = target

    def solve(self, metric: Tensor) -> BoxSolution:
        """The solution for a metric (..., d) >= 0."""
        return BoxSolution((self.target / metric.clamp(min=_TINY)).clamp_(max=1.0))


class BoxSolution(NamedTuple):
    """Minimiser of a BoxProblem, to be used like a RowSolution."""

    point: Tensor  # (..., d)

    def moves(self) -> Tensor:
        """Which coordinates (..., d) move with their target."""
        return self.point < 1.0

    def row(self) -> Tensor:
        """Zeros (..., d)."""
        return torch.zeros_like(self.point)


def minimize_under_ellipse(
    problem: RowProblem | BoxProblem, shift: float, scale: Tensor, bound: Tensor | float
) -> tuple[Tensor, RowSolution | BoxSolution, Tensor]:
    """Minimiser of sum(shift a^2 / 2 - target a) over the problem's set and sum(scale a^2) <= bound.

    scale (..., d) >= 0, target >= 0. The minimiser is the problem's solution for the metric shift + mu scale. Returns
    the minimiser (..., d), that solution with the active constraints, and the ellipse's multiplier mu (..., 1), 0 if
    the ellipse is not active.

    The dual function is concave in mu, so the ellipse's value falls with mu. Within a bracket, Newton's method finds
    the mu at which the value equals the bound. It is applied to 1 / sqrt(value of the free coordinates), which is
    linear in mu for a sphere. Since scale_i a_i <= target_i / mu, the multiplier is at most |target|_1 / bound.
    """
    target = problem.target
    high = target.sum(-1, keepdim=True) / bound
    low = mu = torch.zeros_like(high)
    # Where Newton's step leaves the bracket, the geometric middle replaces it. The first middle is a guess for the
    # ellipse alone.
    guess_square = (target.square() / scale.clamp(min=bound)).sum(-1, keepdim=True) / bound
    floor = guess_square / high.clamp(min=_TINY)
    for _ in range(_MAX_STEPS):
        metric = mu * scale + shift
        solution = problem.solve(metric)
        point, row = solution.point, solution.row()
        pull = scale * point
        energy = pull * point
        excess = energy.sum(-1, keepdim=True) - bound
        # An inactive ellipse closes its bracket at mu = 0.
        over = excess > 0.0
        low, high = torch.where(over, mu, low), torch.where(over, high, mu)

        free = (point > 0.0) & (point < 1.0)
        softness = free / metric.clamp_(min=_LEAST_METRIC)
        soft_row = softness * row
        tilt = (soft_row * pull).sum(-1, keepdim=True) / (soft_row * row).sum(-1, keepdim=True).clamp_(min=_TINY)
        fall = softness * (pull - tilt * row)  # of the point along mu, with the row's multiplier
        moving = (energy * free).sum(-1, keepdim=True)
        rate = moving / (fall * pull).sum(-1, keepdim=True)
        newton = torch.addcmul(mu, rate, (moving / (moving - excess)).sqrt_() - 1.0)
        middle = (torch.maximum(low, torch.minimum(floor, 1e-3 * high)) * high).sqrt_()
        unsettled = (excess.abs() > _SETTLED * bound) & (high > 0.0)
        # A jump has no slope at mu = 0: Newton's step from there ends next to 0.
        better = (newton > low + _LEAST_MULTIPLIER) & (newton < high)
        following = torch.where(better, newton, torch.where(unsettled, middle, mu))
        step, mu = (following - mu).masked_fill(unsettled, 0.0), following
        # A GPU takes all steps: waiting for its answer costs more than it saves and cannot be part of a CUDA graph.
        if target.is_cpu and not unsettled.any():
            break
    # The last step is so small that its first order is exact.
    point = (point - step * fall).clamp_(0.0, 1.0)
    if not target.is_cpu or unsettled.any():
        # Where the gradient of an oracle ties with the row, the value jumps over the bound. The minimiser lies between
        # the two sides of the jump.
        start, end = (problem.solve(multiplier * scale + shift).point for multiplier in (low, high))
        way = start - end
        lean, size = (scale * end * way).sum(-1, keepdim=True), (scale * way.square()).sum(-1, keepdim=True)
        slack = (bound - (scale * end.square()).sum(-1, keepdim=True)).clamp_(min=0.0)
        share = slack / (lean + (lean.square() + size * slack).sqrt_()).clamp_(min=_TINY)
        point = torch.where(unsettled, end + share.clamp_(0.0, 1.0) * way, point)
    return point, solution, mu
