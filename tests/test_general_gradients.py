"""Gradients of user-defined sets with respect to observations and learned coefficients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from constraints import Constraint, Intersection, LinearConstraint, QuadraticConstraint, WeightedL1

OPTIONS = dict(atol=1e-6, rtol=1e-4, eps=1e-6)
DIM = 3


class Learned(torch.nn.Module):
    """Rows, bounds, an ellipse's matrix, centre and bound as functions of observations (..., 5) and of parameters."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.theta = torch.nn.Parameter(1.0 + 0.3 * torch.randn(24, generator=generator, dtype=torch.float64))

    def rows(self, obs: Tensor) -> Tensor:
        base = torch.tensor([[1.0, -2.0, 0.5], [-0.4, 0.3, 1.0], [0.0, 1.0, 0.2], [-1.0, 0.0, -0.3]])
        return base.double() * self.theta[:12].view(4, DIM) + 0.3 * obs[..., None, :DIM].sin()

    def bounds(self, obs: Tensor) -> Tensor:
        return 0.3 * self.theta[12:16] + 0.1 * obs[..., :4].cos()

    def matrix(self, obs: Tensor) -> Tensor:
        root = torch.eye(DIM, dtype=torch.float64) + 0.3 * self.theta[12:21].view(DIM, DIM) * obs[..., :1, None].cos()
        return root.mT @ root

    def middle(self, obs: Tensor) -> Tensor:
        return 0.1 * self.theta[21:24] * obs[..., 2:5].sin()

    def size(self, obs: Tensor) -> Tensor:
        return 0.3 * self.theta[20].square() + 0.1 * obs[..., 1].square()


def sets(learned: Learned) -> dict[str, Constraint]:
    rows = LinearConstraint(DIM, learned.rows, learned.bounds)
    ellipse = QuadraticConstraint(DIM, learned.matrix, learned.size, learned.middle)
    l1 = WeightedL1(lambda obs: 3.0 * learned.theta[:DIM] * obs[..., :DIM], 1.0, DIM)
    return {
        "rows": rows,
        "ellipse": ellipse,
        "both": Intersection(rows, ellipse),
        "with a closed form": Intersection(l1, ellipse),
        "nested": Intersection(Intersection(rows, l1), rows),
    }


NAMES = list(sets(Learned()))
CENTERED = [name for name in NAMES if name != "with a closed form"]


def inputs(name: str, count: int = 6) -> tuple[Learned, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(len(name))
    obs = torch.randn(count, 5, generator=generator, dtype=torch.float64)
    action = 1.5 * torch.randn(count, DIM, generator=generator, dtype=torch.float64)
    return Learned(), obs.requires_grad_(), action.requires_grad_()


def with_parameters(name: str, method: str):
    """The method as a function of parameters, observations and its other arguments."""

    def call(theta: Tensor, *rest: Tensor) -> Tensor:
        learned = Learned()
        del learned.theta
        learned.theta = theta
        return getattr(sets(learned)[name], method)(*rest)

    return call


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("method", ["project", "violation", "penalty", "alpha_map", "radial_map", "gauge_map"])
def test_gradients_with_respect_to_observations_parameters_and_actions(name, method):
    learned, obs, action = inputs(name)
    theta = learned.theta.detach().clone().requires_grad_()
    if method == "violation":  # at the box's edge, the gradient may be that of either side
        action = (0.6 * action.detach()).requires_grad_()
    assert gradcheck(with_parameters(name, method), (theta, obs, action), **OPTIONS)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_of_centers_and_gauges(name):
    learned, obs, action = inputs(name)
    theta = learned.theta.detach().clone().requires_grad_()
    center = sets(learned)[name].center(obs).detach().clone().requires_grad_()
    assert gradcheck(with_parameters(name, "center"), (theta, obs), **OPTIONS)
    assert gradcheck(with_parameters(name, "gauge"), (theta, obs, action, center), **OPTIONS)


@pytest.mark.parametrize("name", NAMES)
def test_projection_of_points_inside_and_far_away(name):
    learned, obs, _ = inputs(name)
    theta = learned.theta.detach().clone().requires_grad_()
    for action in (sets(learned)[name].center(obs).detach(), 50.0 * torch.ones(6, DIM, dtype=torch.float64)):
        assert gradcheck(with_parameters(name, "project"), (theta, obs, action), **OPTIONS)


def test_parameters_of_a_module_learn_through_a_projection():
    """Gradient descent recovers a bound from projections that were made with it."""
    learned = torch.nn.Linear(1, 1, dtype=torch.float64)
    set_ = LinearConstraint(2, lambda obs: torch.ones(1, 2, dtype=torch.float64), lambda obs: learned(obs))
    obs = torch.linspace(-1.0, 1.0, 20, dtype=torch.float64).unsqueeze(-1)
    true = LinearConstraint(2, lambda obs: torch.ones(1, 2, dtype=torch.float64), lambda obs: 0.3 * obs + 0.2)
    action = torch.ones(20, 2, dtype=torch.float64)
    optimizer = torch.optim.LBFGS(learned.parameters(), max_iter=50)

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = (set_.project(obs, action) - true.project(obs, action)).square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    assert abs(learned.weight.item() - 0.3) <= 1e-4 and abs(learned.bias.item() - 0.2) <= 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_values_do_not_depend_on_who_asks_for_gradients(name):
    learned, obs, action = inputs(name)
    constraint = sets(learned)[name]
    for method in ("project", "violation", "penalty", "alpha_map", "radial_map", "gauge_map"):
        with torch.no_grad():
            plain = getattr(constraint, method)(obs, action)
        torch.testing.assert_close(getattr(constraint, method)(obs, action).detach(), plain, rtol=0.0, atol=1e-12)
    with torch.no_grad():
        plain = constraint.center(obs)
    torch.testing.assert_close(constraint.center(obs).detach(), plain, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_what_has_no_gradient_is_refused(name):
    learned, obs, action = inputs(name)
    constraint = sets(learned)[name]
    with pytest.raises(RuntimeError, match="pass obs.detach|no derivatives") as error:
        constraint.linear_oracle(obs, action.detach())
    assert "\n" not in str(error.value)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(constraint.project(obs, action).sum(), obs, create_graph=True)
    with torch.no_grad():
        assert constraint.linear_oracle(obs, action).isfinite().all()


def test_a_center_between_guess_and_deepest_point_has_no_gradient():
    obs = torch.tensor([[-0.2, 0.0]], dtype=torch.float64, requires_grad=True)
    row = LinearConstraint(2, lambda obs: torch.ones(1, 2, dtype=torch.float64), lambda obs: obs[..., :1])
    both = Intersection(row, QuadraticConstraint(2, lambda obs: torch.eye(2, dtype=torch.float64), 0.5))
    with pytest.raises(RuntimeError, match="Intersection has no gradient.*not deep inside"):
        both.center(obs)
    assert both.center(obs.detach()).isfinite().all()


def test_violation_beside_the_box_has_the_whole_gradient():
    """Only the excess over the box counts, and it counts once."""
    action = torch.tensor([1.5, 0.2], dtype=torch.float64, requires_grad=True)
    row = LinearConstraint(
        2, lambda obs: torch.ones(1, 2, dtype=torch.float64), lambda obs: torch.tensor([5.0]).double()
    )
    row.violation(torch.zeros(1, dtype=torch.float64), action).backward()
    assert action.grad.tolist() == [1.0, 0.0]
