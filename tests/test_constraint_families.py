"""The closed forms in any dimension and on awkward input, certified by their optimality conditions.

Coefficients and points are what Hypothesis comes up with: zeros, ties, 1e-6 beside 1e6, points on faces and corners,
points 1e6 away.
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
    PlanarEllipse,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)

numbers = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 0.5, 1e-6, 1e3, -1e6]), st.floats(-10.0, 10.0, allow_subnormal=False)
)
NEAR = 1e-7  # rows of 1e6 beside a bound of 0.05 hold a point to some 1e-9
bounds = st.sampled_from([0.05, 0.3, 1.0, 10.0])


def first(obs):
    return obs[..., : obs.shape[-1] // 2]


def second(obs):
    return obs[..., obs.shape[-1] // 2 :] ** 2


def planar_matrix(obs):
    """vv' + s e1 e1': singular where s = 0."""
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
        lambda d, b: Ball(min(b, 1.0), d),
        lambda w, s, b: reference(no_rows, b, w, np.eye(len(w)), min(b, 1.0)),
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
    if name == "planar ellipse":  # its matrix has squares: beyond this, rounding of the point turns its normal
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
    # The normal of a planar ellipse turns with the point, up to 1e6 times as fast.
    assert residual <= (1e-6 if name == "planar ellipse" else 1e-8) * max(1.0, x.abs().max().item())
    # The same through batches, and with leading axes
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
