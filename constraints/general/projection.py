"""Projection on sets of rows and ellipses, and the linear oracle of sets with ellipses.

- On rows alone: a dual active-set method, exact to rounding. It is faster than a loop over OSQP, and stays exact for
  points far away, where OSQP stops converging. Only a row whose own coefficients differ by a factor of 1e10 loses
  digits there: the error is up to 1e-9 times the distance.
- With ellipses: Newton's method, which finds the active constraints of most samples. If it fails, an interior-point
  method finds them, and Newton's method runs again, exact to rounding. If that fails too, sequential quadratic
  programming with the active-set method starts from the deepest point.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.errors import require
from constraints.general.active_set import project_on_rows
from constraints.general.depth import deepest_points
from constraints.general.interior_point import solve_cone_programs
from constraints.general.scaled_sets import ScaledSets, guessed_points
from constraints.numerics import one_where_zero, times

# The interior-point method's accuracy. Its multipliers only have to tell active constraints from others.
_ACCURACY = 1e-9
# Newton's method starts close to the solution: it converges in this many steps, or its active constraints are wrong.
_NEWTON_STEPS = 4
# From a guess, Newton's method may find the active constraints itself. After this many steps it hardly ever does.
_GUESSING_STEPS = 10
# Newton's error is about the square of its last step: after a step no longer than this, it is rounding.
_LAST_NEWTON_STEP = 1e-9
# A solution may leave the set by this much. `violation` reports it as rounding.
_OUTSIDE = 1e-12
# The most quadratic programs of one solution; 2 to 10 are enough in most cases.
_MAX_PROGRAMS = 60
# The longest last step with which a sample counts as solved. Convergence is quadratic, so its error is rounding.
_LAST_PROGRAM_STEP = 1e-9
# The linear oracle projects a point this far along the slope. One step leaves the square of the error over the step's
# length, so three steps are exact to rounding.
_PROXIMAL_STEP = 1e3
_PROXIMAL_STEPS = 3


def closest_points(sets: ScaledSets, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Closest points (n, d) to target (n, d), the Lagrangian's Hessian there (n, d, d), and multipliers (n, m + k)."""
    if not sets.curved:
        metric = torch.eye(sets.dim, dtype=target.dtype, device=target.device).expand(len(target), sets.dim, sets.dim)
        solution, multipliers = project_on_rows(sets.rows, sets.bounds, target, sets.name, sets.given_rows)
        return solution, metric, multipliers
    outside = (sets.depth(target) < 0.0).nonzero().squeeze(-1)
    solution = target.clone()
    multipliers = target.new_zeros(len(target), sets.rows.shape[1] + sets.matrix.shape[1])
    if len(outside) > 0:
        part, aim = sets[outside], target[outside]
        point, exact, done = _newton(part, aim, *_first_guess(part, aim), guess=True)
        left = (~done).nonzero().squeeze(-1)
        if len(left) > 0:
            point[left], exact[left] = optimal_points(part[left], aim[left], linear=False)
        solution[outside], multipliers[outside] = point, exact
    return solution, _hessian(sets, multipliers), multipliers


def optimal_points(sets: ScaledSets, aim: Tensor, linear: bool) -> tuple[Tensor, Tensor]:
    """Optima (n, d) of sets with ellipses, exact to rounding, and the multipliers (n, m + k) of their projection.

    If `linear`, they are the points with the largest product with `aim` (n, d), otherwise those nearest to it.
    """
    target, point, multipliers = _near_optimum(sets, aim, linear, guessed_points(sets))
    solution, exact, done = _newton(sets, target, point, multipliers)
    left = (~done).nonzero().squeeze(-1)
    if len(left) > 0:
        # Start from the deepest point, as a start near the boundary may be the cause. A set without interior raises an
        # EmptySetError here.
        part = sets[left]
        inside = deepest_points(part)
        target, point, multipliers = _near_optimum(part, aim[left], linear, inside)
        for _ in range(_PROXIMAL_STEPS if linear else 1):
            point, exact[left] = _sequential_programs(part, target, point, multipliers)
            target, multipliers = point + _PROXIMAL_STEP * aim[left], exact[left]
        solution[left] = _pull_towards(part, inside, point)
    return solution, exact


def _near_optimum(sets: ScaledSets, aim: Tensor, linear: bool, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The target (n, d) whose projection is the optimum, an approximation of it and its multipliers (n, m + k)."""
    if linear:
        point, multipliers = _minimize_quadratic(sets, start, torch.zeros_like(aim[:, :1]), aim)
        return point + _PROXIMAL_STEP * aim, point, _PROXIMAL_STEP * multipliers
    distance = torch.linalg.vector_norm(aim - start, dim=-1, keepdim=True).maximum(1.0 / sets.inverse_size())
    point, multipliers = _minimize_quadratic(sets, start, 1.0 / distance, (aim - start) / distance)
    return aim, point, distance * multipliers


def _minimize_quadratic(sets: ScaledSets, start: Tensor, curvature: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """argmin a (n, d) of curvature |a - start|^2 / 2 - <gradient, a> over sets with ellipses; multipliers (n, m + k).

    Solved for y = size (a - start), in which the smallest ellipse is of order 1.
    """
    size = sets.inverse_size()
    bounds = size * (sets.bounds - times(sets.rows, start))
    matrix, offset = sets.as_cones(start, size)
    zero = torch.zeros_like(start)
    curvature = curvature / size
    point, dual, _ = solve_cone_programs(curvature, gradient, sets.rows, bounds, matrix, offset, zero, _ACCURACY)
    # Back to units of a. An ellipse bounds the square of what its cone bounds, hence half.
    m = sets.rows.shape[1]
    return start + point / size, torch.cat((dual[:, :m], 0.5 * dual[:, m:] / size), -1)


def _first_guess(sets: ScaledSets, target: Tensor) -> tuple[Tensor, Tensor]:
    """A point (n, d) near the projection of the target (n, d), and a guess of the multipliers (n, m + k).

    The target is clamped to the box, then moved towards the centre of the ellipse whose bound it exceeds most, onto
    that ellipse.
    """
    point = target.clamp(-1.0, 1.0)
    value = sets.ellipse_values(point)[0]
    largest, first = value.max(-1, keepdim=True)
    center = sets.center.take_along_dim(first.unsqueeze(-1), 1).squeeze(1)
    point = torch.lerp(center, point, largest.clamp(min=1.0).rsqrt())
    normal = sets.ellipse_values(point)[1].take_along_dim(first.unsqueeze(-1), 1).squeeze(1)
    size = one_where_zero(normal.square().sum(-1, keepdim=True))
    weight = ((target - point) * normal).sum(-1, keepdim=True).clamp(min=0.0) / size
    multipliers = target.new_zeros(len(target), sets.rows.shape[1] + value.shape[-1])
    return point, multipliers.scatter(-1, sets.rows.shape[1] + first, torch.where(largest > 1.0, weight, 0.0))


def _newton(
    sets: ScaledSets, target: Tensor, point: Tensor, multipliers: Tensor, guess: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method on the optimality conditions, with the constraints active whose multiplier exceeds their slack.

    The active constraints are those of the start or, if the start is a `guess`, those of each step. Returns point,
    multipliers, and whether (n,) these are the solution.
    """
    d = sets.dim
    active = multipliers > sets.slack(point)[0]
    for number in range(_GUESSING_STEPS if guess else _NEWTON_STEPS):
        slack, normals = sets.slack(point)
        if guess:
            active = multipliers > slack
        if number == 0 or guess:
            slot = active.long().argsort(dim=-1, descending=True, stable=True)[:, : min(d, active.shape[-1])]
            used = active.gather(-1, slot)
            idle = torch.diag_embed((~used).to(point.dtype))
            multipliers = torch.where(active, multipliers, 0.0)
        normals = normals.take_along_dim(slot.unsqueeze(-1), 1) * used.unsqueeze(-1)
        top = torch.cat((_hessian(sets, multipliers), normals.mT), -1)
        system = torch.cat((top, torch.cat((normals, -idle), -1)), 1)
        # Solve for the change of the multipliers: for far points the multipliers are large, and so is their rounding.
        held = multipliers.gather(-1, slot) * used
        rest = target - point - times(normals.mT, held)
        right = torch.cat((rest, slack.gather(-1, slot) * used), -1)
        step = torch.linalg.solve_ex(system, right.unsqueeze(-1))[0].squeeze(-1)
        point = point + step[:, :d]
        multipliers = torch.zeros_like(multipliers).scatter(-1, slot, held + step[:, d:] * used)
        moved = step[:, :d].abs().amax(-1)
        if guess and bool((moved <= _LAST_NEWTON_STEP).all()):
            break
    feasible = sets.depth(point) >= -_OUTSIDE
    right_set = (active.sum(-1) <= d) & (multipliers >= 0.0).all(-1)
    # A singular system may have answered with a small step that solves nothing.
    rest = (target - point - times(sets.slack(point)[1].mT, multipliers)).abs().amax(-1)
    stationary = rest <= _LAST_NEWTON_STEP * (1.0 + target.abs().amax(-1))
    return point, multipliers, (moved <= _LAST_NEWTON_STEP) & feasible & right_set & stationary


def _sequential_programs(sets: ScaledSets, target: Tensor, point: Tensor, multipliers: Tensor) -> tuple[Tensor, Tensor]:
    """Sequential quadratic programming, which finds the active constraints by itself.

    A ConstraintError names a sample that does not converge.
    """
    for _ in range(_MAX_PROGRAMS):
        root = torch.linalg.cholesky(_hessian(sets, multipliers))
        limits, normals = sets.slack(point)
        normals = torch.linalg.solve_triangular(root, normals.mT, upper=False).mT
        norm = one_where_zero(normals.norm(dim=-1))
        goal = torch.linalg.solve_triangular(root, (target - point).unsqueeze(-1), upper=False).squeeze(-1)
        step, multipliers = project_on_rows(normals / norm.unsqueeze(-1), limits / norm, goal, sets.name, 0)
        step = torch.linalg.solve_triangular(root.mT, step.unsqueeze(-1), upper=True).squeeze(-1)
        point, multipliers = point + step, multipliers / norm
        length = step.abs().amax(-1)
        if bool((length <= _LAST_PROGRAM_STEP).all()):
            break
    require(length <= _LAST_PROGRAM_STEP, "the closest point was not found", sets.name)
    return point, multipliers


def _hessian(sets: ScaledSets, multipliers: Tensor) -> Tensor:
    """Hessian (n, d, d) of the projection's Lagrangian for the multipliers (n, m + k)."""
    curvature = multipliers[:, sets.rows.shape[1] :, None, None] * sets.matrix
    return torch.eye(sets.dim, dtype=multipliers.dtype, device=multipliers.device) + 2.0 * curvature.sum(1)


def _pull_towards(sets: ScaledSets, inside: Tensor, point: Tensor) -> Tensor:
    """The point (n, d), moved towards the interior point `inside` where it leaves the set by more than `_OUTSIDE`."""
    # The excess is first order in the distance moved, and convexity makes the step an upper bound on what is needed.
    rows = times(sets.rows, point) - sets.bounds
    ellipses, value = sets.ellipse_values(point)[0], sets.ellipse_values(inside)[0]
    room = torch.cat((sets.bounds - times(sets.rows, inside), 1.0 - value), -1)
    excess = torch.cat((rows, ellipses - 1.0), -1).clamp(min=0.0)
    share = torch.where(excess > 0.0, excess / (excess + room), 0.0).amax(-1)
    share = torch.where(sets.depth(point) < -_OUTSIDE, share, 0.0)
    return torch.lerp(point, inside, share.unsqueeze(-1))
