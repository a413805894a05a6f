"""User-defined sets (rows, ellipses, intersections) against a conic solver, closed forms and their definitions."""

from __future__ import annotations

import gc
import math

import cvxpy as cp
import numpy as np
import pytest
import torch
from feasible_sets import SHAPES, no_obs, random_set
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import nnls
from torch import Tensor

from constraints import (
    Box,
    Constraint,
    ConstraintError,
    DiagonalEllipse,
    HalfSpace,
    Intersection,
    InUnits,
    LinearConstraint,
    PlanarEllipse,
    QuadraticConstraint,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)


class Barrier(LinearConstraint):
    """Control barrier function: a point at obs[:2] with velocity a stays out of a disc of radius 0.5 around 0.

    d/dt h >= -h with h = |p|^2 - 0.25 is one half-space: -2 p.a <= h.
    """

    def __init__(self):
        super().__init__(dim=2)

    def A(self, obs: Tensor) -> Tensor:
        return -2.0 * obs[..., None, :2]

    def b(self, obs: Tensor) -> Tensor:
        return obs[..., :2].square().sum(-1, keepdim=True) - 0.25


class Disc(QuadraticConstraint):
    """The velocity is within 0.3 of obs[2:4]."""

    def Q(self, obs: Tensor) -> Tensor:
        return torch.eye(2)

    def bound(self, obs: Tensor) -> float:
        return 0.09

    def c(self, obs: Tensor) -> Tensor:
        return obs[..., 2:4]


class Written:
    """One sample of a set, written out with numpy and unit rows, the box included."""

    def __init__(self, constraint: Constraint, obs: Tensor, i: int):
        rows, bounds, ellipses = constraint.explicit(obs)
        lead = obs.shape[:-1]
        self.dim = d = constraint.dim
        A = rows.expand(*lead, *rows.shape[-2:])[i].numpy()
        b = bounds.expand(*lead, bounds.shape[-1])[i].numpy()
        norm = np.linalg.norm(A, axis=1)
        norm[norm == 0.0] = 1.0
        self.A = np.vstack((A / norm[:, None], np.eye(d), -np.eye(d)))
        self.b = np.concatenate((b / norm, np.ones(2 * d)))
        self.ellipses = []
        for Q, c, bound in ellipses:
            bound = torch.as_tensor(bound, dtype=torch.float64).expand(lead)[i].item()
            self.ellipses.append((Q.expand(*lead, d, d)[i].numpy(), c.expand(*lead, d)[i].numpy(), bound))

    def optimum(self, objective, minimize: bool) -> tuple[np.ndarray, float]:
        a = cp.Variable(self.dim)
        conditions = [self.A @ a <= self.b]
        for Q, c, bound in self.ellipses:
            value, axes = np.linalg.eigh(Q)
            root = np.sqrt(np.maximum(value, 0.0))[:, None] * axes.T
            conditions.append(cp.norm(root @ (a - c) / math.sqrt(bound)) <= 1.0)
        problem = cp.Problem((cp.Minimize if minimize else cp.Maximize)(objective(a)), conditions)
        problem.solve(cp.CLARABEL, tol_gap_abs=1e-13, tol_gap_rel=1e-13, tol_feas=1e-13, max_iter=200)
        return a.value, problem.value

    def radius(self) -> float:
        a, r = cp.Variable(self.dim), cp.Variable()
        norm = np.linalg.norm(self.A, axis=1)
        problem = cp.Problem(cp.Maximize(r), [self.A @ a + r * norm <= self.b])
        problem.solve(cp.CLARABEL, tol_gap_abs=1e-13, tol_gap_rel=1e-13, tol_feas=1e-13)
        return problem.value

    def projection_error(self, point: np.ndarray, target: np.ndarray) -> float:
        """A bound on the distance from the feasible `point` to the projection of `target`: the distance of
        target - point to the normal cone at `point`, relative to |target - point| if that is above 1."""
        outward = target - point
        distance = np.linalg.norm(outward)
        if distance == 0.0:
            return 0.0
        normals = [*self.A[self.A @ point - self.b > -1e-9]]
        for Q, c, bound in self.ellipses:
            normal = Q @ (point - c)
            if (point - c) @ normal - bound > -1e-9 * np.linalg.norm(normal):
                normals.append(normal / np.linalg.norm(normal))
        if not normals:
            return distance
        return nnls(np.array(normals).T, outward / distance)[1] * min(distance, 1.0)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_agrees_with_a_conic_solver(shape):
    constraint = random_set(*shape, seed=sum(map(int, shape)))
    obs = no_obs()
    target = 1.5 * torch.randn(4, shape[0], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    projected, extreme = constraint.project(obs, target), constraint.linear_oracle(obs, target)
    assert constraint.violation(obs, projected).max() <= 1e-12
    assert constraint.violation(obs, extreme).max() <= 1e-12
    for i in range(4):
        written, x = Written(constraint, obs, i), target[i].numpy()
        point = projected[i].numpy()
        assert written.projection_error(point, x) <= 1e-9
        # The solver's error is 1e-7 on degenerate ellipses; a feasible point nearer than its answer is better.
        nearest = written.optimum(lambda a, x=x: cp.sum_squares(a - x), minimize=True)[1]
        assert np.square(point - x).sum() <= nearest + 1e-8
        best = written.optimum(lambda a, x=x: x @ a, minimize=False)[1]
        assert abs(x @ extreme[i].numpy() - best) <= 1e-8
        if not written.ellipses:
            center = constraint.center(obs)[i].numpy()
            depth = (written.b - written.A @ center)[: shape[1] + 2 * shape[0]].min()
            assert 0.9 * written.radius() - 1e-8 <= depth <= written.radius() + 1e-8


@given(
    dim=st.integers(1, 20),
    rows=st.sampled_from([0, 0, 1, 3, 5, 12, 30, 50]),
    ellipses=st.integers(0, 3),
    rank=st.integers(1, 20),
    scale=st.sampled_from([1e-4, 1e-3, 0.1, 1.0, 100.0, 1e4]),
    far=st.sampled_from([0.1, 1.0, 10.0, 1e3, 1e6]),
    seed=st.integers(0, 2**31),
)
# Thin slabs: an interior-point method may stall at their boundary.
@example(dim=4, rows=0, ellipses=1, rank=1, scale=1e-3, far=0.1, seed=0)
@example(dim=4, rows=0, ellipses=3, rank=1, scale=1e-3, far=10.0, seed=59)
def test_every_method_keeps_its_promise(dim, rows, ellipses, rank, scale, far, seed):
    constraint = random_set(dim, rows, ellipses or not rows, min(rank, dim), scale, seed, batch=2)
    obs = no_obs(2)
    target = far * torch.randn(2, dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    projected = constraint.project(obs, target)
    assert constraint.violation(obs, projected).max() <= 1e-10
    for i in range(2):
        assert Written(constraint, obs, i).projection_error(projected[i].numpy(), target[i].numpy()) <= 1e-8
    assert constraint.project(obs, projected).sub(projected).abs().max() <= 1e-8

    center = constraint.center(obs)
    assert constraint.violation(obs, center).max() < 0.0
    gauge = constraint.gauge(obs, target - center, center)
    boundary = center + (target - center) / gauge[:, None]
    assert constraint.violation(obs, boundary).abs().max() <= 1e-7 * max(1.0, scale**0.5)
    for mapped in (constraint.alpha_map(obs, target), constraint.radial_map(obs, target)):
        assert constraint.violation(obs, mapped).max() <= 1e-8

    # No other point of the set found here is better than the oracle's.
    extreme = constraint.linear_oracle(obs, target)
    assert constraint.violation(obs, extreme).max() <= 1e-10
    # The slope is in the normal cone up to the remainder of a proximal step of 1e3; the loss is 500 times its square.
    ahead = extreme + target / target.norm(dim=-1, keepdim=True)
    for i in range(2):
        assert Written(constraint, obs, i).projection_error(extreme[i].numpy(), ahead[i].numpy()) <= 1e-7
    for other in (projected, boundary, center):
        assert ((extreme - other) * target / far).sum(-1).min() >= -1e-7


def first(count: int):
    return lambda obs: obs[..., :count]


def squared_sines(count: int):
    return lambda obs: obs[..., :count].sin() ** 2


def tip_matrix(obs: Tensor) -> Tensor:
    cos = obs[..., 0].cos()
    entries = torch.stack((2.0 + 2.0 * cos, 1.0 + cos, 1.0 + cos, torch.ones_like(cos)), -1)
    return entries.unflatten(-1, (2, 2))


CLOSED_FORMS = {
    "box": (Box(3), Intersection(Box(3), Box(3))),
    "l1": (WeightedL1(first(3), 1.0, 3), Intersection(WeightedL1(first(3), 1.0, 3))),
    "positive": (WeightedPositivePart(first(4), 1.0, 4), Intersection(WeightedPositivePart(first(4), 1.0, 4), Box(4))),
    "half-space": (HalfSpace(first(3), 0.5, 3), LinearConstraint(3, lambda obs: obs[..., None, :3], lambda obs: _half)),
    "ellipse": (DiagonalEllipse(squared_sines(3), 0.2, 3), Intersection(DiagonalEllipse(squared_sines(3), 0.2, 3))),
    "tip": (PlanarEllipse(tip_matrix, 0.05), QuadraticConstraint(2, tip_matrix, 0.05)),
    "both": (
        WeightedL1AndEllipse(first(3), 1.0, squared_sines(3), 0.1, 3),
        Intersection(WeightedL1(first(3), 1.0, 3), DiagonalEllipse(squared_sines(3), 0.1, 3)),
    ),
    "nested": (
        WeightedL1AndEllipse(first(3), 1.0, squared_sines(3), 0.1, 3),
        Intersection(Intersection(WeightedL1AndEllipse(first(3), 1.0, squared_sines(3), 0.1, 3)), Box(3)),
    ),
}
_half = torch.tensor([0.5])


@pytest.mark.parametrize("closed, general", CLOSED_FORMS.values(), ids=CLOSED_FORMS)
def test_agrees_with_closed_forms(closed, general):
    generator = torch.Generator().manual_seed(0)
    obs = 3.0 * torch.randn(40, 4, generator=generator, dtype=torch.float64)
    obs[0] = 0.0
    obs[1, 0] = 0.0
    action = 2.0 * torch.randn(40, closed.dim, generator=generator, dtype=torch.float64)
    weight = torch.randn(40, closed.dim, generator=generator, dtype=torch.float64)
    center = 0.05 * torch.rand(40, closed.dim, generator=generator, dtype=torch.float64)

    def everything(constraint: Constraint):
        x = action.clone().requires_grad_()
        projected = constraint.project(obs, x)
        gradient = torch.autograd.grad((projected * weight).sum(), x)[0]
        oracle = (constraint.linear_oracle(obs, action) * action).sum(-1)
        gauges = constraint.gauge(obs, action, center), constraint.gauge(obs, action, None)
        return projected, gradient, oracle, *gauges, constraint.violation(obs, action), constraint.penalty(obs, action)

    for expected, actual in zip(everything(closed), everything(general), strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-7, atol=1e-8)


def test_center_of_linear_parts_is_that_of_all_rows():
    positive = WeightedPositivePart(first(3), 1.0, 3)
    obs = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4.0
    center = Intersection(positive, Box(3)).center(obs)
    for i in range(20):
        written = Written(positive, obs, i)
        solid = np.linalg.norm(written.A, axis=1) > 0.0
        radius = [(written.b - written.A @ point[i].numpy())[solid].min() for point in (center, positive.center(obs))]
        assert 0.9 * radius[1] - 1e-8 <= radius[0] <= radius[1] + 1e-8


def test_center_with_ellipses():
    obs = torch.tensor([[0.6, 0.0, 0.2, -0.1], [0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(Disc(2).center(obs), obs[:, 2:])
    both = Intersection(Barrier(), Disc(2))
    center = both.center(obs)
    assert center[0].tolist() == [0.0, 0.0]  # inside both
    assert both.violation(obs, center)[1] < 0.0 and center[1, 0] > 0.0  # the barrier pushes outwards
    # The ellipse's centre lies outside the box, a part of the ellipse inside.
    cut = QuadraticConstraint(2, lambda obs: torch.eye(2), 0.09, lambda obs: torch.tensor([1.1, 0.0]))
    assert cut.violation(obs, cut.center(obs)).max() < -0.08


def test_barrier_example():
    obs = torch.tensor([[1.0, 0.0], [0.5, 0.0], [0.3, 0.0]], dtype=torch.float64)
    action = torch.tensor([-1.0, 0.4], dtype=torch.float64)
    # -2 a_1 p_1 <= p_1^2 - 0.25
    expected = torch.tensor([[-0.375, 0.4], [0.0, 0.4], [0.8 / 3.0, 0.4]], dtype=torch.float64)
    torch.testing.assert_close(Barrier().project(obs, action), expected)
    torch.testing.assert_close(Barrier().violation(obs, action), torch.tensor([0.625, 1.0, 3.8 / 3.0]).double())


GRADIENT_CASES = [(2, 3, 0, 1, 1.0), (6, 10, 0, 1, 1.0), (3, 0, 1, 2, 0.3), (3, 4, 2, 3, 1.0), (5, 6, 2, 3, 1.0)]


@pytest.mark.parametrize("shape", GRADIENT_CASES, ids=str)
def test_gradients(shape):
    constraint, obs = random_set(*shape, seed=3, batch=2), no_obs(2)
    generator = torch.Generator().manual_seed(4)
    action = 1.5 * torch.randn(2, shape[0], generator=generator, dtype=torch.float64).requires_grad_()
    for method in (constraint.project, constraint.alpha_map, constraint.radial_map):
        assert torch.autograd.gradcheck(
            lambda x, method=method: method(obs, x), action, atol=1e-6, rtol=1e-4, fast_mode=True
        )


def jacobian(constraint: Constraint, obs: Tensor, action: Tensor) -> Tensor:
    return torch.autograd.functional.jacobian(lambda x: constraint.project(obs, x), action)


def test_gradient_at_degenerate_points():
    octahedron = Intersection(WeightedL1(lambda obs: torch.ones(3, dtype=torch.float64), 0.5, 3))
    obs = torch.zeros(1, dtype=torch.float64)
    # At the apex of a pyramid, two of the four rows suffice for the multipliers, but the projection does not move.
    axis = torch.tensor([5.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(jacobian(octahedron, obs, axis), torch.zeros(3, 3, dtype=torch.float64))
    # On an edge, the projection moves only along the edge.
    edge = torch.tensor([2.0, 2.1, 0.0], dtype=torch.float64)
    along = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64) / math.sqrt(2.0)
    torch.testing.assert_close(jacobian(octahedron, obs, edge), torch.outer(along, along))
    # A kink: exactly on the boundary, and a row given twice.
    twice = LinearConstraint(
        2, lambda obs: torch.tensor([[1.0, 1.0], [2.0, 2.0]]), lambda obs: torch.tensor([1.0, 2.0])
    )
    at_kink = jacobian(twice, obs, torch.tensor([0.5, 0.5], dtype=torch.float64))
    value = torch.linalg.eigvalsh(at_kink)
    assert value.min() >= -1e-12 and value.max() <= 1.0 + 1e-12
    beyond = jacobian(twice, obs, torch.tensor([0.7, 0.6], dtype=torch.float64))
    torch.testing.assert_close(beyond, torch.tensor([[0.5, -0.5], [-0.5, 0.5]], dtype=torch.float64))


def test_set_without_interior_still_projects():
    flat = LinearConstraint(
        2, lambda obs: torch.tensor([[1.0, 1.0], [-1.0, -1.0]]), lambda obs: torch.tensor([0.2, -0.2])
    )
    obs, action = no_obs(1), torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(flat.project(obs, action), torch.tensor([[0.6, -0.4]], dtype=torch.float64))
    torch.testing.assert_close(flat.linear_oracle(obs, action), torch.tensor([[1.0, -0.8]], dtype=torch.float64))
    with pytest.raises(ConstraintError, match="sample 0: the set has no interior"):
        flat.center(obs)


def linear(A, b) -> LinearConstraint:
    return LinearConstraint(
        2, lambda obs: torch.tensor(A, dtype=torch.float64), lambda obs: torch.tensor(b, dtype=torch.float64)
    )


def ball(radius: float, *center: float) -> QuadraticConstraint:
    return QuadraticConstraint(
        2, lambda obs: torch.eye(2), radius**2, lambda obs: torch.tensor(center, dtype=torch.float64)
    )


def slab(width: float) -> LinearConstraint:
    """A diagonal slab of this width; its depth is half the width."""
    b = math.sqrt(2.0) * width
    return LinearConstraint(
        2,
        lambda obs: torch.tensor([[1.0, 1.0], [-1.0, -1.0]]),
        lambda obs: torch.tensor([0.3, b - 0.3], dtype=torch.float64),
    )


@pytest.mark.parametrize(
    "constraint, message",
    [
        (Intersection(slab(3e-9), ball(1.0, 0.0, 0.0)), None),
        (Intersection(ball(0.3, 0.3 - 1e-8, 0.0), ball(0.3, -0.3, 0.0)), None),
        (ball(1e-8, 0.3, 0.2), None),
        (Intersection(slab(1e-9), ball(1.0, 0.0, 0.0)), "the set has no interior"),
        (Intersection(slab(0.0), ball(1.0, 0.0, 0.0)), "the set has no interior"),
        (Intersection(ball(0.3, 0.3, 0.0), ball(0.3, -0.3, 0.0)), "the set has no interior"),
        (ball(0.5, 1.5, 0.0), "the set has no interior"),
        (ball(1e-10, 0.3, 0.2), "the set has no interior"),
        (Intersection(slab(-1e-6), ball(1.0, 0.0, 0.0)), "the set is empty"),
        (Intersection(ball(0.3, 0.3 + 1e-6, 0.0), ball(0.3, -0.3, 0.0)), "the set is empty"),
        (ball(1e6, 1e6 + 1.5, 0.0), "the set is empty"),
    ],
)
def test_thin_sets_are_told_from_flat_and_empty_ones(constraint, message):
    obs, action = no_obs(1), torch.tensor([[2.0, 0.7]], dtype=torch.float64)
    centered, others = (constraint.alpha_map, constraint.radial_map), (constraint.project, constraint.linear_oracle)
    if message is None:
        for method in (*centered, *others):
            assert constraint.violation(obs, method(obs, action)).max() <= 1e-12
    else:
        # A set without interior still has a projection.
        for method in centered if message == "the set has no interior" else (*centered, *others):
            with pytest.raises(ConstraintError, match=f"sample 0: {message}"):
                method(obs, action)


def quadratic(Q, bound: float, center=(0.0, 0.0)) -> QuadraticConstraint:
    return QuadraticConstraint(
        2,
        lambda obs: torch.tensor(Q, dtype=torch.float64),
        bound,
        lambda obs: torch.tensor(center, dtype=torch.float64),
    )


@pytest.mark.parametrize(
    "constraint, plain",
    [
        (linear([[1e-12, 0.0], [0.0, 1e12]], [0.3e-12, 0.2e12]), linear([[1.0, 0.0], [0.0, 1.0]], [0.3, 0.2])),
        (linear([[1e-200, 0.0], [1e300, 1e300]], [1.0, 0.3e300]), linear([[1.0, 1.0]], [0.3])),
        (linear([[1.0, 1.0], [1.0, 1.0 + 1e-13], [2.0, 2.0]], [0.3, 0.3, 0.6]), linear([[1.0, 1.0]], [0.3])),
        (linear([[0.0, 0.0], [1.0, 1.0]], [0.0, 0.3]), linear([[1.0, 1.0]], [0.3])),
        (quadratic([[0.0, 0.0], [0.0, 0.0]], 1e-12), Intersection(Box(2))),
        (quadratic([[1e-300, 0.0], [0.0, 0.0]], 1.0), Intersection(Box(2))),
        (ball(1e6, 0.0, 0.0), Intersection(Box(2))),
        (ball(1e6, 1e6 + 0.5, 0.0), linear([[-1.0, 0.0]], [-0.5])),
        (quadratic([[1e12, 0.0], [0.0, 1e12]], 0.25e12), ball(0.5, 0.0, 0.0)),
        (quadratic([[1e-12, 0.0], [0.0, 1e-12]], 0.25e-12), ball(0.5, 0.0, 0.0)),
        (Intersection(ball(0.5, 0.0, 0.0), ball(0.5, 0.0, 0.0), Box(2)), ball(0.5, 0.0, 0.0)),
        (Intersection(ball(0.5, 0.0, 0.0), ball(0.25, 0.25, 0.0)), ball(0.25, 0.25, 0.0)),
    ],
)
def test_extreme_coefficients(constraint, plain):
    action = torch.tensor([[2.0, 0.7], [-1.0, 0.3], [1e6, -3e5], [0.0, -1.1]], dtype=torch.float64)
    obs, center = no_obs(), plain.center(no_obs())
    # In the box, an ellipse of size 1e6 differs from a half-space by half a millionth.
    close = dict(
        rtol=0.0, atol=1e-6 if isinstance(plain, LinearConstraint) and constraint.explicit(obs).ellipses else 1e-10
    )
    torch.testing.assert_close(constraint.project(obs, action), plain.project(obs, action), **close)
    slope = action / action.norm(dim=-1, keepdim=True)
    best = [(each.linear_oracle(obs, slope) * slope).sum(-1) for each in (constraint, plain)]
    torch.testing.assert_close(best[0], best[1], **close)
    mapped = [each.alpha_map(obs, action, center) for each in (constraint, plain)]
    torch.testing.assert_close(mapped[0], mapped[1], **close)


def test_rounding_of_a_single_precision_matrix_is_no_error():
    axis = torch.tensor([0.1, 0.7, 0.3])
    root = torch.outer(axis, axis)  # its least eigenvalue is about -1e-8
    constraint = QuadraticConstraint(3, lambda obs: root, 0.01)
    obs, action = no_obs(1), torch.tensor([[0.1, 0.9, 0.2]], dtype=torch.float64)
    # The slab |axis . a| <= 0.1.
    normal = axis.double()
    expected = action - (action @ normal - 0.1)[:, None] * normal / normal.square().sum()
    torch.testing.assert_close(constraint.project(obs, action), expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("shape", [(3, 4, 0, 1, 1.0), (3, 4, 2, 3, 1.0)], ids=str)
def test_nothing_is_kept_or_changed(shape):
    constraint, obs = random_set(*shape, seed=0), no_obs()
    action = 2.0 * torch.randn(4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    action.requires_grad_()
    rows, bounds, ellipses = constraint.explicit(obs)
    inputs = [obs, action, rows, bounds, *(part for ellipse in ellipses for part in ellipse)]
    before = [each.detach().clone() for each in inputs]

    def use():
        for method in (constraint.project, constraint.alpha_map, constraint.radial_map):
            torch.autograd.grad(method(obs, action).sum(), action)
        constraint.gauge(obs, action, constraint.center(obs)).sum().backward()
        constraint.linear_oracle(obs, action)
        action.grad = None

    def tensors() -> int:
        return sum(issubclass(type(each), Tensor) for each in gc.get_objects())

    use()
    gc.collect()
    gc.disable()
    try:
        count = tensors()
        use()
        assert tensors() == count  # freed by reference counting, without the garbage collector
    finally:
        gc.enable()
    for each, copy in zip(inputs, before, strict=True):
        assert torch.equal(each, copy) and each._version == 0


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-12)])
@pytest.mark.parametrize("constraint", [Barrier(), Disc(2), Intersection(Barrier(), Disc(2), Box(2))])
def test_shapes_and_dtypes(constraint, dtype, tolerance):
    generator = torch.Generator().manual_seed(0)
    obs = torch.tensor([0.7, 0.1, 0.2, 0.1]) + 0.05 * torch.randn(3, 5, 4, generator=generator)
    action = torch.randn(3, 5, 2, generator=generator).to(dtype).requires_grad_()
    obs = obs.to(dtype)
    mapped = [constraint.project(obs, action), constraint.alpha_map(obs, action), constraint.radial_map(obs, action)]
    for result in [*mapped, constraint.linear_oracle(obs, action), constraint.center(obs)]:
        assert result.shape == (3, 5, 2) and result.dtype == dtype
        assert constraint.violation(obs, result).max() <= tolerance
        torch.testing.assert_close(result[1, 2], result[1, 2])
    gradient = torch.autograd.grad(sum(result.sum() for result in mapped), action)[0]
    assert gradient.dtype == dtype and gradient.isfinite().all()
    # One sample alone, and one obs for many actions.
    alone = constraint.project(obs[1, 2], action[1, 2])
    torch.testing.assert_close(alone, mapped[0][1, 2], rtol=0.0, atol=1e-7)
    assert constraint.project(obs[0, 0], action).shape == (3, 5, 2)
    for empty in (torch.zeros(0, 4, dtype=dtype), torch.zeros(2, 0, 4, dtype=dtype)):
        nothing = empty[..., :2]
        for result in (
            constraint.project(empty, nothing),
            constraint.linear_oracle(empty, nothing),
            constraint.center(empty),
            constraint.radial_map(empty, nothing),
            constraint.alpha_map(empty, nothing),
        ):
            assert result.shape == nothing.shape


def test_broken_action_stays_visible():
    both = Intersection(Barrier(), Disc(2))
    obs = torch.tensor([0.7, 0.1, 0.2, 0.1], dtype=torch.float64).expand(3, 4)
    action = torch.tensor([[math.nan, 0.0], [math.inf, 0.0], [2.0, 0.0]], dtype=torch.float64)
    for constraint in (Barrier(), both):
        for result in (constraint.project(obs, action), constraint.linear_oracle(obs, action)):
            assert result[:2].isnan().any(-1).all() and result[2].isfinite().all()


NO_CENTER = torch.zeros(1, 2, dtype=torch.float64)


def all_methods(constraint: Constraint, obs: Tensor):
    action = torch.full((*obs.shape[:-1], constraint.dim), 0.5, dtype=torch.float64)
    yield lambda: constraint.project(obs, action)
    yield lambda: constraint.center(obs)
    yield lambda: constraint.linear_oracle(obs, action)
    yield lambda: constraint.alpha_map(obs, action)
    yield lambda: constraint.radial_map(obs, action)
    yield lambda: constraint.gauge(obs, action, None)


@pytest.mark.parametrize(
    "constraint, message",
    [
        (linear([[[1.0, 0.0]], [[1.0, 0.0]]], [[1.0], [-2.0]]), "sample 1.*"),
        (linear([[1.0, 0.0], [0.0, 0.0]], [1.0, -1.0]), "sample 0.*"),
        (linear([[1.0, 0.0], [-1.0, 0.0]], [-0.2, -0.2]), "sample 0.*"),
        (linear([[1.0, 0.0], [1e-200, 0.0]], [1.0, -1.0]), "sample 0, row 1"),
        (linear([[1.0, math.nan]], [1.0]), r"A\(obs\) is NaN or infinite"),
        (linear([[1.0, 0.0]], [math.inf]), r"b\(obs\) is NaN or infinite"),
        (linear([[1.0, 0.0, 0.0]], [1.0]), r"A\(obs\) has shape \(1, 3\), expected \(\.\.\., m, 2\)"),
        (linear([1.0, 0.0], [1.0]), r"A\(obs\) has shape"),
        (linear([[1.0, 0.0]], [1.0, 2.0]), r"b\(obs\) has shape \(2,\), expected \(\.\.\., 1\)"),
        (linear([[[1.0, 0.0]]] * 5, [1.0]), r"A\(obs\) has shape \(5, 1, 2\)"),
        (QuadraticConstraint(2, lambda obs: -torch.eye(2), 1.0), "not positive semi-definite"),
        (QuadraticConstraint(2, lambda obs: torch.tensor([[1.0, 1.0], [0.0, 1.0]]), 1.0), "not symmetric"),
        (QuadraticConstraint(2, lambda obs: torch.eye(3), 1.0), r"Q\(obs\) has shape"),
        (QuadraticConstraint(2, lambda obs: torch.eye(2), 0.0), "not positive"),
        (QuadraticConstraint(2, lambda obs: torch.eye(2), lambda obs: math.nan), "NaN or infinite"),
        (QuadraticConstraint(2, lambda obs: torch.eye(2), 0.1, lambda obs: torch.tensor([3.0, 0.0])), "sample 0"),
        (Intersection(linear([[1.0, 0.0]], [-0.9]), DiagonalEllipse(torch.ones_like, 0.1, 2)), "sample 0"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_ill_posed_sets_raise(constraint, message):
    for call in all_methods(constraint, torch.zeros(2, 2, dtype=torch.float64)):
        with pytest.raises(ConstraintError, match=message):
            call()


def test_errors_name_row_and_sample():
    obs = torch.zeros(2, 3, 4, dtype=torch.float64)
    A = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    b = torch.ones(2, 3, 2)
    b[1, 2, 1] = -2.0
    constraint = LinearConstraint(2, lambda obs: A, lambda obs: b)
    with pytest.raises(ConstraintError, match=r"sample \(1, 2\), row 1: the set is empty"):
        constraint.project(obs, torch.zeros(2, 3, 2, dtype=torch.float64))
    with pytest.raises(ConstraintError, match=r"sample \(1, 2\), row 1: the centre is not inside"):
        constraint.gauge(obs, torch.ones(2, 3, 2, dtype=torch.float64), None)


@pytest.mark.parametrize("constraint", [Barrier(), Disc(2), Intersection(Barrier(), Disc(2))])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_broken_observation_raises(constraint, value):
    obs = torch.tensor([[0.7, 0.1, 0.2, 0.1]], dtype=torch.float64).repeat(3, 1)
    obs[2, 1] = value
    calls = [*all_methods(constraint, obs)]
    calls += [lambda: constraint.violation(obs, obs[:, :2]), lambda: constraint.penalty(obs, obs[:, :2])]
    for call in calls:
        with pytest.raises(ConstraintError, match="sample 2: the observation is NaN or infinite"):
            call()


@pytest.mark.parametrize("constraint", [Barrier(), Disc(2), Intersection(Box(2), WeightedL1(first(2), 0.5, 2))])
def test_center_on_the_boundary_raises(constraint):
    obs = torch.tensor([[0.7, 0.0, 0.0, 0.0]], dtype=torch.float64)
    direction = torch.tensor([[0.3, 0.1]], dtype=torch.float64)
    edge = constraint.linear_oracle(obs, -torch.eye(2, dtype=torch.float64)[:1])
    for center in (edge, torch.tensor([[0.0, 1.0]], dtype=torch.float64)):
        with pytest.raises(ConstraintError, match="sample 0.*the centre is not"):
            constraint.gauge(obs, direction, center)


def test_misuse():
    with pytest.raises(
        TypeError, match=r"Intersection takes constraints, got list; pass them one by one: Intersection\(a, b\)"
    ):
        Intersection([Box(2), Box(2)])
    with pytest.raises(TypeError, match=r"^constraint must be an instance of constraints.Constraint, got <class"):
        InUnits(LinearConstraint, -1.0, 1.0)
    with pytest.raises(TypeError, match=r"^Intersection takes constraints, got float$"):
        Intersection(Box(2), 0.3)
    with pytest.raises(ValueError, match="at least one"):
        Intersection()
    with pytest.raises(ValueError, match="different dimensions"):
        Intersection(Box(2), Box(3))
    with pytest.raises(TypeError, match=r"LinearConstraint needs A\(obs\)"):
        LinearConstraint(2).project(no_obs(1), NO_CENTER)

    class Unwritten(Box):
        explicit = Constraint.explicit

    with pytest.raises(TypeError, match="Unwritten"):
        Intersection(Unwritten(2)).project(no_obs(1), NO_CENTER)


@pytest.mark.parametrize("near_face", [1e-1, 1e-2, 1e-3, 1e-4])
def test_projection_where_the_centre_of_an_ellipse_is_near_a_face(near_face):
    """The interior-point method then starts near the boundary, where it may stall."""
    generator = torch.Generator().manual_seed(2)
    n = 500
    spread = 10.0 ** (0.5 * torch.randn(n, 1, 1, generator=generator, dtype=torch.float64) + 0.5)
    root = torch.randn(n, 2, 2, generator=generator, dtype=torch.float64) * spread
    middle = torch.rand(n, 2, generator=generator, dtype=torch.float64) - 0.5
    middle[:, 0] = 1.0 - near_face * torch.rand(n, generator=generator, dtype=torch.float64)
    constraint = QuadraticConstraint(2, lambda obs: root.mT @ root, 1.0, lambda obs: middle)
    target = 3.0 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    closest = constraint.project(no_obs(n), target)
    # A point is closest if no point of the set is further along target - point.
    outward = torch.nn.functional.normalize(target - closest, dim=-1)
    furthest = constraint.linear_oracle(no_obs(n), outward)
    assert ((furthest - closest) * outward).sum(-1).max() <= 1e-10


def test_a_singular_newton_step_is_no_solution():
    """Its multipliers are so large that rounding makes them look like those of a solution."""
    scale = [0.0, 0.0015064103909502283, 0.0035943187159001937, 0.0002779760499204668]
    target = [0.5510522904313183, -5.796111446988481, -2.1162425796169337, -2.257719301052732]
    ellipse = DiagonalEllipse(lambda obs: obs.new_tensor(scale), 0.004998776954459892, 4)
    obs, action = torch.zeros(1, dtype=torch.float64), torch.tensor(target, dtype=torch.float64)
    expected = ellipse.project(obs, action)
    torch.testing.assert_close(Intersection(ellipse).project(obs, action), expected, rtol=0.0, atol=1e-9)
