"""The closed forms in any dimension and on awkward input, verified by their optimality conditions.

Hypothesis chooses coefficients and points: zeros, ties, 1e-6 beside 1e6, points on faces and corners, points 1e6 away.
"""

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from references import ReferenceSet, sign_rows, subset_rows

from constraints import (
    Ball,
    Box,
    DiagonalEllipse,
    HalfSpace,
    Intersection,
    PlanarEllipse,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)

numbers = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 0.5, 1e-6, 1e3, -1e6]), st.floats(-10.0, 10.0, allow_subnormal=False)
)
NEAR = 1e-7  # rows of 1e6 with a bound of 0.05 fix a point to about 1e-9
bounds = st.sampled_from([0.05, 0.3, 1.0, 1.7, 10.0])


def first(obs):
    return obs[..., : obs.shape[-1] // 2]


def second(obs):
    return obs[..., obs.shape[-1] // 2 :] ** 2


def planar_matrix(obs):
    """v v' + s e1 e1', which is singular if s = 0."""
    v = first(obs)
    return v.unsqueeze(-1) * v.unsqueeze(-2) + torch.diag_embed(second(obs) * v.new_tensor([1.0, 0.0]))


def reference(rows, b, w, matrix=None, matrix_bound=0.0):
    rows = rows(w) if len(w) else np.zeros((0, 0))
    return ReferenceSet(rows, np.full(len(rows), b), matrix, matrix_bound)


def no_rows(w):
    return np.zeros((0, len(w)))


FAMILIES = {
    "box": (12, lambda d, b: Box(d), lambda w, s, b: reference(no_rows, b, w)),
    "l1": (7, lambda d, b: WeightedL1(first, b, d), lambda w, s, b: reference(sign_rows, b, w)),
    "positive part": (
        7,
        lambda d, b: WeightedPositivePart(first, b, d),
        lambda w, s, b: reference(subset_rows, b, w),
    ),
    "half-space": (12, lambda d, b: HalfSpace(first, b, d), lambda w, s, b: reference(lambda w: w[None], b, w)),
    "ball": (
        12,
        lambda d, b: Ball(b, d),
        lambda w, s, b: reference(no_rows, b, w, np.eye(len(w)), b),
    ),
    "ellipse": (
        12,
        lambda d, b: DiagonalEllipse(second, b, d),
        lambda w, s, b: reference(no_rows, b, w, np.diag(s**2), b),
    ),
    "l1 and ellipse": (
        7,
        lambda d, b: WeightedL1AndEllipse(first, b, second, 0.1, d),
        lambda w, s, b: reference(sign_rows, b, w, np.diag(s**2), 0.1),
    ),
    "planar ellipse": (
        2,
        lambda d, b: PlanarEllipse(planar_matrix, b),
        lambda w, s, b: reference(no_rows, b, w, np.outer(w, w) + np.diag([s[0] ** 2, 0.0]), b),
    ),
}
every_family = pytest.mark.parametrize("name", FAMILIES)


@st.composite
def problems(draw, largest, smallest=1):
    dim = draw(st.integers(smallest, largest))
    vector = partial(st.lists, numbers, min_size=dim, max_size=dim)
    w, s, x = (np.array(draw(vector())) for _ in range(3))
    return w, s, x * draw(st.sampled_from([0.1, 1.0, 1.0, 1e6])), draw(bounds)


def case(name, data):
    largest, build, refer = FAMILIES[name]
    w, s, x, b = data.draw(problems(largest, 2 if name == "planar ellipse" else 1))
    if name == "planar ellipse":  # its matrix has squares: rounding of larger points would turn the normal
        w, s = w.clip(-100.0, 100.0), s.clip(-100.0, 100.0)
    obs = torch.from_numpy(np.concatenate((w, s)))
    return build(len(w), b), refer(w, s, b), obs, torch.from_numpy(x)


@every_family
@given(data=st.data())
def test_projection(name, data):
    constraint, written, obs, x = case(name, data)
    point = constraint.project(obs, x)
    assert written.violation(point.numpy()) <= 1e-9
    residual = written.normal_cone_residual(point.numpy(), (x - point).numpy(), NEAR)
    # The normal of a planar ellipse may turn 1e6 times as fast as the point moves.
    assert residual <= (1e-6 if name == "planar ellipse" else 1e-8) * max(1.0, x.abs().max().item())
    # The same in batches with leading axes.
    again = constraint.project(obs.expand(2, 3, -1), x.expand(2, 3, -1))
    torch.testing.assert_close(again, point.expand(2, 3, -1), rtol=0.0, atol=NEAR)


@every_family
@given(data=st.data())
def test_oracle(name, data):
    constraint, written, obs, gradient = case(name, data)
    point = constraint.linear_oracle(obs, gradient)
    assert written.violation(point.numpy()) <= 1e-9
    size = gradient.abs().max().item()
    assume(size > 0.0)
    assert written.oracle_gap(point.numpy(), gradient.numpy() / size, NEAR) <= 2e-7


@every_family
@given(data=st.data())
def test_maps_and_gauge(name, data):
    constraint, written, obs, x = case(name, data)
    center = constraint.center(obs)
    assert written.violation(center.numpy()) < 0.0
    for mapped in (constraint.alpha_map(obs, x), constraint.radial_map(obs, x)):
        assert written.violation(mapped.numpy()) <= 1e-9
    gauge = constraint.gauge(obs, x - center, center)
    if gauge > 0:
        assert abs(written.violation((center + (x - center) / gauge).numpy())) <= 1e-8
    else:
        torch.testing.assert_close(x, center)


@every_family
@given(data=st.data())
def test_gradients_are_never_nan(name, data):
    constraint, _, obs, x = case(name, data)
    for function in (constraint.project, constraint.alpha_map, constraint.radial_map, constraint.penalty):
        leaf = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(function(obs, leaf).sum(), leaf)
        assert gradient.isfinite().all(), function.__name__


def test_a_center_without_weights_is_the_origin():
    for make in (WeightedPositivePart, HalfSpace):
        for bound in (0.05, 0.3, 5.0):
            assert torch.equal(make(first, bound, 3).center(torch.zeros(2, 6)), torch.zeros(2, 3))


@every_family
def test_bounds_that_are_functions_of_the_observation(name):
    """Each sample has its own bound, in every method and in the explicit form."""
    largest, build, _ = FAMILIES[name]
    if name == "box":
        return  # this set has no bound
    dim = min(largest, 4)
    generator = torch.Generator().manual_seed(0)
    obs, action = (torch.randn(3, n, generator=generator).double() for n in (2 * dim, dim))
    numbers = torch.tensor([0.3, 0.9, 1.6], dtype=torch.float64)
    by_function = build(dim, lambda obs: numbers.expand(obs.shape[:-1]))
    general = Intersection(by_function)
    log_prob, std = action.sum(-1), torch.full_like(action, 0.5)
    methods = {
        "violation": lambda c, k: c.violation(obs[k], action[k]),
        "penalty": lambda c, k: c.penalty(obs[k], action[k]),
        "project": lambda c, k: c.project(obs[k], action[k]),
        "linear_oracle": lambda c, k: c.linear_oracle(obs[k], action[k]),
        "center": lambda c, k: c.center(obs[k]),
        "gauge": lambda c, k: c.gauge(obs[k], action[k], 0.9 * c.center(obs[k])),
        "alpha_map": lambda c, k: c.alpha_map(obs[k], action[k]),
        "radial_map": lambda c, k: c.radial_map(obs[k], action[k]),
        "gauge_map": lambda c, k: c.gauge_map(obs[k], action[k].tanh()),
        "radial_log_prob": lambda c, k: c.radial_log_prob(obs[k], action[k], log_prob[k]),
        "gauge_log_prob": lambda c, k: c.gauge_log_prob(obs[k], action[k].tanh(), log_prob[k]),
        "alpha_log_prob": lambda c, k: c.alpha_log_prob(obs[k], action[k], 0.5 * action[k], std[k]),
    }
    for method, call in methods.items():
        batch = call(by_function, slice(None))
        for k, number in enumerate(numbers.tolist()):
            torch.testing.assert_close(batch[k], call(build(dim, number), k), rtol=1e-9, atol=1e-9, msg=method)
    for method in ("violation", "project"):
        whole = slice(None)
        torch.testing.assert_close(
            methods[method](by_function, whole), methods[method](general, whole), rtol=0.0, atol=1e-7
        )
