"""What sets given by rows and ellipses share: projection, centre and linear oracle by general methods.

- Projection on rows alone: a dual active-set method, exact to rounding. It is several times faster than an OSQP loop,
  and stays exact for points far away, where OSQP stops converging.
- Projection and linear oracle with ellipses: an interior-point method, then Newton's method on the constraints that it
  found active, exact to rounding. Where that is not the solution, sequential quadratic programming with the active-set
  method, from the deepest point.
- Linear oracle and Chebyshev centre on rows alone: HiGHS, the whole batch as one block-diagonal linear program.
- Deepest point with ellipses: the interior-point method.

All of it runs on the CPU in float64, wherever the tensors are.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from constraints.active_set import EMPTY, project_on_rows
from constraints.base import Constraint, JacobianProduct, box_gauge_gradient, largest_gauge
from constraints.errors import ConstraintError, SampleName, name_samples, require
from constraints.interior_point import minimize

# A centre given for a gauge that is nearer than this to the boundary is on it, up to rounding.
ON_BOUNDARY = 1e-12
# A centre nearer to the boundary than this gives way to the deepest point.
_NEAR_BOUNDARY = 1e-6
# A set whose deepest point is no deeper than this has no interior.
_NO_INTERIOR = 1e-9
# Constraints this near to the solution are active.
_ACTIVE = 1e-9
_NEWTON_STEPS = 4
_PROGRAMS = 60  # mostly 2 to 10 are enough
_CONVERGED = 1e-9  # a last step of quadratic convergence
_PROXIMAL_STEP = 1e3
_PROXIMAL_STEPS = 3
_LARGEST_PROGRAM = 20_000  # rows of one block-diagonal linear program


@dataclass(frozen=True)
class _Sets:
    """n sets: rows (n, m, d) @ a <= bounds (n, m), with unit rows and the box's last, and k ellipses
    (a - center)' matrix (a - center) <= 1, with `root` the square root of the bound that goes with tr Q = d."""

    rows: Tensor
    bounds: Tensor
    matrix: Tensor  # (n, k, d, d)
    center: Tensor  # (n, k, d)
    root: Tensor  # (n, k)
    name: SampleName

    @property
    def dim(self) -> int:
        return self.rows.shape[-1]

    @property
    def given_rows(self) -> int:
        return self.rows.shape[1] - 2 * self.dim

    @property
    def curved(self) -> bool:
        return self.matrix.shape[1] > 0

    def __getitem__(self, index: Tensor) -> _Sets:
        positions = index.tolist()
        return _Sets(
            self.rows[index],
            self.bounds[index],
            self.matrix[index],
            self.center[index],
            self.root[index],
            lambda i: self.name(positions[i]),
        )

    def ellipse_values(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Values (n, k) of the ellipses at the point (n, d), inside where <= 1, and their gradients (n, k, d)."""
        offset = point.unsqueeze(1) - self.center
        bent = _times(self.matrix, offset)
        return (bent * offset).sum(-1), 2.0 * bent

    def depth(self, point: Tensor) -> Tensor:
        """Distance (n,) to the nearest constraint, in the units of `Constraint.violation`; negative outside."""
        solid = self.rows.abs().amax(-1) > 0.0
        slack = self.bounds - _times(self.rows, point)
        depths = [torch.where(solid | (slack < 0.0), slack, torch.inf)]
        if self.curved:
            value = self.ellipse_values(point)[0].clamp(min=0.0)
            depths.append(self.root * (1.0 - value.sqrt()))
        return torch.cat(depths, -1).amin(-1)


class GeneralConstraint(Constraint):
    """A set that `explicit(obs)` writes out. A subclass adds `_violation`, `_penalty` and `_gauge_gradients`."""

    origin_centered = False
    solved_on_cpu = True

    @abstractmethod
    def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        """Gradients (..., d) of the gauges of the parts, the box left out."""

    def _gauge_and_gradient(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> tuple[Tensor, Tensor]:
        if center is not None:
            inside = center.abs().amax(-1) < 1.0 - ON_BOUNDARY
            require(inside.flatten(), "the centre is not inside the box", name_samples(tuple(inside.shape)))
            center = center.expand_as(direction)
        box = box_gauge_gradient(direction, center)
        return largest_gauge(direction, box, *self._gauge_gradients(obs, direction, center))

    def _project(self, obs: Tensor, action: Tensor) -> tuple[Tensor, JacobianProduct]:
        sets = self._sets(obs, action.shape[:-1])
        target = action.reshape(-1, self.dim).cpu()
        finite = target.isfinite().all(-1, keepdim=True)
        solution, metric, multipliers = _project(sets, torch.where(finite, target, 0.0))

        def product(vector: Tensor) -> Tensor:
            jacobian = _jacobian(sets, solution, metric, multipliers)
            return _times(jacobian, vector.reshape(-1, self.dim).cpu()).view(vector.shape).to(vector)

        # There is no closest point to an infinite one.
        answer = torch.where(finite, solution, torch.nan)
        return answer.view(action.shape).to(action.device), product

    def _linear_oracle(self, obs: Tensor, gradient: Tensor) -> Tensor:
        sets = self._sets(obs, gradient.shape[:-1])
        slope = gradient.reshape(-1, self.dim).cpu()
        size = slope.abs().amax(-1, keepdim=True)
        finite = size.isfinite()
        slope = torch.where(finite & (size > 0.0), slope / size, 0.0)
        solution = _optimum(sets, slope, linear=True)[0] if sets.curved else _maximize_on_rows(sets, slope)
        return torch.where(finite, solution, torch.nan).view(gradient.shape).to(gradient.device)

    def _center(self, obs: Tensor) -> Tensor:
        sets = self._sets(obs, obs.shape[:-1])
        center = _interior(sets) if sets.curved else _chebyshev(sets)
        return center.view(*obs.shape[:-1], self.dim).to(obs.device)

    def _sets(self, obs: Tensor, lead: tuple[int, ...]) -> _Sets:
        """The sets of a batch of shape `lead`, flattened, checked and scaled."""
        rows, bounds, ellipses = self.explicit(obs)
        d = self.dim
        rows, bounds = unit_rows(rows, bounds)
        m = rows.shape[-2]
        count = math.prod(lead)
        rows = rows.expand(*lead, m, d).reshape(count, m, d).cpu()
        bounds = bounds.expand(*lead, m).reshape(count, m).cpu()
        # What no point of the box meets; the face of it that a row just touches is left.
        reach = rows.abs().sum(-1)
        met = torch.where(reach > 0.0, bounds >= -reach - EMPTY, bounds >= 0.0)
        require(met, "the set is empty", name_samples(tuple(lead)))
        # 0 <= 0 holds everywhere, with slack.
        bounds = torch.where((rows == 0.0).all(-1) & (bounds == 0.0), 1.0, bounds)
        faces = torch.eye(d, dtype=rows.dtype).expand(len(rows), d, d)
        rows = torch.cat((rows, faces, -faces), 1)
        bounds = torch.cat((bounds, torch.ones(len(rows), 2 * d, dtype=rows.dtype)), 1)
        scaled = []
        for matrix, center, bound in ellipses:
            bound = torch.as_tensor(bound, dtype=rows.dtype, device=obs.device)
            trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
            root = torch.where(trace > 0.0, bound * d / trace, torch.inf).sqrt()
            matrix = matrix / bound[..., None, None]
            scaled.append(
                (
                    matrix.expand(*lead, d, d).reshape(-1, d, d).cpu(),
                    center.expand(*lead, d).reshape(-1, d).cpu(),
                    root.expand(lead).reshape(-1).cpu(),
                )
            )
        if scaled:
            matrices, centers, roots = (torch.stack(part, 1) for part in zip(*scaled, strict=True))
        else:
            matrices, centers, roots = (rows.new_zeros(len(rows), 0, *shape) for shape in ((d, d), (d,), ()))
        return _Sets(rows, bounds, matrices, centers, roots, name_samples(tuple(lead)))


def check_obs(obs: Tensor) -> None:
    """Raises a ConstraintError for a NaN or infinite observation."""
    valid = obs.isfinite().all(-1)
    require(valid.flatten(), "the observation is NaN or infinite", name_samples(tuple(valid.shape)))


def checked(values: Tensor | float, what: str, shape: tuple[int, ...], obs: Tensor) -> Tensor:
    """Coefficients as float64 (*lead, *shape), finite and of the expected shape, or a ConstraintError.

    -1 in `shape` stands for any size; lead may be the observation's leading shape or one that broadcasts to it.
    """
    values = torch.as_tensor(values, dtype=torch.float64, device=obs.device).detach()
    lead = values.shape[: values.dim() - len(shape)]
    fits = len(values.shape) >= len(shape) and all(
        have == want or want == -1 for have, want in zip(values.shape[len(lead) :], shape, strict=True)
    )
    try:
        fits = fits and torch.broadcast_shapes(lead, obs.shape[:-1]) == obs.shape[:-1]
    except RuntimeError:
        fits = False
    if not fits:
        wanted = ", ".join(["..."] + ["m" if size == -1 else str(size) for size in shape])
        raise ConstraintError(
            f"{what} has shape {tuple(values.shape)}, expected ({wanted}) with ... = {tuple(obs.shape[:-1])}"
        )
    valid = values.isfinite().flatten(len(lead)).all(-1) if shape else values.isfinite()
    require(valid.flatten(), f"{what} is NaN or infinite", name_samples(tuple(lead)))
    return values


def unit_rows(rows: Tensor, bounds: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (..., m, d) scaled to unit norm with their bounds (..., m); a zero row stays as it is."""
    # In two steps, so that squares stay in range.
    for norm in (rows.abs().amax(-1), (rows / _nonzero(rows.abs().amax(-1)).unsqueeze(-1)).norm(dim=-1)):
        norm = _nonzero(norm)
        rows, bounds = rows / norm.unsqueeze(-1), bounds / norm
    return rows, bounds.clamp(-1e150, 1e150)


def _nonzero(norm: Tensor) -> Tensor:
    return torch.where(norm > 0.0, norm, 1.0)


# -------------------------------------------------------------------- projection


def _project(sets: _Sets, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Closest points (n, d), Hessian of the Lagrangian there (n, d, d), multipliers of rows and ellipses (n, m + k)."""
    if not sets.curved:
        metric = torch.eye(sets.dim, dtype=target.dtype).expand(len(target), sets.dim, sets.dim)
        solution, multipliers = project_on_rows(sets.rows, sets.bounds, target, sets.name, sets.given_rows)
        return solution, metric, multipliers
    outside = (sets.depth(target) < 0.0).nonzero().squeeze(-1)
    solution = target.clone()
    multipliers = target.new_zeros(len(target), sets.rows.shape[1] + sets.matrix.shape[1])
    if len(outside) > 0:
        solution[outside], multipliers[outside] = _optimum(sets[outside], target[outside], linear=False)
    return solution, _metric(sets, multipliers), multipliers


def _optimum(sets: _Sets, aim: Tensor, linear: bool) -> tuple[Tensor, Tensor]:
    """Of sets with ellipses, the points (n, d) with the largest product with `aim` (n, d) or, unless linear, those
    nearest to it, exact to rounding, and the multipliers (n, m + k) of the latter."""
    target, point, multipliers = _near_optimum(sets, aim, linear, _guess(sets))
    solution, exact, done = _newton(sets, target, point, multipliers)
    left = (~done).nonzero().squeeze(-1)
    if len(left) > 0:
        # From the deepest point: a start near the boundary may be what went wrong. Raises where there is no interior.
        part = sets[left]
        inside = _deepest(part)
        target, point, multipliers = _near_optimum(part, aim[left], linear, inside)
        for _ in range(_PROXIMAL_STEPS if linear else 1):
            point, exact[left] = _sequential_programs(part, target, point, multipliers)
            target, multipliers = point + _PROXIMAL_STEP * aim[left], exact[left]
        solution[left] = _pull_towards(part, inside, point)
    return solution, exact


def _near_optimum(sets: _Sets, aim: Tensor, linear: bool, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What to project for the optimum (n, d), an approximation of it and its multipliers (n, m + k)."""
    if linear:
        point, multipliers = _minimize(sets, start, torch.zeros_like(aim[:, :1]), aim)
        # A step of the proximal point method: what is left of the error is its square over the step.
        return point + _PROXIMAL_STEP * aim, point, _PROXIMAL_STEP * multipliers
    distance = torch.linalg.vector_norm(aim - start, dim=-1, keepdim=True).maximum(1.0 / _size(sets))
    point, multipliers = _minimize(sets, start, 1.0 / distance, (aim - start) / distance)
    return aim, point, distance * multipliers


def _newton(sets: _Sets, target: Tensor, point: Tensor, multipliers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method on the optimality conditions, if the active constraints are those whose multiplier exceeds their
    slack; point, multipliers and whether (n,) that was right."""
    d = sets.dim
    active = multipliers > _slack(sets, point)[0]
    slot = active.long().argsort(dim=-1, descending=True, stable=True)[:, :d]
    used = active.gather(-1, slot)
    idle = torch.diag_embed((~used).to(point.dtype))
    multipliers = torch.where(active, multipliers, 0.0)
    for _ in range(_NEWTON_STEPS):
        slack, normals = _slack(sets, point)
        normals = normals.take_along_dim(slot.unsqueeze(-1), 1) * used.unsqueeze(-1)
        top = torch.cat((_metric(sets, multipliers), normals.mT), -1)
        system = torch.cat((top, torch.cat((normals, -idle), -1)), 1)
        # For the change of the multipliers: those of points far away are large, and so is their rounding.
        held = multipliers.gather(-1, slot) * used
        stationary = target - point - _times(normals.mT, held)
        right = torch.cat((stationary, slack.gather(-1, slot) * used), -1)
        step = torch.linalg.solve_ex(system, right.unsqueeze(-1))[0].squeeze(-1)
        point = point + step[:, :d]
        multipliers = torch.zeros_like(multipliers).scatter(-1, slot, held + step[:, d:] * used)
    # Newton's error is of the order of its last step's square.
    near = step[:, :d].abs().amax(-1) <= 1e-9
    feasible = sets.depth(point) >= -1e-12
    right_set = (active.sum(-1) <= d) & (multipliers >= 0.0).all(-1)
    return point, multipliers, near & feasible & right_set


def _slack(sets: _Sets, point: Tensor) -> tuple[Tensor, Tensor]:
    """Slacks (n, m + k) of rows and ellipses, and the gradients (n, m + k, d) of what they bound."""
    value, gradient = sets.ellipse_values(point)
    return torch.cat((sets.bounds - _times(sets.rows, point), 1.0 - value), -1), torch.cat((sets.rows, gradient), 1)


def _sequential_programs(sets: _Sets, target: Tensor, point: Tensor, multipliers: Tensor) -> tuple[Tensor, Tensor]:
    """Sequential quadratic programming, which finds the active constraints by itself. A ConstraintError names a sample
    that does not converge."""
    for _ in range(_PROGRAMS):
        root = torch.linalg.cholesky(_metric(sets, multipliers))
        limits, normals = _slack(sets, point)
        normals = torch.linalg.solve_triangular(root, normals.mT, upper=False).mT
        norm = _nonzero(normals.norm(dim=-1))
        goal = torch.linalg.solve_triangular(root, (target - point).unsqueeze(-1), upper=False).squeeze(-1)
        step, multipliers = project_on_rows(normals / norm.unsqueeze(-1), limits / norm, goal, sets.name, 0)
        step = torch.linalg.solve_triangular(root.mT, step.unsqueeze(-1), upper=True).squeeze(-1)
        point, multipliers = point + step, multipliers / norm
        length = step.abs().amax(-1)
        if bool((length <= 1e-14).all()):
            break
    require(length <= _CONVERGED, "the closest point was not found", sets.name)
    return point, multipliers


def _metric(sets: _Sets, multipliers: Tensor) -> Tensor:
    """Hessian (n, d, d) of the projection's Lagrangian for the multipliers (n, m + k)."""
    curvature = multipliers[:, sets.rows.shape[1] :, None, None] * sets.matrix
    return torch.eye(sets.dim, dtype=multipliers.dtype) + 2.0 * curvature.sum(1)


def _jacobian(sets: _Sets, solution: Tensor, metric: Tensor, multipliers: Tensor) -> Tensor:
    """Jacobian (n, d, d) of the projection: the metric's inverse on the subspace that the active constraints leave.

    Active constraints without multiplier do not count (a kink), unless they only leave room within the subspace of
    those that they all hold: then none of them can open, as in the apex of a pyramid.
    """
    value, gradient = sets.ellipse_values(solution)
    length = _nonzero(gradient.norm(dim=-1))
    normals = torch.cat((sets.rows, gradient / length.unsqueeze(-1)), 1)
    slack = torch.cat((sets.bounds - _times(sets.rows, solution), (1.0 - value) / length), 1)
    holding = multipliers > 0.0
    free = _null_projector(normals, holding)
    other = (slack <= _ACTIVE) & ~holding
    residual = (normals @ free) * other.unsqueeze(-1)
    residual = torch.where(residual.norm(dim=-1, keepdim=True) > 1e-6, residual, 0.0)
    degenerate = ((residual != 0.0).any(-1).sum(-1) > 1).nonzero().squeeze(-1)
    if len(degenerate) > 0:
        for i in degenerate.tolist():
            holding[i] |= _pinned(residual[i])
        free[degenerate] = _null_projector(normals[degenerate], holding[degenerate])
    identity = torch.eye(sets.dim, dtype=solution.dtype)
    return free @ torch.linalg.solve(free @ metric @ free + identity - free, free)


def _null_projector(normals: Tensor, holding: Tensor) -> Tensor:
    """Projector (n, d, d) on the space orthogonal to the rows of normals (n, m, d) where holding (n, m)."""
    count = int(holding.sum(-1).max()) if holding.numel() > 0 else 0
    first = holding.long().argsort(dim=-1, descending=True, stable=True)[:, :count]
    held = normals.take_along_dim(first.unsqueeze(-1), 1) * holding.gather(-1, first).unsqueeze(-1)
    _, size, axes = torch.linalg.svd(held, full_matrices=False)
    axes = axes * (size > 1e-7).unsqueeze(-1)
    return torch.eye(normals.shape[-1], dtype=normals.dtype) - axes.mT @ axes


def _pinned(normals: Tensor) -> Tensor:
    """Which of the normals (m, d) all v with normals @ v <= 0 are orthogonal to: -normal is a sum of the others."""
    from scipy.optimize import nnls

    pinned = torch.zeros(len(normals), dtype=torch.bool)
    present = (normals != 0.0).any(-1).nonzero().squeeze(-1)
    cone = normals[present].T.numpy()
    for i in present.tolist():
        wanted = -normals[i].numpy()
        pinned[i] = bool(nnls(cone, wanted)[1] <= 1e-7 * np.linalg.norm(wanted))
    return pinned


def _pull_towards(sets: _Sets, inside: Tensor, point: Tensor) -> Tensor:
    """Removes a rounding excess by moving towards the interior point `inside`."""
    # The excess is first order in the distance moved, and convexity makes the step an upper bound on what is needed.
    rows = _times(sets.rows, point) - sets.bounds
    ellipses, value = sets.ellipse_values(point)[0], sets.ellipse_values(inside)[0]
    room = torch.cat((sets.bounds - _times(sets.rows, inside), 1.0 - value), -1)
    excess = torch.cat((rows, ellipses - 1.0), -1).clamp(min=0.0)
    share = torch.where(excess > 0.0, excess / (excess + room), 0.0).amax(-1, keepdim=True)
    return torch.lerp(point, inside, share)


# -------------------------------------------------------------------- interior points and linear programs


def _interior(sets: _Sets) -> Tensor:
    """Interior points (n, d) of sets with ellipses: the guess or, where that is not interior, the deepest point."""
    candidate = _guess(sets)
    shallow = (sets.depth(candidate) <= _NEAR_BOUNDARY).nonzero().squeeze(-1)
    if len(shallow) == 0:
        return candidate
    candidate = candidate.clone()
    candidate[shallow] = _deepest(sets[shallow])
    return candidate


def _guess(sets: _Sets) -> Tensor:
    """Where an interior point (n, d) often is: the centre of a single ellipse without rows, the origin otherwise."""
    alone = sets.matrix.shape[1] == 1 and sets.given_rows == 0
    return sets.center[:, 0] if alone else torch.zeros_like(sets.center[:, 0])


def _deepest(sets: _Sets) -> Tensor:
    """The points (n, d) of the largest `depth`; a ConstraintError where that is none."""
    solid = sets.rows.abs().amax(-1, keepdim=True) > 0.0
    # Around the centre of the smallest ellipse, in its size, as in `_minimize`.
    traces = sets.matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    size = _size(sets)
    smallest = traces.argmax(-1)[:, None, None]
    origin = sets.center.take_along_dim(smallest, 1).squeeze(1).clamp(-1.0, 1.0)
    matrix, offset = _cones(sets, origin, size)
    # The last coordinate is the depth; a zero matrix does not bound it.
    sink = torch.zeros_like(offset)
    sink[..., 0] = 1.0 / (size * sets.root)
    matrix = torch.cat((matrix, sink.unsqueeze(-1)), -1)
    rows = torch.cat((sets.rows, solid.to(sets.rows.dtype)), -1)
    bounds = size * (sets.bounds - _times(sets.rows, origin))
    gradient = torch.zeros_like(rows[:, 0])
    gradient[:, -1] = 1.0
    start = gradient * (size * sets.depth(origin).unsqueeze(-1)).clamp(max=0.0) - gradient
    solution, _, converged = minimize(torch.zeros_like(size), gradient, rows, bounds, matrix, offset, start, 1e-12)
    solution = solution / size
    point = origin + solution[:, :-1]
    deep = sets.depth(point) > _NO_INTERIOR
    require(deep | converged, "the interior-point method failed", sets.name)
    require(deep | (solution[:, -1] >= -_NO_INTERIOR), "the set is empty", sets.name)
    require(deep, "the set has no interior", sets.name)
    return point


def _chebyshev(sets: _Sets) -> Tensor:
    """Chebyshev centres (n, d) of sets without ellipses."""
    solid = sets.rows.abs().amax(-1, keepdim=True) > 0.0
    rows = torch.cat((sets.rows, solid.to(sets.rows.dtype)), -1)
    objective = torch.zeros(len(rows), sets.dim + 1, dtype=rows.dtype)
    objective[:, -1] = 1.0
    solution = _solve_linear_programs(objective, rows, sets.bounds)
    radius = solution[:, -1]
    require(radius >= -_NO_INTERIOR, "the set is empty", sets.name)
    require(radius > _NO_INTERIOR, "the set has no interior", sets.name)
    return solution[:, :-1]


def _maximize_on_rows(sets: _Sets, slope: Tensor) -> Tensor:
    # The projection of the origin names the sample, and often the row, of an empty set. That of the solution moves it
    # by the linear program's tolerance only.
    project_on_rows(sets.rows, sets.bounds, torch.zeros_like(slope), sets.name, sets.given_rows)
    solution = _solve_linear_programs(slope, sets.rows, sets.bounds)
    return project_on_rows(sets.rows, sets.bounds, solution, sets.name, sets.given_rows)[0]


def _minimize(sets: _Sets, start: Tensor, curvature: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """argmin a (n, d) of curvature |a - start|^2 / 2 - <gradient, a> over sets with ellipses, and the
    multipliers (n, m + k), from the points `start`.

    Solved for y = size (a - start), in which the smallest ellipse is of order 1.
    """
    size = _size(sets)
    bounds = size * (sets.bounds - _times(sets.rows, start))
    matrix, offset = _cones(sets, start, size)
    zero = torch.zeros_like(start)
    point, dual, _ = minimize(curvature / size, gradient, sets.rows, bounds, matrix, offset, zero, 1e-9)
    # In units of a; the ellipses' for the square of what the cone bounds, hence half.
    m = sets.rows.shape[1]
    return start + point / size, torch.cat((dual[:, :m], 0.5 * dual[:, m:] / size), -1)


def _size(sets: _Sets) -> Tensor:
    """Inverse size (n, 1) of the smallest ellipse, at least that of the box."""
    return sets.matrix.diagonal(dim1=-2, dim2=-1).sum(-1).amax(-1, keepdim=True).sqrt().clamp(min=1.0)


def _cones(sets: _Sets, inside: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """The ellipses as cones of offset (n, k, 1 + d) - matrix (n, k, 1 + d, d) @ y for y = size (a - inside)."""
    value, axes = torch.linalg.eigh(sets.matrix)
    root = value.clamp(min=0.0).sqrt().unsqueeze(-1) * axes.mT
    offset = _times(root, inside.unsqueeze(1) - sets.center)
    matrix = torch.nn.functional.pad(-root / size[..., None, None], (0, 0, 1, 0))
    return matrix, torch.nn.functional.pad(offset, (1, 0), value=1.0)


def _solve_linear_programs(objective: Tensor, rows: Tensor, bounds: Tensor) -> Tensor:
    """argmax (n, d) of <objective, y> subject to rows (n, m, d) @ y <= bounds (n, m), feasible and bounded."""
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    count, m, dim = rows.shape
    solution = torch.empty_like(objective)
    size = max(1, _LARGEST_PROGRAM // m)
    for start in range(0, count, size):
        part = slice(start, min(start + size, count))
        blocks = part.stop - start
        columns = np.arange(blocks * dim).reshape(blocks, 1, dim).repeat(m, axis=1)
        matrix = csr_array(
            (rows[part].numpy().ravel(), columns.ravel(), np.arange(blocks * m + 1) * dim), (blocks * m, blocks * dim)
        )
        result = linprog(
            -objective[part].numpy().ravel(),
            matrix,
            bounds[part].numpy().ravel(),
            bounds=(None, None),
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if result.status != 0:
            raise ConstraintError(f"HiGHS failed on a linear program: {result.message}")
        solution[part] = torch.from_numpy(result.x).view(blocks, dim)
    return solution


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
