"""Wrong coefficients, centres and arguments of the closed forms: an error of one line, never a wrong result."""

import copy
import math
import pickle
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch import Tensor

from constraints import (
    Ball,
    Box,
    Constraint,
    ConstraintError,
    DiagonalEllipse,
    HalfSpace,
    LinearConstraint,
    PlanarEllipse,
    QuadraticConstraint,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
    check_inputs,
)
from constraints.density import _quadrature as quadrature
from constraints.weighted import _cached_patterns as cached_patterns


def all_of(value: float, *shape: int):
    return lambda obs: torch.full((*obs.shape[:-1], *shape), value, dtype=obs.dtype)


def ones(*shape: int):
    return all_of(1.0, *shape)


def matrix(*rows: list[float]):
    return lambda obs: torch.tensor(rows, dtype=obs.dtype)


PATTERNS = (WeightedL1, WeightedPositivePart, HalfSpace)
ROWS = [
    ("NaN", all_of(math.nan, 3), 1.0, "sample 0: weight(obs) is NaN"),
    ("infinity", all_of(math.inf, 3), 1.0, "weight(obs) is NaN or infinite"),
    ("width", ones(1), 1.0, "weight(obs) has shape (2, 1), expected (..., 3)"),
    ("missing axis", ones(), 1.0, "weight(obs) has shape (2,), expected (..., 3)"),
    ("bound", ones(3), all_of(0.0), "sample 0: bound(obs) is not positive"),
]
WRONG = {
    **{f"{name} of {c.__name__}": (c(weight, bound, 3), said) for c in PATTERNS for name, weight, bound, said in ROWS},
    "bound with an axis": (WeightedL1(ones(3), ones(1), 3), "bound(obs) has shape (2, 1), expected (...)"),
    "bound NaN": (WeightedL1(ones(3), all_of(math.nan), 3), "bound(obs) is NaN or infinite"),
    "other leading shape": (WeightedL1(lambda obs: torch.ones(7, 3), 1.0, 3), "weight(obs) has shape (7, 3)"),
    "negative scale": (DiagonalEllipse(all_of(-1.0, 3), 1.0, 3), "sample 0: scale(obs) is negative"),
    "NaN in scale": (DiagonalEllipse(all_of(math.nan, 3), 1.0, 3), "scale(obs) is NaN"),
    "width of scale": (DiagonalEllipse(ones(2), 1.0, 3), "scale(obs) has shape (2, 2), expected (..., 3)"),
    "upper triangle": (PlanarEllipse(matrix([1.0, 2.0], [0.0, 5.0]), 1.0), "matrix(obs) is not symmetric"),
    "indefinite": (PlanarEllipse(matrix([1.0, 2.0], [2.0, 1.0]), 1.0), "matrix(obs) is not positive semi-definite"),
    "shape of matrix": (PlanarEllipse(ones(3), 1.0), "matrix(obs) has shape (2, 3), expected (..., 2, 2)"),
    "bound of an ellipse": (PlanarEllipse(matrix([1.0, 0.0], [0.0, 1.0]), all_of(-1.0)), "bound(obs) is not positive"),
    "bound of a ball": (Ball(all_of(-1.0), 3), "bound(obs) is not positive"),
    "weights of both": (WeightedL1AndEllipse(ones(2), 1.0, ones(3), 1.0, 3), "weight(obs) has shape (2, 2)"),
    "scales of both": (WeightedL1AndEllipse(ones(3), 1.0, all_of(-1.0, 3), 1.0, 3), "scale(obs) is negative"),
}
METHODS = ("violation", "penalty", "project", "alpha_map", "radial_map", "gauge_map", "linear_oracle")


@pytest.mark.parametrize("name", WRONG)
def test_wrong_coefficients(name):
    constraint, said = WRONG[name]
    obs, action = torch.zeros(2, 4, dtype=torch.float64), torch.full((2, constraint.dim), 0.5, dtype=torch.float64)
    for method in METHODS:
        with pytest.raises(ConstraintError) as error:
            getattr(constraint, method)(obs, action)
        assert said in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(ConstraintError) as error:
        constraint.gauge(obs, action, None)
    if not constraint.origin_centered:
        with pytest.raises(ConstraintError):
            constraint.center(obs)


@pytest.mark.parametrize("bound", [0.0, -1.0, math.nan, math.inf])
def test_bounds_that_are_no_positive_numbers(bound):
    for make in (
        lambda: Ball(bound, 2),
        lambda: DiagonalEllipse(ones(2), bound, 2),
        lambda: PlanarEllipse(ones(2, 2), bound),
        lambda: WeightedL1AndEllipse(ones(2), bound, ones(2), 1.0, 2),
        lambda: WeightedL1AndEllipse(ones(2), 1.0, ones(2), bound, 2),
        *(lambda c=c: c(ones(2), bound, 2) for c in PATTERNS),
    ):
        with pytest.raises(ValueError, match=f"bound must be positive .* got {bound}"):
            make()


def test_a_bound_may_not_be_a_tensor():
    """A tensor would lose its gradient, and it does not say to which observations its entries belong."""
    with pytest.raises(TypeError, match="bound must be a number or a function of the observation, got Tensor"):
        Ball(torch.tensor(0.5, requires_grad=True), 2)
    with pytest.raises(TypeError, match="weight must be a function of the observation, got list"):
        WeightedL1([1.0, 2.0], 1.0, 2)


def test_a_coefficient_of_a_subclass_is_a_method():
    class Sphere(QuadraticConstraint):
        bound = 0.05

    with pytest.raises(TypeError, match=r"^bound must be a function of the observation, got float$"):
        Sphere(2, Q=lambda obs: torch.eye(2)).project(torch.zeros(1), torch.ones(2))


@pytest.mark.parametrize("name", ["center", "gauge", "ray", "radial_map", "alpha_log_prob"])
@pytest.mark.parametrize("base", [Ball, QuadraticConstraint, HalfSpace])
def test_methods_that_others_bypass_are_not_overridden(base, name):
    """Training reads the stored `center`, evaluation reads `_center`: an override of one would part the two."""
    with pytest.raises(TypeError, match=f"^Mine overrides {name}, but some calls would bypass that: override _center"):
        type("Mine", (base,), {name: lambda self, obs: obs})


def test_a_mixin_does_not_override_them_either():
    class Centred:
        def center(self, obs):
            return obs

    with pytest.raises(TypeError, match="^Mine overrides center,"):
        type("Mine", (Centred, Ball), {})


def test_a_centre_of_ones_own_serves_every_map():
    class Corner(LinearConstraint):
        def _center(self, at):
            return self.at(at).obs[..., :2]

    corner = Corner(2, A=lambda obs: torch.ones(1, 2), b=lambda obs: torch.zeros(1))
    obs, action = torch.tensor([-0.5, -0.25]).double(), torch.zeros(2).double()
    assert torch.equal(corner.center(obs), obs) and torch.equal(corner.gauge_map(obs, action), obs)
    own, given = corner.radial_map(obs, action), corner.radial_map(obs, action, obs)
    assert torch.equal(own, given) and not torch.equal(own, obs)


SETS: dict[str, Constraint] = {
    "l1": WeightedL1(lambda obs: obs[..., :2], 1.0, 2),
    "positive part": WeightedPositivePart(lambda obs: obs[..., :2], 1.0, 2),
    "half-space": HalfSpace(lambda obs: obs[..., :2], 1.0, 2),
    "ball": Ball(0.5, 2),
    "cut ball": Ball(1.5, 2),
    "ellipse": DiagonalEllipse(lambda obs: obs[..., :2] ** 2, 1.0, 2),
    "box": Box(2),
}


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("method", ["gauge", "alpha_map", "radial_map", "gauge_map", "ray"])
def test_a_centre_outside_the_set(name, method):
    constraint = copy.deepcopy(SETS[name])
    obs, action = torch.full((2, 3), 2.0), torch.zeros(2, 2)
    for outside in (torch.tensor([0.8, 0.9]), torch.tensor([[0.0, 0.0], [1.5, 0.0]]), torch.ones(2)):
        if constraint.contains(obs, outside).all():
            continue
        with pytest.raises(ConstraintError, match="sample.*: the centre is not inside the set"):
            getattr(constraint, method)(obs, action, outside)
    with pytest.raises(ValueError, match=r"expected 2 coordinates of the centre, got shape \(1,\)"):
        getattr(constraint, method)(obs, action, torch.zeros(1))
    getattr(constraint, method)(obs, action, torch.zeros(2))


def test_checks_end_after_the_first_calls_unless_they_are_asked_for():
    def weight(obs: Tensor) -> Tensor:
        calls.append(None)
        return obs[..., :2] * (1.0 if len(calls) <= 100 else math.inf)

    calls: list[None] = []
    constraint = WeightedL1(weight, 1.0, 2)
    obs, action = torch.ones(1, 2), torch.ones(1, 2)
    for _ in range(100):
        constraint.project(obs, action)
    constraint.project(obs, action)
    constraint = WeightedL1(weight, 1.0, 2)
    calls.clear()
    check_inputs(True)
    try:
        for _ in range(100):
            constraint.project(obs, action)
        with pytest.raises(ConstraintError, match="NaN or infinite"):
            constraint.project(obs, action)
    finally:
        check_inputs(False)
    constraint.project(obs, action)


def test_given_centres_too_are_checked_in_the_first_calls_unless_more_is_asked_for():
    constraint = Ball(0.5, 2)
    obs, action, outside = torch.ones(1, 2), torch.ones(1, 2), torch.ones(1, 2)
    for _ in range(100):
        constraint.alpha_map(obs, action, torch.zeros(2))
    constraint.alpha_map(obs, action, outside)
    check_inputs(True)
    try:
        with pytest.raises(ConstraintError, match="the centre is not inside the set"):
            constraint.alpha_map(obs, action, outside)
    finally:
        check_inputs(False)


def test_compiled_methods_are_those_of_eager_mode():
    constraint, obs, action = WeightedL1(lambda obs: obs[..., :2], 1.0, 2), torch.ones(4, 3), 2.0 * torch.ones(4, 2)
    compiled = torch.compile(constraint.project, backend="eager")
    for _ in range(3):
        torch.testing.assert_close(compiled(obs, action), constraint.project(obs, action))


def test_checks_ask_nothing_of_a_device():
    """Not even in the first calls, which may be on a GPU. The meta device has no values, so a query would fail."""
    for name in SETS:
        constraint = copy.deepcopy(SETS[name])
        obs, action = torch.ones(2, 3, device="meta"), torch.ones(2, 2, device="meta")
        assert constraint.project(obs, action).device.type == "meta"
        assert constraint.alpha_map(obs, action, constraint.center(obs)).device.type == "meta"


def test_coefficients_of_any_floating_type_serve():
    obs, action = torch.ones(4, 2), 3.0 * torch.ones(4, 2)
    for function in (lambda obs: obs.float(), lambda obs: torch.ones(2, dtype=torch.int64), lambda obs: torch.ones(2)):
        projected = WeightedL1(function, lambda obs: obs[..., 0].half(), 2).project(obs, action)
        torch.testing.assert_close(projected, torch.full((4, 2), 0.5))


def test_copies_keep_their_checks():
    for name in ("ball", "cut ball", "box"):
        for constraint in (copy.deepcopy(SETS[name]), pickle.loads(pickle.dumps(SETS[name]))):
            obs, action = torch.ones(4, 2), torch.ones(4, 2)
            assert torch.equal(constraint.project(obs, action), SETS[name].project(obs, action))


# ------------------------------------------------------------------------------------------ first contacts


def test_arrays_and_lists_are_refused_by_name():
    constraint, obs, action = Ball(0.5, 2), torch.zeros(3), torch.zeros(2)
    for wrong, kind in (([0.0, 0.0], "list"), (np.zeros(2), "ndarray")):
        for method in (*METHODS, "contains"):
            with pytest.raises(TypeError, match=rf"obs must be a torch.Tensor, got {kind}; torch.as_tensor\(obs\)"):
                getattr(constraint, method)(wrong, action)
            with pytest.raises(TypeError, match=f"(action|gradient) must be a torch.Tensor, got {kind}"):
                getattr(constraint, method)(obs, wrong)
        for call in (constraint.center, constraint.least_violation, lambda obs: constraint.sample(obs, 1)):
            with pytest.raises(TypeError, match=f"obs must be a torch.Tensor, got {kind}"):
                call(wrong)
        with pytest.raises(TypeError, match=f"center must be a torch.Tensor, got {kind}"):
            constraint.alpha_map(obs, action, wrong)
    with pytest.raises(ValueError, match=r"expected 2 action coordinates, got shape \(\)"):
        constraint.project(obs, torch.tensor(0.5))


def test_arguments_that_are_of_another_kind():
    obs, action = torch.zeros(4, 3), torch.ones(4, 2)
    for wrong, kind in ([1.0, 2.0], "list"), (np.ones(2), "ndarray"), (None, "NoneType"), ("x", "str"):
        with pytest.raises(TypeError, match=rf"weight\(obs\) must be a torch.Tensor, got {kind}"):
            WeightedL1(lambda obs, wrong=wrong: wrong, 1.0, 2).project(obs, action)
        with pytest.raises(TypeError, match=f"bound must be a number or a function of the observation, got {kind}"):
            Ball(wrong, 2)
    with pytest.raises(ConstraintError, match=r"weight\(obs\) is complex"):
        WeightedL1(lambda obs: torch.ones(2, dtype=torch.complex64), 1.0, 2).project(obs, action)
    with pytest.raises(TypeError, match="integer"):
        Ball(0.5, 2.0)
    with pytest.raises(ValueError, match=r"leading shapes of obs and action do not broadcast: \(5, 3\) and \(4, 2\)"):
        Ball(0.5, 2).project(torch.zeros(5, 3), action)
    assert Ball(np.float32(0.5), np.int64(2)).project(obs, action).shape == (4, 2)


def test_arrays_are_refused_by_the_other_methods_too():
    obs, action = torch.zeros(3), torch.zeros(2)
    for constraint in (Ball(0.5, 2), LinearConstraint(2, ones(1, 2), ones(1))):
        for wrong, kind in ([0.0, 0.0], "list"), (np.zeros(3), "ndarray"):
            said = f"must be a torch.Tensor, got {kind}"
            with pytest.raises(TypeError, match=f"obs {said}"):
                constraint.sample(wrong, 3)
            with pytest.raises(TypeError, match=f"obs {said}"):
                constraint.least_violation(wrong)
            for method in (constraint.radial_log_prob, constraint.gauge_log_prob):
                with pytest.raises(TypeError, match=f"log_prob {said}"):
                    method(obs, action, wrong)
            with pytest.raises(TypeError, match=f"mean {said}"):
                constraint.alpha_log_prob(obs, action, wrong, action)
            with pytest.raises(TypeError, match=f"std {said}"):
                constraint.alpha_log_prob(obs, action, action, wrong)
        with pytest.raises(TypeError, match="integer"):
            constraint.sample(obs, 2.5)
    with pytest.raises(TypeError, match="obs must be a torch.Tensor, got ndarray"):
        LinearConstraint(2, ones(1, 2), ones(1)).explicit(np.zeros(3))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_half_precision_is_refused(dtype):
    """Its rounding would move feasible points out of the set."""
    constraint, obs, action = Ball(0.05, 2), torch.zeros(3), torch.ones(2, dtype=dtype)
    for method in (*METHODS, "contains"):
        with pytest.raises(TypeError, match=f"expected float32 or float64 actions, got {dtype}"):
            getattr(constraint, method)(obs, action)
    for method, *more in ("center",), ("sample", 3), ("least_violation",):
        with pytest.raises(TypeError, match=f"expected float32 or float64 observations, got {dtype}"):
            getattr(constraint, method)(obs.to(dtype), *more)


def test_bounds_of_any_kind_of_number():
    obs, action = torch.zeros(3), torch.ones(2)
    for bound in (Fraction(1, 2), np.float16(0.5), np.float64(0.5), True):
        constraint, same = Ball(bound, 2), Ball(float(bound), 2)
        for method in (*METHODS, "gauge_map"):
            assert torch.equal(getattr(constraint, method)(obs, action), getattr(same, method)(obs, action))


@pytest.mark.parametrize("what", ["A", "b", "Q", "c"])
def test_coefficients_that_are_no_functions(what):
    for wrong, kind in (torch.ones(2, 2), "Tensor"), ([1.0, 2.0], "list"):
        with pytest.raises(TypeError, match=f"{what} must be a function of the observation, got {kind}"):
            (LinearConstraint if what in "Ab" else QuadraticConstraint)(2, **{what: wrong})


NOT_EACH_ALONE = {
    "rows without their axis": LinearConstraint(2, lambda obs: obs[..., :2], lambda obs: torch.ones_like(obs[..., 0])),
    "the first observation's": WeightedL1(lambda obs: obs[0, :2], 1.0, 2),
    "the batch's mean": WeightedL1(lambda obs: obs.mean(0)[:2], 1.0, 2),
    "a bound of the whole batch": Ball(lambda obs: 1.0 + obs.square().sum(), 2),
    "bounds by the batch": LinearConstraint(2, ones(1, 2), lambda obs: (obs / obs.norm())[..., :1]),
    "a matrix by the batch": QuadraticConstraint(2, lambda obs: torch.eye(2) * (1.0 + obs.square().mean()), 1.0),
}


@pytest.mark.parametrize("name", NOT_EACH_ALONE)
def test_functions_of_a_batch_are_refused(name):
    """A function that handles only one observation, or that normalises over the batch, mixes up the samples' sets."""
    obs, action = torch.arange(12.0).view(4, 3), torch.ones(4, 2)
    with pytest.raises(ConstraintError, match=r"\(obs\) of an observation depends on the others in its batch"):
        NOT_EACH_ALONE[name].project(obs, action)


def test_coefficients_of_a_fixed_batch_pass():
    rows = torch.arange(8.0).view(4, 1, 2) + 1.0
    for function, n in (lambda obs: rows, 0), (lambda obs: rows + obs[..., :1, None] * 0.0, 3):
        constraint = LinearConstraint(2, function, lambda obs: torch.ones(1))
        assert constraint.project(torch.zeros(4, n), torch.ones(4, 2)).shape == (4, 2)


def test_contains():
    constraint, obs = Ball(0.25, 2), torch.zeros(3)
    action = torch.tensor([[0.5, 0.0], [0.5 + 1e-5, 0.0], [0.3, 0.3], [0.3, math.nan]], dtype=torch.float64)
    assert constraint.contains(obs, action).tolist() == [True, False, True, False]
    assert constraint.contains(obs, action, tolerance=1e-4).tolist() == [True, True, True, False]
    general = LinearConstraint(2, lambda obs: torch.ones(1, 2), lambda obs: torch.ones(1))
    assert general.contains(obs, torch.tensor([[0.5, 0.4], [0.6, 0.5]])).tolist() == [True, False]


# ------------------------------------------------------------------------------------------ the first caller's mode


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
def test_the_first_caller_s_mode_is_forgotten(mode):
    """Tensors created in inference mode and then cached would break the backward passes of all later callers."""
    dim = 9  # used by no other test, because patterns are cached for the process
    for constraint in (WeightedL1(ones(dim), 1.0, dim), WeightedPositivePart(ones(dim), 1.0, dim)):
        for kept in (cached_patterns, quadrature):
            kept.cache_clear()
        obs, action = torch.ones(3), torch.ones(4, dim)
        std = torch.ones(dim)
        with mode():
            constraint.penalty(obs, action)
            constraint.alpha_log_prob(obs, action, action, std)
        action.requires_grad_()
        value = constraint.penalty(obs, action) + constraint.alpha_log_prob(obs, action, action, std)
        assert torch.autograd.grad(value.sum(), action)[0].isfinite().all()


def test_default_dtype_and_device_do_not_matter():
    obs, action = torch.linspace(-1.0, 2.0, 12).view(4, 3).double(), torch.linspace(-2.0, 1.5, 8).view(4, 2).double()
    values = {}
    for setting in ("plain", "double", "meta"):
        default = torch.get_default_dtype()
        for kept in (cached_patterns, quadrature):
            kept.cache_clear()
        try:
            if setting == "double":
                torch.set_default_dtype(torch.float64)
            if setting == "meta":
                torch.set_default_device("meta")
            values[setting] = [
                getattr(constraint, method)(obs, action)
                for constraint in SETS.values()
                for method in (*METHODS, "radial_map")
            ]
            values[setting] += [c.alpha_log_prob(obs, action, action, torch.ones_like(action)) for c in SETS.values()]
            values[setting] += [constraint.center(obs) for constraint in SETS.values()]
        finally:
            torch.set_default_dtype(default)
            torch.set_default_device(None)
    for setting in ("double", "meta"):
        for value, expected in zip(values[setting], values["plain"], strict=True):
            torch.testing.assert_close(value, expected, rtol=0.0, atol=0.0)


def test_the_own_centre_of_a_very_thin_set_is_inside():
    constraint = WeightedL1(lambda obs: obs, 0.3, 2)
    obs = torch.tensor([[-1e30, 1e-20], [1e30, 1e30], [1.0, 1.0]], dtype=torch.float64)
    direction, center = torch.ones(3, 2, dtype=torch.float64), constraint.center(obs)
    assert torch.isfinite(constraint.gauge(obs, direction, center)).all()
    center[0, 0] = 0.01
    with pytest.raises(ConstraintError, match="sample 0: the centre is not inside the set"):
        constraint.gauge(obs, direction, center)
