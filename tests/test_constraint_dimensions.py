"""Sets with 2^d rows: every method in many dimensions, and all rows in few dimensions."""

import itertools
import time

import numpy as np
import pytest
import torch
from torch import Tensor

from constraints import Constraint, ConstraintError, WeightedL1, WeightedL1AndEllipse, WeightedPositivePart


def case(dim: int, seed: int = 0, count: int = 40) -> tuple[Tensor, Tensor]:
    """Weights, some 0, and actions from deep inside to far outside."""
    generator = torch.Generator().manual_seed(seed)
    weight = torch.randn(count, dim, generator=generator, dtype=torch.float64)
    weight *= torch.rand(count, dim, generator=generator) > 0.15
    size = torch.logspace(-2.0, 1.0, count, dtype=torch.float64).unsqueeze(-1)
    return weight, size * torch.randn(count, dim, generator=generator, dtype=torch.float64)


def sets(dim: int) -> dict[str, Constraint]:
    return {
        "l1": WeightedL1(lambda obs: obs, 1.0, dim),
        "positive part": WeightedPositivePart(lambda obs: obs, 1.0, dim),
        "both": WeightedL1AndEllipse(lambda obs: obs, 1.0, lambda obs: obs.square(), 0.5, dim),
    }


every_set = pytest.mark.parametrize("name", sets(2))


def excess(weight: np.ndarray, action: np.ndarray, entries: tuple[float, float]) -> np.ndarray:
    """Excess of the action over each row, by a Python loop over the patterns. The empty subset is not a row."""
    values = []
    for pattern in itertools.product(entries, repeat=len(weight)):
        if any(pattern):
            row = np.array(pattern) * weight
            values.append((row @ action - 1.0) / (np.linalg.norm(row) or 1.0))
    return np.array(values)


@pytest.mark.parametrize("dim", [1, 2, 5, 8, 13])
def test_violation_and_penalty_are_those_of_the_rows(dim):
    weight, action = case(dim, dim, 12 if dim > 10 else 40)
    for name, entries in (("l1", (-1.0, 1.0)), ("positive part", (0.0, 1.0))):
        constraint = sets(dim)[name]
        violation, penalty = constraint.violation(weight, action), constraint.penalty(weight, action)
        for k in range(len(weight)):
            by_row = excess(weight[k].numpy(), action[k].numpy(), entries)
            expected = max(by_row.max(), action[k].abs().max().item() - 1.0)
            if dim <= 12 or expected > 0.0:
                assert violation[k].item() == pytest.approx(expected, rel=1e-9, abs=1e-12)
            else:
                assert violation[k].item() <= expected + 1e-12
            assert penalty[k].item() == pytest.approx(np.linalg.norm(by_row.clip(min=0.0)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("dim", [3, 8, 12])
def test_prefixes_of_the_sorted_coordinates_hold_the_row_that_is_exceeded_most(dim, monkeypatch):
    for seed in range(20):
        weight, action = case(dim, seed)
        constraint = sets(dim)["positive part"]
        expected = constraint.violation(weight, action)
        with monkeypatch.context() as patched:
            patched.setattr("constraints.weighted._MOST_COMPARED", 0)
            value = constraint.violation(weight, action)
        outside = expected > 0.0
        torch.testing.assert_close(value[outside], expected[outside], rtol=1e-12, atol=1e-12)
        assert (value <= expected + 1e-12).all() and outside.any() and (~outside).any()


@pytest.mark.parametrize("dim", [30, 100])
@every_set
def test_every_method_in_many_coordinates(name, dim):
    constraint = sets(dim)[name]
    weight, action = case(dim)
    action.requires_grad_()
    start = time.perf_counter()
    center = constraint.center(weight)
    gradient = action.detach().flip(-1)
    best = constraint.linear_oracle(weight, gradient)
    mapped = {
        "project": constraint.project(weight, action),
        "alpha_map": constraint.alpha_map(weight, action, center),
        "radial_map": constraint.radial_map(weight, action, center),
        "gauge_map": constraint.gauge_map(weight, action.tanh(), center),
    }
    values = [
        constraint.gauge(weight, action, center),
        constraint.violation(weight, action),
        constraint.radial_log_prob(weight, action, action.sum(-1), center),
        constraint.gauge_log_prob(weight, action.tanh(), action.sum(-1), center),
        constraint.alpha_log_prob(weight, action, 0.5 * action.detach(), torch.ones_like(action), center),
    ]
    for point in (center, best, *mapped.values()):
        assert constraint.violation(weight, point).max() <= 1e-9
    for value in (*values, *mapped.values()):
        (gradients,) = torch.autograd.grad(value.sum(), action, retain_graph=True)
        assert value.isfinite().all() and gradients.isfinite().all()
    assert (constraint.violation(weight, center) < 0.0).all()
    assert constraint.violation(weight, action).max() > 0.0 > constraint.violation(weight, action).min()
    # The oracle's value is at least that of every other point here.
    for point in (center, *mapped.values()):
        assert ((best - point) * gradient).sum(-1).min() >= -1e-9
    assert time.perf_counter() - start < 30.0  # explicit 2^30 rows would need more time or memory


@every_set
def test_too_many_rows_to_be_written_out(name):
    constraint = sets(17)[name]
    weight, action = case(17)
    for method in (lambda: constraint.penalty(weight, action), lambda: constraint.explicit(weight)):
        with pytest.raises(ConstraintError, match=r"17 coordinates has 2\^17 rows.* at most 16 coordinates") as error:
            method()
        assert "\n" not in str(error.value)
