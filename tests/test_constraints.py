"""Closed forms of the paper's 13 feasible sets against independent solvers and their own definitions."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from feasible_sets import (
    TASKS,
    angles,
    every_task,
    interior_point,
    ones,
    sample_action,
    sample_obs,
    tip_matrix,
    velocities,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from references import ReferenceSet, sign_rows
from torch import Tensor

from constraints import (
    Ball,
    Box,
    DiagonalEllipse,
    PlanarEllipse,
    WeightedL1,
    WeightedL1AndEllipse,
)

# ------------------------------------------------------------------------------------------ against other solvers


@every_task
def test_violation_and_penalty_are_the_definitions(task):
    obs, action = sample_obs(task, 100, 0), sample_action(task, 100, 0)
    violation, penalty = task.constraint.violation(obs, action), task.constraint.penalty(obs, action)
    for k in range(len(obs)):
        reference = task.reference_at(obs[k])
        assert violation[k].item() == pytest.approx(reference.violation(action[k].numpy()), rel=1e-9, abs=1e-9)
        assert penalty[k].item() == pytest.approx(reference.penalty(action[k].numpy()), rel=1e-9, abs=1e-9)


@every_task
@pytest.mark.parametrize("scale", [0.5, 1.5, 30.0])
def test_projection_is_the_solver_s(task, scale):
    obs, action = sample_obs(task, 60, 1), sample_action(task, 60, 1, scale)
    projected = task.constraint.project(obs, action)
    for k in range(len(obs)):
        reference, a, p = task.reference_at(obs[k]), action[k].numpy(), projected[k].numpy()
        np.testing.assert_allclose(p, reference.project(a), atol=1e-4)
        assert reference.violation(p) <= 1e-12
        assert reference.normal_cone_residual(p, a - p) <= 1e-10 * scale


@every_task
def test_oracle_attains_the_solver_s_value(task):
    obs, gradient = sample_obs(task, 80, 2), sample_action(task, 80, 2)
    best = task.constraint.linear_oracle(obs, gradient)
    for k in range(len(obs)):
        reference, g, p = task.reference_at(obs[k]), gradient[k].numpy(), best[k].numpy()
        assert g @ p == pytest.approx(g @ reference.linear_oracle(g), abs=1e-7)
        assert reference.violation(p) <= 1e-12
        assert reference.normal_cone_residual(p, g) <= 1e-9


@every_task
def test_center_is_chebyshev_s_or_the_origin(task):
    obs = sample_obs(task, 80, 3)
    center = task.constraint.center(obs)
    if task.constraint.origin_centered:
        assert torch.equal(center, torch.zeros_like(center))
    if not task.linear:
        assert task.constraint.origin_centered
        return
    for k in range(len(obs)):
        # The centre of a ball of radius r has a violation of -r or less in unit rows. Zero rows have no distance.
        reference = task.reference_at(obs[k])
        kept = np.linalg.norm(reference.rows, axis=1) > 0.0
        reference = ReferenceSet(reference.rows[kept], reference.bounds[kept])
        assert -reference.violation(center[k].numpy()) == pytest.approx(reference.chebyshev_radius(), abs=1e-9)


@pytest.mark.parametrize(
    "w, s, gradient",
    [
        ([2.0, 1.0], [1.0, 1.0], [0.2, 0.1]),  # the ellipse limits the oracle, the row does not
        ([1.5, 3.0], [0.0, 3.0], [0.15, 0.3]),  # the ellipse does not limit the first coordinate
        ([1.3125, 3.0], [1.0, 1.0], [0.13125, 0.3]),  # the ratios are equal up to rounding
        ([1.0, 1.0], [0.0, 1.0], [0.1, 0.1]),
    ],
)
def test_oracle_where_the_gradient_ties_with_the_row(w, s, gradient):
    constraint = WeightedL1AndEllipse(velocities, 1.0, lambda obs: angles(obs).square(), 0.1, 2)
    reference = ReferenceSet(sign_rows(np.array(w)), np.ones(4), np.diag(np.square(s)), 0.1)
    best = constraint.linear_oracle(torch.tensor(w + s).double(), torch.tensor(gradient).double()).numpy()
    assert reference.violation(best) <= 1e-12
    assert gradient @ best == pytest.approx(gradient @ reference.linear_oracle(np.array(gradient)), abs=1e-9)


# ------------------------------------------------------------------------------------------ gauge and the maps


@every_task
@pytest.mark.parametrize("off_center", [False, True])
def test_gauge_reaches_the_boundary(task, off_center):
    obs, direction = sample_obs(task, 200, 4), sample_action(task, 200, 4)
    direction[:20, 0] = 0.0
    direction[10:30] *= 1e30
    direction[30:40] *= 1e-30
    center = interior_point(task, obs, 5) if off_center else task.constraint.center(obs)
    gauge = task.constraint.gauge(obs, direction, center)
    boundary = center + direction / gauge.unsqueeze(-1)
    for k in range(len(obs)):
        assert task.reference_at(obs[k]).violation(boundary[k].numpy()) == pytest.approx(0.0, abs=1e-9)
    ones = torch.ones(len(obs), dtype=torch.float64)
    torch.testing.assert_close(task.constraint.gauge(obs, boundary - center, center), ones, rtol=1e-7, atol=0.0)
    torch.testing.assert_close(task.constraint.gauge(obs, 3.0 * direction, center), 3.0 * gauge, rtol=1e-12, atol=0.0)
    if not off_center and task.constraint.origin_centered:
        torch.testing.assert_close(task.constraint.gauge(obs, direction, None), gauge, rtol=1e-12, atol=0.0)


@every_task
def test_large_directions_stay_finite_in_float32(task):
    obs = sample_obs(task, 50, 6).float()
    action = sample_action(task, 50, 6).float() * 1e30
    for mapped in (task.constraint.alpha_map(obs, action), task.constraint.radial_map(obs, action)):
        violation = task.constraint.violation(obs.double(), mapped.double())
        assert violation.abs().max() < 1e-6  # on the boundary


@pytest.mark.parametrize("name", ["R+M", "H+M", "W+M", "HC+MA"])
@pytest.mark.parametrize("speed", [1e12, 1e15, 1e18, 1e30])
def test_rays_off_centre_are_exact_at_any_velocity(name, speed):
    """A coordinate that crosses 0 has a rounding error that, times such a velocity, would exceed any bound."""
    task = TASKS[name]
    obs, action = sample_obs(task, 500, 19, largest=1.0), sample_action(task, 500, 19, 3.0)
    velocities(obs).mul_(speed)
    for mapped in (task.constraint.alpha_map(obs, action), task.constraint.radial_map(obs, action)):
        assert task.constraint.violation(obs, mapped).max() <= 1e-9


@every_task
def test_alpha_map_keeps_feasible_points_and_stops_at_the_boundary(task):
    obs, action = sample_obs(task, 200, 7), sample_action(task, 200, 7)
    action[::2] *= 0.2
    mapped = task.constraint.alpha_map(obs, action)
    feasible = task.constraint.violation(obs, action) <= 0.0
    assert 0 < feasible.sum() < len(obs)
    torch.testing.assert_close(mapped[feasible], action[feasible], rtol=0.0, atol=1e-15)
    torch.testing.assert_close(
        task.constraint.violation(obs, mapped)[~feasible],
        torch.zeros(int((~feasible).sum()), dtype=torch.float64),
        rtol=0.0,
        atol=1e-9,
    )
    center = task.constraint.center(obs)
    moved, asked = mapped - center, action - center
    cosine = torch.nn.functional.cosine_similarity(moved, asked, dim=-1)
    torch.testing.assert_close(cosine, torch.ones_like(cosine))


@every_task
def test_radial_map_is_the_paper_s_formula(task):
    obs, action = sample_obs(task, 100, 8, largest=100.0), sample_action(task, 100, 8)
    center = task.constraint.center(obs)
    offset = action - center
    boundary = center + offset / task.constraint.gauge(obs, offset, center).unsqueeze(-1)
    ratio = offset.norm(dim=-1) / (boundary - center).norm(dim=-1)
    expected = center + ratio.tanh().unsqueeze(-1) * (boundary - center)
    torch.testing.assert_close(task.constraint.radial_map(obs, action), expected, rtol=1e-10, atol=1e-12)


@every_task
def test_radial_map_s_jacobian_at_the_center_is_the_identity(task):
    obs = sample_obs(task, 8, 9, largest=100.0)[4:]
    for k in range(len(obs)):
        center = task.constraint.center(obs[k])
        jacobian = torch.autograd.functional.jacobian(lambda a, k=k: task.constraint.radial_map(obs[k], a), center)
        torch.testing.assert_close(jacobian, torch.eye(task.constraint.dim, dtype=torch.float64))


@every_task
def test_radial_log_prob_is_the_jacobian_s_determinant(task):
    obs, action = sample_obs(task, 20, 10, largest=30.0), sample_action(task, 20, 10, 0.7)
    log_prob = torch.linspace(-1.0, 1.0, 20, dtype=torch.float64)
    got = task.constraint.radial_log_prob(obs, action, log_prob)
    for k in range(len(obs)):
        jacobian = torch.autograd.functional.jacobian(lambda a, k=k: task.constraint.radial_map(obs[k], a), action[k])
        # Beyond a gauge of about 6, the determinant loses digits; the formula does not.
        if jacobian.det().abs() > 1e-6:
            expected = log_prob[k] - jacobian.det().abs().log()
            torch.testing.assert_close(got[k], expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", ["R+N", "R+L2", "R+O10", "R+M", "R+T"])
def test_alpha_log_prob_has_mass_one(name):
    constraint = TASKS[name].constraint
    obs = torch.tensor([2.0, 1.5, 0.3, 0.8], dtype=torch.float64)
    mean = torch.tensor([0.2, -0.3], dtype=torch.float64)
    std = torch.tensor([0.5, 0.3], dtype=torch.float64)
    center = constraint.center(obs)
    count = 20000
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (2.0 * math.pi / count)
    ray = torch.stack((angle.cos(), angle.sin()), -1)
    radius = 1.0 / constraint.gauge(obs, ray, center)
    # Interior: integrate in polar coordinates around the centre.
    fraction = (torch.arange(200, dtype=torch.float64) + 0.5) / 200
    coarse, reach = ray[::20], radius[::20]
    inside = center + fraction[:, None, None] * reach[:, None] * coarse
    density = constraint.alpha_log_prob(obs, inside, mean, std).exp()
    interior = (density * fraction[:, None] * reach**2).mean(0).mean() * 2.0 * math.pi
    # Boundary: on each segment of the polygon through the boundary points, use the density at the ends.
    boundary = center + radius[:, None] * ray
    beyond = center + 1.5 * radius[:, None] * ray  # any action on the ray past the boundary maps to it
    surface = constraint.alpha_log_prob(obs, beyond, mean, std).exp()
    length = (boundary.roll(-1, 0) - boundary).norm(dim=-1)
    mass = interior + (0.5 * (surface + surface.roll(-1, 0)) * length).sum()
    assert mass.item() == pytest.approx(1.0, abs=1e-3)


# ------------------------------------------------------------------------------------------ gradients


def assert_gradient_is_exact(function: Callable[[Tensor], Tensor], action: Tensor) -> None:
    """Compares the Jacobian with central differences. Rows of a batch are independent, so all move at once."""
    action = action.clone().requires_grad_()
    value = function(action)
    outputs = value.unsqueeze(-1) if value.dim() == 1 else value
    exact = torch.stack(
        [torch.autograd.grad(out.sum(), action, retain_graph=True)[0] for out in outputs.unbind(-1)], -2
    )
    step = 1e-6 * torch.eye(action.shape[-1], dtype=action.dtype)
    with torch.no_grad():
        numeric = torch.stack([(function(action + e) - function(action - e)) / 2e-6 for e in step], -1)
    torch.testing.assert_close(exact, numeric.view_as(exact), rtol=1e-4, atol=1e-5)


@every_task
@pytest.mark.parametrize("scale", [0.4, 2.0])
def test_gradients_are_exact(task, scale):
    constraint, obs = task.constraint, sample_obs(task, 200, 11, largest=30.0)
    action = sample_action(task, 200, 11, scale)
    center = interior_point(task, obs, 12)
    mean, std = torch.zeros_like(action), torch.full_like(action, 0.5)
    assert_gradient_is_exact(lambda a: constraint.project(obs, a), action)
    assert_gradient_is_exact(lambda a: constraint.alpha_map(obs, a), action)
    assert_gradient_is_exact(lambda a: constraint.radial_map(obs, a), action)
    assert_gradient_is_exact(lambda a: constraint.alpha_map(obs, a, center), action)
    assert_gradient_is_exact(lambda a: constraint.radial_map(obs, a, center), action)
    assert_gradient_is_exact(lambda a: constraint.gauge(obs, a, center), action)
    assert_gradient_is_exact(lambda a: constraint.radial_log_prob(obs, a, a.sum(-1)), action)
    assert_gradient_is_exact(lambda a: constraint.alpha_log_prob(obs, a, mean, std), action)
    assert_gradient_is_exact(lambda a: constraint.penalty(obs, a), action)


@every_task
def test_gradients_are_finite_where_the_functions_have_kinks(task):
    obs = sample_obs(task, 100, 13)
    for action in (torch.zeros(100, task.constraint.dim).double(), task.constraint.center(obs), torch.ones_like(obs)):
        action = action[..., : task.constraint.dim].clone().requires_grad_()
        std = torch.full_like(action, 0.5)
        values = (
            task.constraint.project(obs, action),
            task.constraint.alpha_map(obs, action),
            task.constraint.radial_map(obs, action),
            task.constraint.penalty(obs, action),
            task.constraint.violation(obs, action),
            task.constraint.gauge(obs, action, None),
            task.constraint.radial_log_prob(obs, action, action.sum(-1)),
            task.constraint.alpha_log_prob(obs, action, torch.zeros_like(action), std),
        )
        for value in values:
            (gradient,) = torch.autograd.grad(value.sum(), action)
            assert value.isfinite().all() and gradient.isfinite().all()


@every_task
def test_projection_inside_has_the_identity_as_jacobian(task):
    obs = sample_obs(task, 50, 14)
    action = (0.5 * interior_point(task, obs, 14)).requires_grad_()
    weights = sample_action(task, 50, 15)
    action.data[:10] = 0.0
    inside = task.constraint.violation(obs, action.detach()) < 0.0
    assert inside.all()
    (gradient,) = torch.autograd.grad((weights * task.constraint.project(obs, action)).sum(), action)
    torch.testing.assert_close(gradient, weights)


# ------------------------------------------------------------------------------------------ any input


@every_task
@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    reach=st.sampled_from([0.0, 1e-3, 0.1, 1.0, 3.0, 1e3, 1e6]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_every_point_is_feasible(task, seed, reach, dtype):
    obs = sample_obs(task, 40, seed).to(dtype)
    action = sample_action(task, 40, seed, reach).to(dtype)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-9
    projected = task.constraint.project(obs, action)
    for point in (
        projected,
        task.constraint.alpha_map(obs, action),
        task.constraint.radial_map(obs, action),
        task.constraint.linear_oracle(obs, action),
        task.constraint.center(obs),
    ):
        assert point.dtype == dtype
        assert task.constraint.violation(obs.double(), point.double()).max() <= tolerance
    # A projection leaves feasible points unchanged and does not increase distances.
    again = task.constraint.project(obs, projected)
    torch.testing.assert_close(again, projected, rtol=0.0, atol=tolerance)
    other = sample_action(task, 40, seed + 1, reach).to(dtype)
    apart = (task.constraint.project(obs, other) - projected).norm(dim=-1)
    assert (apart <= (other - action).norm(dim=-1) * (1.0 + 1e-5) + tolerance).all()


@every_task
def test_float32_agrees_with_float64(task):
    obs, action = sample_obs(task, 200, 16, largest=30.0).float(), sample_action(task, 200, 16).float()
    for function in (
        task.constraint.project,
        task.constraint.alpha_map,
        task.constraint.radial_map,
        task.constraint.violation,
        task.constraint.penalty,
        task.constraint.linear_oracle,
    ):
        single, double = function(obs, action), function(obs.double(), action.double())
        torch.testing.assert_close(single.double(), double, rtol=1e-5, atol=1e-5)


@every_task
@pytest.mark.parametrize("speed", [0.0, 1e-12, 1e6])
@pytest.mark.parametrize("angle", [0.0, math.pi, math.pi + 1e-8, 0.7])
def test_degenerate_states(task, speed, angle):
    dim = task.constraint.dim
    w = torch.full((dim,), speed).double() * torch.tensor([(-1.0) ** k for k in range(dim)]).double()
    obs = torch.cat((w, torch.full((dim,), angle).double()))
    reference = task.reference_at(obs)
    for seed in range(4):
        action = sample_action(task, 1, seed, 2.0)[0]
        projected, best = task.constraint.project(obs, action), task.constraint.linear_oracle(obs, action)
        assert reference.violation(projected.numpy()) <= 1e-9
        assert reference.violation(best.numpy()) <= 1e-9
        assert reference.normal_cone_residual(projected.numpy(), (action - projected).numpy()) <= 1e-7
        assert reference.normal_cone_residual(best.numpy(), action.numpy()) <= 1e-7
        assert reference.violation(task.constraint.radial_map(obs, action).numpy()) <= 1e-9


@every_task
def test_leading_shapes(task):
    constraint, dim = task.constraint, task.constraint.dim
    obs, action = sample_obs(task, 12, 17), sample_action(task, 12, 17)
    std = torch.full_like(action, 0.5)
    functions = {
        "project": constraint.project,
        "alpha_map": constraint.alpha_map,
        "radial_map": constraint.radial_map,
        "linear_oracle": constraint.linear_oracle,
        "violation": constraint.violation,
        "penalty": constraint.penalty,
        "gauge": lambda o, a: constraint.gauge(o, a, None),
        "radial_log_prob": lambda o, a: constraint.radial_log_prob(o, a, a.sum(-1)),
        "alpha_log_prob": lambda o, a: constraint.alpha_log_prob(o, a, torch.zeros(dim).double(), std[0]),
    }
    for name, function in functions.items():
        flat = function(obs, action)
        stacked = function(obs.view(3, 4, -1), action.view(3, 4, dim))
        torch.testing.assert_close(stacked.flatten(0, 1), flat, rtol=0.0, atol=1e-12, msg=name)
        one = function(obs[5], action[5])
        torch.testing.assert_close(one, flat[5], rtol=0.0, atol=1e-12, msg=name)
        shared_obs = function(obs[0], action)
        torch.testing.assert_close(shared_obs, function(obs[:1].expand(12, -1), action), msg=name)
        shared_action = function(obs, action[0])
        torch.testing.assert_close(shared_action, function(obs, action[:1].expand(12, -1)), msg=name)
        empty = function(obs[:0], action[:0])
        assert empty.shape == (0, *flat.shape[1:]), name
    assert constraint.center(obs[0]).shape == (dim,)
    assert constraint.center(obs.view(3, 4, -1)).shape == (3, 4, dim)
    assert constraint.center(obs[:0]).shape == (0, dim)


@every_task
def test_nan_is_passed_on(task):
    obs, action = sample_obs(task, 40, 18), sample_action(task, 40, 18)
    action[::2, 0] = math.nan
    action[1::4, -1] = math.nan
    bad = action.isnan().any(-1)
    for function in (task.constraint.project, task.constraint.alpha_map, task.constraint.radial_map):
        mapped = function(obs, action)
        assert mapped.isnan().any(-1)[bad].all()
        assert mapped[~bad].isfinite().all()
    assert task.constraint.violation(obs, action)[bad].isnan().all()
    assert task.constraint.penalty(obs, action)[bad].isnan().all()
    assert task.constraint.linear_oracle(obs, action)[bad].isnan().all()


@pytest.mark.parametrize("name", ["R+M", "H+M", "W+M"])
def test_center_is_continuous(name):
    """Along a path on which weights change sign, one after the other and then all at once."""
    constraint = TASKS[name].constraint
    dim = constraint.dim
    time = torch.linspace(-1.0, 1.0, 20001).double().unsqueeze(-1)
    w = 12.0 * (time * torch.linspace(1.0, 2.0, dim) + 0.3 * torch.arange(dim) * (time.abs() > 0.0)).double()
    for path in (12.0 * time * torch.linspace(1.0, 2.0, dim), w):
        center = constraint.center(torch.cat((path, torch.zeros_like(path)), -1))
        step = (path[1:] - path[:-1]).norm(dim=-1)
        assert ((center[1:] - center[:-1]).norm(dim=-1) <= step + 1e-12).all()


def test_center_of_a_free_set_is_the_origin():
    for name in ("R+M", "H+M", "W+M", "HC+MA"):
        constraint = TASKS[name].constraint
        assert torch.equal(constraint.center(torch.zeros(2 * constraint.dim)), torch.zeros(constraint.dim))


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="bound"):
        WeightedL1(velocities, 0.0, 2)
    with pytest.raises(ValueError, match="bound"):
        DiagonalEllipse(ones, -1.0, 2)
    with pytest.raises(ValueError, match="bound"):
        PlanarEllipse(tip_matrix, 0.0)
    with pytest.raises(ValueError, match="dim"):
        Box(0)
    with pytest.raises(ValueError, match="coordinates"):
        Box(2).project(torch.zeros(4), torch.zeros(3))
    # Results would be truncated to whole numbers.
    for method in (Box(2).project, Box(2).alpha_map, Box(2).linear_oracle, Box(2).violation):
        with pytest.raises(TypeError, match="int64"):
            method(torch.zeros(4), torch.ones(2, dtype=torch.int64))
    with pytest.raises(TypeError, match="int64"):
        Box(2).center(torch.zeros(4, dtype=torch.int64))


@every_task
def test_nan_in_the_observation_is_passed_on(task):
    obs, action = sample_obs(task, 20, 20), 0.1 * sample_action(task, 20, 20)
    obs[:] = math.nan
    if isinstance(task.constraint, Box | Ball) or task is TASKS["disc"]:
        return  # these sets do not depend on the observation
    for function in (task.constraint.project, task.constraint.alpha_map, task.constraint.radial_map):
        assert function(obs, action).isnan().any(-1).all()


def test_ellipses_next_to_nothing_do_not_bound_a_ray():
    tiny = 2e-81
    constraint = PlanarEllipse(
        lambda obs: torch.tensor([[0.0, 0.0], [0.0, tiny**2]], dtype=torch.float64).expand(*obs.shape[:-1], 2, 2), 0.05
    )
    action = torch.tensor([0.0, tiny], dtype=torch.float64)
    for mapped in (constraint.alpha_map(torch.zeros(1), action), constraint.radial_map(torch.zeros(1), action)):
        torch.testing.assert_close(mapped, action)
