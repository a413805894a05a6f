"""User-defined sets depend neither on PyTorch's defaults nor on the mode in which they are first used."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from constraints import (
    Constraint,
    DiagonalEllipse,
    Intersection,
    InUnits,
    LinearConstraint,
    QuadraticConstraint,
    WeightedL1,
)


def rows(obs: Tensor) -> Tensor:
    return torch.stack((obs[..., :3], obs[..., 1:4]), -2)


def bounds(obs: Tensor) -> Tensor:
    return 0.3 + obs[..., :2].square()


def matrix(obs: Tensor) -> Tensor:
    return torch.diag_embed(1.0 + obs[..., :3].square())


def build() -> dict[str, Constraint]:
    linear = LinearConstraint(3, rows, bounds)
    ellipse = QuadraticConstraint(3, matrix, 0.4, lambda obs: 0.1 * obs[..., :3].tanh())
    return {
        "rows": linear,
        "ellipse": ellipse,
        "both": Intersection(linear, ellipse),
        "closed forms": Intersection(
            WeightedL1(lambda obs: obs[..., :3], 1.0, 3), DiagonalEllipse(lambda obs: obs[..., :3].square(), 0.3, 3)
        ),
        "units": InUnits(
            Intersection(linear, ellipse, WeightedL1(lambda obs: obs[..., :3], 1.0, 3)), -2.0, [1.0, 2.0, 3.0]
        ),
        "empty": LinearConstraint(3, rows, lambda obs: obs[..., :2] - 9.0, on_empty="least"),
    }


def everything(constraint: Constraint, obs: Tensor, action: Tensor) -> list[Tensor]:
    """The results of all methods, and their gradients with respect to the action if there are any."""
    names = ("project", "alpha_map", "radial_map", "gauge_map", "violation", "penalty", "linear_oracle")
    results = [getattr(constraint, name)(obs, action) for name in names] + [constraint.center(obs)]
    if torch.is_inference_mode_enabled():
        return results
    leaf = action.clone().requires_grad_()
    for name in names[:-1]:
        results.append(torch.autograd.grad(getattr(constraint, name)(obs, leaf).sum(), leaf)[0])
    return results


def data() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(30, 4, generator=generator, dtype=torch.float64)
    return obs, 1.5 * torch.randn(30, 3, generator=generator, dtype=torch.float64)


@pytest.fixture
def defaults():
    yield
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("name", build())
@pytest.mark.parametrize("device, dtype", [("meta", None), (None, torch.float64), (None, torch.float16)])
def test_default_device_and_dtype(name, device, dtype, defaults):
    obs, action = data()
    expected = everything(build()[name], obs, action)
    torch.set_default_device(device)
    torch.set_default_dtype(dtype or torch.float32)
    for actual, wanted in zip(everything(build()[name], obs, action), expected, strict=True):
        assert actual.device == wanted.device and actual.dtype == wanted.dtype and torch.equal(actual, wanted)


@pytest.mark.parametrize("name", build())
def test_built_in_inference_mode(name):
    with torch.inference_mode():
        constraint = build()[name]
    obs, action = data()
    obs.requires_grad_(name != "empty")
    value = constraint.project(obs, action.requires_grad_())
    expected = build()[name].project(obs, action)
    torch.testing.assert_close(value, expected, rtol=0.0, atol=0.0)
    value.sum().backward()


@pytest.mark.parametrize("name", build())
def test_first_use_in_inference_mode(name):
    obs, action = data()
    expected = everything(build()[name], obs, action)
    constraint = build()[name]
    with torch.inference_mode():
        inside = everything(constraint, obs, action)
    for actual, wanted in zip(inside, expected, strict=False):
        assert torch.equal(actual, wanted)
    for actual, wanted in zip(everything(constraint, obs, action), expected, strict=True):
        assert torch.equal(actual, wanted)
