"""Gradients with respect to observations, centres and learned coefficients, and torch.func's transforms."""

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from constraints import (
    Ball,
    Box,
    Constraint,
    DiagonalEllipse,
    HalfSpace,
    Intersection,
    LinearConstraint,
    PlanarEllipse,
    QuadraticConstraint,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)

DIM = 3


class Coefficients(torch.nn.Module):
    """Learned functions of observations (..., 2 DIM): weights of both signs, positive scales and bounds, a matrix."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.theta = torch.nn.Parameter(1.0 + 0.2 * torch.randn(8, generator=generator, dtype=torch.float64))

    def weight(self, obs: Tensor) -> Tensor:
        return 2.0 * self.theta[:DIM] * obs[..., :DIM]

    def scale(self, obs: Tensor) -> Tensor:
        return (self.theta[3:6] * obs[..., DIM:]).square()

    def bound(self, obs: Tensor) -> Tensor:
        return 0.4 * self.theta[6].square() + 0.2 * obs[..., 0].square()

    def large(self, obs: Tensor) -> Tensor:
        return 1.0 + self.bound(obs)

    def matrix(self, obs: Tensor) -> Tensor:
        root = torch.stack(
            (self.theta[:2] + obs[..., :2], torch.stack((obs[..., 2], obs[..., 3] * self.theta[3]), -1)), -1
        )
        return root @ root.mT


def sets(c: Coefficients) -> dict[str, Constraint]:
    return {
        "l1": WeightedL1(c.weight, 1.2, DIM),
        "l1, bound of obs": WeightedL1(c.weight, c.bound, DIM),
        "positive part": WeightedPositivePart(c.weight, 0.8, DIM),
        "positive part, bound of obs": WeightedPositivePart(c.weight, c.bound, DIM),
        "half-space": HalfSpace(c.weight, 0.6, DIM),
        "half-space, bound of obs": HalfSpace(c.weight, c.bound, DIM),
        "ball, bound of obs": Ball(c.bound, DIM),
        "ball that the box cuts": Ball(c.large, DIM),
        "ellipse": DiagonalEllipse(c.scale, 0.7, DIM),
        "ellipse, bound of obs": DiagonalEllipse(c.scale, c.large, DIM),
        "planar ellipse": PlanarEllipse(c.matrix, 0.5),
        "planar ellipse, bound of obs": PlanarEllipse(c.matrix, c.large),
        "l1 and ellipse": WeightedL1AndEllipse(c.weight, 1.2, c.scale, 0.6, DIM),
        "l1 and ellipse, bounds of obs": WeightedL1AndEllipse(c.weight, c.large, c.scale, c.bound, DIM),
    }


SETS = tuple(sets(Coefficients()))
every_set = pytest.mark.parametrize("name", SETS)
OPTIONS = dict(eps=1e-6, atol=1e-5, rtol=1e-4)


def case(name: str, count: int = 12, scale: float = 1.3) -> tuple[Constraint, Tensor, Tensor, Tensor]:
    """The set, its parameters, observations and actions. The tensors require gradients."""
    coefficients = Coefficients()
    constraint = sets(coefficients)[name]
    generator = torch.Generator().manual_seed(7)
    obs = torch.randn(count, 2 * DIM, generator=generator, dtype=torch.float64).requires_grad_()
    action = scale * torch.randn(count, constraint.dim, generator=generator, dtype=torch.float64)
    return constraint, coefficients.theta, obs, action.requires_grad_()


def assert_gradients(function, theta: Tensor, *others: Tensor) -> None:
    """Check the gradients with respect to `others` and, through the module that holds it, `theta`."""

    assert gradcheck(function, others, **OPTIONS)
    (exact,) = torch.autograd.grad(weighted(function(*others)), theta)
    with torch.no_grad():
        numeric = torch.zeros_like(theta)
        for k in range(len(theta)):
            values = []
            for step in (1e-6, -1e-6):
                theta[k] += step
                values.append(weighted(function(*others)))
                theta[k] -= step
            numeric[k] = (values[0] - values[1]) / 2e-6
    torch.testing.assert_close(exact, numeric, rtol=1e-4, atol=1e-5)


def weighted(value: Tensor) -> Tensor:
    """A weighted sum of all entries, with a different weight for each."""
    return (value * torch.linspace(-1.0, 1.5, value.numel(), dtype=value.dtype).view_as(value)).sum()


@every_set
@pytest.mark.parametrize("scale", [0.3, 1.3, 6.0])
def test_projection(name, scale):
    constraint, theta, obs, action = case(name, scale=scale)
    assert_gradients(constraint.project, theta, obs, action)


@every_set
def test_penalty_and_violation(name):
    constraint, theta, obs, action = case(name)
    assert_gradients(constraint.penalty, theta, obs, action)
    assert_gradients(constraint.violation, theta, obs, action)


@every_set
def test_center(name):
    constraint, theta, obs, _ = case(name)
    if not constraint.origin_centered:
        assert_gradients(constraint.center, theta, obs)


@every_set
def test_gauge_and_maps_around_the_sets_own_center(name):
    constraint, theta, obs, action = case(name)
    for function in (constraint.alpha_map, constraint.radial_map):
        assert_gradients(function, theta, obs, action)
    action = (0.9 * action.detach().tanh()).requires_grad_()
    assert_gradients(constraint.gauge_map, theta, obs, action)


@every_set
def test_gauge_and_maps_around_a_given_center(name):
    constraint, theta, obs, action = case(name)
    center = constraint.alpha_map(obs, 0.1 * action.detach().flip(0)).detach().mul_(0.6).requires_grad_()
    for function in (constraint.gauge, constraint.alpha_map, constraint.radial_map, constraint.gauge_map):
        assert_gradients(lambda o, a, c, f=function: f(o, a.clamp(-0.95, 0.95), c), theta, obs, action, center)


@every_set
def test_densities(name):
    constraint, theta, obs, action = case(name)
    std = torch.full_like(action, 0.6)
    assert_gradients(lambda o, a: constraint.radial_log_prob(o, a, a.sum(-1)), theta, obs, action)
    assert_gradients(lambda o, a: constraint.alpha_log_prob(o, a, 0.5 * a, std), theta, obs, action)
    inside = (0.9 * action.detach().tanh()).requires_grad_()
    assert_gradients(lambda o, a: constraint.gauge_log_prob(o, a, a.sum(-1)), theta, obs, inside)


# ------------------------------------------------------------------------------------------ no gradients


def general(learned: Tensor) -> dict[str, Constraint]:
    rows = LinearConstraint(
        2, lambda obs: learned * torch.ones(*obs.shape[:-1], 1, 2, dtype=torch.float64), lambda obs: obs[..., :1] ** 2
    )
    ellipse = QuadraticConstraint(2, lambda obs: learned * torch.eye(2, dtype=torch.float64), 0.5)
    return {"rows": rows, "ellipse": ellipse, "intersection": Intersection(rows, ellipse)}


@pytest.mark.parametrize("name", ["rows", "ellipse", "intersection"])
def test_general_sets_have_those_of_violation_penalty_and_gauge(name):
    obs = torch.tensor([[0.7, 0.1], [1.2, 0.3]], dtype=torch.float64, requires_grad=True)
    action = torch.tensor([[0.9, 0.4], [0.8, 0.9]], dtype=torch.float64, requires_grad=True)
    theta = torch.tensor(1.1, dtype=torch.float64, requires_grad=True)
    center = torch.tensor([0.05, -0.1], dtype=torch.float64, requires_grad=True)

    def of(method):
        return lambda theta, obs, *rest: getattr(general(theta)[name], method)(obs, *rest)

    for method in ("violation", "penalty"):
        assert gradcheck(of(method), (theta, obs, action), **OPTIONS)
    for method in ("gauge", "alpha_map", "radial_map", "gauge_map"):
        assert gradcheck(of(method), (theta, obs, action, center), **OPTIONS)


def test_the_oracle_refuses_what_it_would_cut():
    constraint, theta, obs, action = case("l1")
    for wanted in (obs, obs.detach()):  # in the second case only the weights are learned
        with pytest.raises(RuntimeError, match="linear_oracle has no derivatives"):
            constraint.linear_oracle(wanted, action.detach())
    with torch.no_grad():
        assert constraint.linear_oracle(obs, action).isfinite().all()


def test_a_constraint_of_ones_own_refuses_what_it_would_cut():
    class Own(Box):
        def _at(self, obs):
            return obs

        def _project(self, obs, action):
            point, product = super()._project(obs, action)
            return point * obs[..., :1].abs().clamp(max=1.0) * theta, product

    theta, action = torch.ones((), dtype=torch.float64), torch.ones(4, 2, dtype=torch.float64, requires_grad=True)
    obs = torch.ones(4, 3, dtype=torch.float64)
    assert Own(2).project(obs, action).requires_grad
    with pytest.raises(RuntimeError, match="projections of Own have no gradient"):
        Own(2).project(obs.clone().requires_grad_(), action).sum().backward()
    theta.requires_grad_()
    with pytest.raises(RuntimeError, match="projections of Own have no gradient"):
        Own(2).project(obs, action)


# ------------------------------------------------------------------------------------------ degenerate states


@every_set
def test_gradients_are_finite_where_coefficients_are_zero(name):
    """Coefficients are zero at a robot's start, when all velocities are 0."""
    constraint, theta, obs, action = case(name)
    with torch.no_grad():
        obs[:3] = 0.0
        obs[3:6, ::2] = 0.0
        action[::3] = 0.0
    values = [
        constraint.project(obs, action),
        constraint.penalty(obs, action),
        constraint.violation(obs, action),
        constraint.alpha_map(obs, action),
        constraint.radial_map(obs, action),
        constraint.gauge_map(obs, action.tanh()),
        constraint.gauge(obs, action, None),
    ]
    if not constraint.origin_centered:
        values.append(constraint.center(obs))
    for value in values:
        for gradient in torch.autograd.grad(value.sum(), (obs, theta), retain_graph=True, allow_unused=True):
            assert gradient is None or gradient.isfinite().all()


@every_set
def test_values_do_not_depend_on_who_wants_gradients(name):
    constraint, _, obs, action = case(name, count=40)
    center = constraint.alpha_map(obs, 0.1 * action.flip(0)).detach() * 0.6
    functions = [constraint.project, constraint.alpha_map, constraint.radial_map, constraint.violation]
    functions += [lambda o, a, f=f: f(o, a.clamp(-1, 1), center) for f in (constraint.gauge, constraint.gauge_map)]
    for function in functions:
        with torch.no_grad():
            expected = function(obs, action)
        torch.testing.assert_close(function(obs, action), expected, rtol=1e-13, atol=1e-15)


# ------------------------------------------------------------------------------------------ torch.func


def with_fixed_sets(name: str) -> tuple[Constraint, Tensor, Tensor]:
    """A set without learned parameters, observations and actions. Includes sets that need no observation."""
    if name in FIXED:
        obs = torch.zeros(5, 2 * DIM, dtype=torch.float64)
        return FIXED[name], obs, 1.3 * torch.randn(5, DIM, generator=torch.Generator().manual_seed(3)).double()
    constraint, theta, obs, action = case(name, count=5)
    theta.requires_grad_(False)
    return constraint, obs.detach(), action.detach()


FIXED = {"box": Box(DIM), "ball": Ball(0.5, DIM)}
every_transformable_set = pytest.mark.parametrize("name", (*FIXED, *SETS))
MAPS = ("project", "alpha_map", "radial_map", "gauge_map")


@every_transformable_set
def test_vmap(name):
    constraint, obs, action = with_fixed_sets(name)
    action = action.clamp(-1.0, 1.0)
    for method in (*MAPS, "violation", "penalty"):
        function = getattr(constraint, method)
        expected = function(obs, action)
        torch.testing.assert_close(torch.func.vmap(function)(obs, action), expected, msg=method)
        shared = torch.func.vmap(function, in_dims=(None, 0))(obs[0], action)
        torch.testing.assert_close(shared, function(obs[0], action), msg=method)
        crossed = torch.func.vmap(function, in_dims=(0, None))(obs, action)
        torch.testing.assert_close(crossed, function(obs.unsqueeze(1), action), msg=method)
    torch.testing.assert_close(torch.func.vmap(constraint.center)(obs), constraint.center(obs))


@every_transformable_set
def test_jacrev(name):
    constraint, obs, action = with_fixed_sets(name)
    action = 0.9 * action.tanh()
    for method in MAPS:
        function = getattr(constraint, method)
        for argument in (0, 1):
            exact = torch.func.vmap(torch.func.jacrev(function, argnums=argument))(obs, action)
            for k in range(len(obs)):
                inputs = obs[k].clone().requires_grad_(), action[k].clone().requires_grad_()
                rows = [
                    torch.autograd.grad(x, inputs[argument], retain_graph=True, allow_unused=True)[0]
                    for x in function(*inputs)
                ]
                expected = torch.stack([torch.zeros_like(inputs[argument]) if row is None else row for row in rows])
                torch.testing.assert_close(exact[k], expected, msg=f"{method}, argument {argument}")
                alone = torch.func.jacrev(function, argnums=argument)(obs[k], action[k])
                torch.testing.assert_close(alone, expected, msg=f"{method}, argument {argument}")


def test_what_has_no_transforms_says_so():
    constraint, obs, action = with_fixed_sets("ellipse")
    std = torch.ones_like(action)
    for function, what in (
        (constraint.linear_oracle, "linear_oracle"),
        (lambda o, a: constraint.sample(o, 2), "sample"),
        (lambda o, a: constraint.radial_log_prob(o, a, a.sum(-1)), "the density of the radial map"),
        (lambda o, a: constraint.alpha_log_prob(o, a, a, std[0]), "the density of the alpha map"),
    ):
        with pytest.raises(RuntimeError, match=f"{what} does not support torch.func transforms"):
            torch.func.vmap(function)(obs, action)


def test_vmap_of_general_sets():
    constraint = general(torch.ones((), dtype=torch.float64))["intersection"]
    obs, action = torch.rand(4, 3, dtype=torch.float64), torch.rand(4, 2, dtype=torch.float64)
    torch.testing.assert_close(torch.func.vmap(constraint.project)(obs, action), constraint.project(obs, action))
    exact = torch.func.vmap(torch.func.jacrev(constraint.project, argnums=1))(obs, action)
    expected = [
        torch.autograd.functional.jacobian(lambda a, k=k: constraint.project(obs[k], a), action[k]) for k in range(4)
    ]
    torch.testing.assert_close(exact, torch.stack(expected))


@pytest.mark.parametrize("name", ["rows", "ellipse", "intersection"])
def test_vmap_of_what_looks_at_values_says_so(name):
    constraint = general(torch.ones((), dtype=torch.float64))[name]
    obs, action = torch.rand(4, 3, dtype=torch.float64), torch.rand(4, 2, dtype=torch.float64)
    for method in ("violation", "penalty", "contains", *MAPS[1:]):
        with pytest.raises(RuntimeError, match="supports torch.func.vmap only in project"):
            torch.func.vmap(getattr(constraint, method))(obs, action)
    for method in (constraint.center, constraint.least_violation):
        with pytest.raises(RuntimeError, match="supports torch.func.vmap only in project"):
            torch.func.vmap(method)(obs)
    for method in (constraint.center, lambda obs: constraint.alpha_map(obs, action[0])):
        with pytest.raises(RuntimeError, match="the centre of .* does not support torch.func transforms"):
            torch.func.jacrev(method)(obs[0])


@every_set
def test_second_derivatives_are_refused_or_right(name):
    """Gradients with respect to the action alone, the usual case, have no second derivatives; nor have projections."""
    constraint, theta, obs, action = case(name, count=4)
    theta.requires_grad_(False)
    plain = obs.detach()
    for method in MAPS:
        value = weighted(getattr(constraint, method)(plain, action.clamp(-0.9, 0.9)))
        with pytest.raises(RuntimeError, match="first derivatives only"):
            torch.autograd.grad(value, action, create_graph=True)
    gradient = torch.autograd.grad(weighted(constraint.project(obs, action)), obs, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(gradient.sum(), obs)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.func.jacrev(torch.func.jacrev(constraint.project, argnums=1), argnums=1)(plain[0], action[0].detach())
    for method in MAPS[1:]:
        assert torch.autograd.gradgradcheck(
            lambda o, a, m=method: getattr(constraint, m)(o, a.clamp(-0.9, 0.9)), (obs, action), **OPTIONS
        )
