"""The gauge map and its log-density: feasible, onto, a probability density, with exact gradients, on every set."""

from __future__ import annotations

import math

import pytest
import torch
from feasible_sets import (
    SETS,
    SHAPES,
    TASKS,
    Task,
    every_task,
    feasible_sets,
    gauge_and_gradient,
    interior_point,
    no_obs,
    observation,
    random_set,
    sample_action,
    sample_obs,
)
from torch import Tensor
from torch.autograd import gradcheck
from torch.autograd.functional import jacobian

from constraints import Box, Constraint, Intersection, LinearConstraint

every_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)
every_set = pytest.mark.parametrize("name", SETS)


def in_box(count: int, dim: int, seed: int = 0, reach: float = 1.0) -> Tensor:
    """Points (count, dim) with max_i |u_i| <= reach; some have coordinates 0 or equal, some lie on the boundary."""
    generator = torch.Generator().manual_seed(seed)
    u = 2.0 * torch.rand(count, dim, generator=generator, dtype=torch.float64) - 1.0
    u[: count // 8, 0] = 0.0
    u[count // 8 : count // 4] = u[count // 8 : count // 4, :1]
    edge = slice(count // 4, count // 2)
    u[edge] /= u[edge].abs().amax(-1, keepdim=True)
    return reach * u


def centers(task: Task, obs: Tensor) -> list[Tensor | None]:
    """The set's own centre and another interior point."""
    return [None, interior_point(task, obs, 5)]


# ---------------------------------------------------------------- the image of the map


@every_task
@pytest.mark.parametrize("reach", [1.0, 1e-3, 1e-200, 5e-324])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-9)])
def test_it_is_feasible_on_every_task(task, reach, dtype, tolerance):
    obs = sample_obs(task, 200, 21)
    for center in centers(task, obs):
        u = in_box(200, task.constraint.dim, reach=reach).to(dtype)
        mapped = task.constraint.gauge_map(obs.to(dtype), u, center if center is None else center.to(dtype))
        assert mapped.dtype == dtype
        assert task.constraint.violation(obs.to(dtype).double(), mapped.double()).max() <= tolerance


@every_shape
def test_it_is_feasible_on_general_sets(shape):
    constraint, obs = random_set(*shape, seed=sum(map(int, shape)), batch=40), no_obs(40)
    u = in_box(40, shape[0], 1)
    for center in (None, constraint.center(obs), 0.5 * (constraint.center(obs) + constraint.project(obs, u))):
        if center is not None and constraint.violation(obs, center).max() > -1e-6:
            continue
        assert constraint.violation(obs, constraint.gauge_map(obs, u, center)).max() <= 1e-9


@every_task
def test_the_boundary_of_the_box_goes_to_the_boundary_of_the_set(task):
    obs = sample_obs(task, 200, 22)
    u = sample_action(task, 200, 22)
    u /= u.abs().amax(-1, keepdim=True)
    for center in centers(task, obs):
        mapped = task.constraint.gauge_map(obs, u, center)
        zero = torch.zeros(200, dtype=torch.float64)
        torch.testing.assert_close(task.constraint.violation(obs, mapped), zero, rtol=0.0, atol=1e-9)


@every_task
def test_it_is_its_definition_and_reaches_every_point(task):
    constraint, obs = task.constraint, sample_obs(task, 200, 23)
    for center in centers(task, obs):
        c = constraint.center(obs) if center is None else center
        u = in_box(200, constraint.dim, 23)
        ratio = u.abs().amax(-1) / constraint.gauge(obs, u, c)
        torch.testing.assert_close(constraint.gauge_map(obs, u, center), c + ratio.unsqueeze(-1) * u)
        # The preimage of a feasible point a is v L(v) / max_i |v_i| with v = a - c.
        target = constraint.project(obs, sample_action(task, 200, 24, 0.7))
        v = target - c
        preimage = v * (constraint.gauge(obs, v, c) / v.abs().amax(-1).clamp(min=1e-300)).unsqueeze(-1)
        assert preimage.abs().max() <= 1.0 + 1e-6
        torch.testing.assert_close(constraint.gauge_map(obs, preimage, center), target, rtol=0.0, atol=1e-9)


def test_it_is_the_identity_on_the_box():
    u = in_box(100, 3)
    torch.testing.assert_close(Box(3).gauge_map(no_obs(100), u), u, rtol=0.0, atol=1e-15)
    torch.testing.assert_close(Box(3).gauge_log_prob(no_obs(100), u, u.sum(-1)), u.sum(-1), rtol=0.0, atol=1e-15)


# ---------------------------------------------------------------- the density


@every_set
@pytest.mark.parametrize("unit_ball", [False, True], ids=["actions", "unit ball"])
def test_density_integrates_to_one(name, unit_ball):
    """In two dimensions, over a grid of the set, for u with independent density (1 + 0.8 u_1) (1 - 0.5 u_2) / 4."""
    constraint, center = feasible_sets(2)[name]
    obs = observation(2)

    # Polar coordinates around the centre: the density along a ray is smooth, its angular pieces end at corners.
    count, nodes = 20000, 40
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (2.0 * math.pi / count)
    direction = torch.stack((angle.cos(), angle.sin()), -1)
    gauge = constraint.gauge(obs, direction, center)
    box = direction.abs().amax(-1)
    share = (torch.arange(nodes, dtype=torch.float64) + 0.5) / nodes
    u = (share[:, None] / box).unsqueeze(-1) * direction
    log_prob = (torch.log1p(0.8 * u[..., 0]) + torch.log1p(-0.5 * u[..., 1])) - math.log(4.0)
    density = constraint.ray(obs, u, center).gauge_log_prob(log_prob, unit_ball).exp()
    # The point u of share s has gauge s in the set: area is s (reach)^2 ds dangle, with reach 1 in the unit ball.
    reach = torch.ones_like(gauge) if unit_ball else 1.0 / gauge
    offset = constraint.gauge_map(obs, u, center) - center
    torch.testing.assert_close(constraint.gauge(obs, offset, center), share[:, None].expand(nodes, count))
    mass = (density * share[:, None] * reach.square()).mean() * 2.0 * math.pi
    assert mass.item() == pytest.approx(1.0, abs=1e-6)


@every_set
def test_density_is_the_histogram_s(name):
    """Uniform samples in the box, counted in a triangle of the set, against the integral of the density there."""
    constraint, center = feasible_sets(2)[name]
    obs = observation(2)
    generator = torch.Generator().manual_seed(1)
    u = 2.0 * torch.rand(200000, 2, generator=generator, dtype=torch.float64) - 1.0
    mapped = constraint.gauge_map(obs, u, center)
    # A point of the set far from the centre, and a square around it that lies inside.
    corner = constraint.gauge_map(obs, torch.tensor([0.6, 0.35], dtype=torch.float64), center)
    half = 0.05 * (1.0 / constraint.gauge(obs, torch.eye(2, dtype=torch.float64), center)).min()
    inside = ((mapped - corner).abs() < half).all(-1)
    axis = (torch.arange(200, dtype=torch.float64) + 0.5) / 100 - 1.0
    grid = corner + half * torch.cartesian_prod(axis, axis)
    v = grid - center
    preimage = v * (constraint.gauge(obs, v, center) / v.abs().amax(-1)).unsqueeze(-1)
    assert preimage.abs().max() < 1.0
    log_prob = torch.full((len(grid),), -math.log(4.0), dtype=torch.float64)
    density = constraint.gauge_log_prob(obs, preimage, log_prob, center).exp()
    expected = (density.mean() * (2.0 * half) ** 2).item()
    error = math.sqrt(expected / len(u))
    assert inside.double().mean().item() == pytest.approx(expected, abs=5.0 * error)


@every_set
def test_log_prob_is_the_jacobian_s_determinant_in_six_dimensions(name):
    constraint, center = feasible_sets(6)[name]
    obs = observation(6)
    for u in in_box(16, 6, 3)[2:]:
        if (u == u[0]).all():
            continue  # the kink of max_i |u_i|
        matrix = jacobian(lambda a: constraint.gauge_map(obs, a, center), u)
        log_prob = constraint.gauge_log_prob(obs, u, torch.full((), 0.7, dtype=torch.float64), center)
        assert 0.7 - log_prob.item() == pytest.approx(torch.linalg.slogdet(matrix).logabsdet.item(), abs=1e-10)


@every_task
def test_log_prob_is_the_jacobian_s_determinant_on_every_task(task):
    obs, u = sample_obs(task, 20, 25, largest=30.0), in_box(20, task.constraint.dim, 25)[5:]
    log_prob = torch.linspace(-1.0, 1.0, 15, dtype=torch.float64)
    obs = obs[5:]
    got = task.constraint.gauge_log_prob(obs, u, log_prob)
    for k in range(len(obs)):
        matrix = jacobian(lambda a, k=k: task.constraint.gauge_map(obs[k], a), u[k])
        torch.testing.assert_close(got[k], log_prob[k] - torch.linalg.slogdet(matrix).logabsdet, rtol=0.0, atol=1e-9)


def test_unit_ball_coordinates():
    """In these coordinates every set is the unit ball: the density is that of y = max_i |u_i| u / |u|."""
    obs, u = observation(3), in_box(30, 3, 4)[8:]
    zero = torch.zeros(len(u), dtype=torch.float64)
    expected = [-torch.linalg.slogdet(jacobian(lambda a: a.abs().amax() * a / a.norm(), each)).logabsdet for each in u]
    for constraint, center in feasible_sets(3).values():
        log_prob = constraint.ray(obs, u, center).gauge_log_prob(zero, unit_ball=True)
        torch.testing.assert_close(log_prob, torch.stack(expected))


# ---------------------------------------------------------------- gradients


@every_set
@pytest.mark.parametrize("dim", [1, 2, 6])
def test_gradients_are_exact(name, dim):
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)

    def in_unit_ball(u: Tensor) -> Tensor:
        return constraint.ray(obs, u, center).gauge_log_prob(u.sum(-1), unit_ball=True)

    for reach in (1.0, 0.03):
        generator = torch.Generator().manual_seed(6)
        u = reach * (2.0 * torch.rand(8, dim, generator=generator, dtype=torch.float64) - 1.0)
        u.requires_grad_()
        options = dict(eps=1e-7 * reach, rtol=1e-5, atol=1e-6)
        assert gradcheck(lambda a: constraint.gauge_map(obs, a, center), u, **options)
        assert gradcheck(lambda a: constraint.gauge_log_prob(obs, a, a.sum(-1), center), u, **options)
        assert gradcheck(in_unit_ball, u, **options)


@every_shape
def test_gradients_are_exact_on_general_sets(shape):
    constraint, obs = random_set(*shape, seed=3, batch=2), no_obs(2)
    generator = torch.Generator().manual_seed(4)
    u = 2.0 * torch.rand(2, shape[0], generator=generator, dtype=torch.float64) - 1.0
    center = constraint.center(obs)
    u.requires_grad_()
    options = dict(eps=1e-7, rtol=1e-4, atol=1e-6, fast_mode=True)
    assert gradcheck(lambda a: constraint.gauge_map(obs, a, center), u, **options)
    assert gradcheck(lambda a: constraint.gauge_log_prob(obs, a, a.sum(-1), center), u, **options)


@every_set
@pytest.mark.parametrize("unit_ball", [False, True], ids=["actions", "unit ball"])
def test_gradients_through_reparametrised_sampling(name, unit_ball):
    """As in SAC: one ray for action and log-density of u = tanh(mean + std noise)."""
    constraint, center = feasible_sets(3)[name]
    obs = observation(3)
    noise = torch.randn(8, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    mean = torch.full((8, 3), 0.1, dtype=torch.float64, requires_grad=True)
    std = torch.full((8, 3), 0.6, dtype=torch.float64, requires_grad=True)

    def sample(mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        raw = mean + std * noise
        u = raw.tanh()
        log_prob = torch.distributions.Normal(mean, std).log_prob(raw).sum(-1) - torch.log1p(-u.square()).sum(-1)
        ray = constraint.ray(obs, u, center)
        return ray.gauge_map(), ray.gauge_log_prob(log_prob, unit_ball)

    assert gradcheck(sample, (mean, std), eps=1e-7, rtol=1e-5, atol=1e-6)


@every_task
def test_value_and_gradient_are_finite_at_the_centre_and_near_it(task):
    constraint, dim = task.constraint, task.constraint.dim
    obs = sample_obs(task, 100, 26)
    for center in centers(task, obs):
        own = constraint.center(obs) if center is None else center
        for reach in (0.0, 5e-324, 1e-310, 1e-200, 1e-40, 1e-8, 1e-3):
            for dtype in (torch.float64, torch.float32):
                u = in_box(100, dim, 26, reach).to(dtype).requires_grad_()
                ray = constraint.ray(obs, u, center)
                mapped = ray.gauge_map()
                (by_map,) = torch.autograd.grad(mapped.sum(), u, retain_graph=True)
                # The Jacobian is the same all along a ray. Rounding to a small u may have changed the ray.
                size = u.detach().double().abs().amax(-1, keepdim=True)
                far = (u.detach().double() / size.clamp(min=5e-324)).requires_grad_()
                (elsewhere,) = torch.autograd.grad(constraint.gauge_map(obs, far, center).sum(), far)
                torch.testing.assert_close(by_map, elsewhere.to(dtype))
                torch.testing.assert_close(by_map[size[:, 0] == 0.0], torch.ones_like(u)[size[:, 0] == 0.0])
                for unit_ball in (False, True):
                    log_prob = ray.gauge_log_prob(u.sum(-1), unit_ball)
                    (by_density,) = torch.autograd.grad(log_prob.sum(), u, retain_graph=True)
                    assert log_prob.isfinite().all()
                    assert by_density.isfinite().all()
                if reach <= 1e-8:
                    torch.testing.assert_close(mapped, own.to(dtype), rtol=0.0, atol=1e-7)


@every_set
def test_the_density_s_gradient_stops_growing_near_the_centre(name):
    constraint, center = feasible_sets(6)[name]
    obs, direction = observation(6), in_box(40, 6, 7)[20:]
    direction = direction / direction.abs().amax(-1, keepdim=True)

    def gradient(size: float) -> Tensor:
        u = (size * direction).requires_grad_()
        log_prob = constraint.gauge_log_prob(obs, u, torch.zeros(20, dtype=torch.float64), center)
        return torch.autograd.grad(log_prob.sum(), u)[0]

    torch.testing.assert_close(gradient(1e-3), gradient(1.0) * 1e3)
    torch.testing.assert_close(gradient(1e-9), gradient(1e-3))


def test_second_derivatives_are_refused():
    constraint, center = feasible_sets(3)["positive part"]
    u = in_box(4, 3).requires_grad_()
    ray = constraint.ray(observation(3), u, center)
    for value in (ray.gauge_map(), ray.gauge_log_prob(torch.zeros(4, dtype=torch.float64))):
        with pytest.raises(RuntimeError, match="first derivatives only"):
            torch.autograd.grad(value.sum(), u, create_graph=True)


# ---------------------------------------------------------------- any input


@every_task
def test_leading_shapes_and_dtypes(task):
    constraint, dim = task.constraint, task.constraint.dim
    obs, u = sample_obs(task, 12, 27), in_box(12, dim, 27)
    center = interior_point(task, obs, 28)

    def both(obs: Tensor, u: Tensor, center: Tensor | None = None) -> Tensor:
        density = constraint.gauge_log_prob(obs, u, u.sum(-1), center)
        return torch.cat((constraint.gauge_map(obs, u, center), density.unsqueeze(-1)), -1)

    exact = dict(rtol=0.0, atol=1e-12)
    flat = both(obs, u)
    torch.testing.assert_close(both(obs.view(3, 4, -1), u.view(3, 4, dim)).flatten(0, 1), flat, **exact)
    torch.testing.assert_close(both(obs[5], u[5]), flat[5], **exact)
    torch.testing.assert_close(both(obs[0], u), both(obs[:1].expand(12, -1), u), **exact)
    shared = constraint.gauge_map(obs, u[3])
    torch.testing.assert_close(shared, constraint.gauge_map(obs, u[3:4].expand(12, -1)), **exact)
    torch.testing.assert_close(
        both(obs[:, None], u[:, None].expand(12, 2, dim), center[:, None])[:, 1], both(obs, u, center), **exact
    )
    assert both(obs[:0], u[:0]).shape == (0, dim + 1)
    single = both(obs.float(), u.float())
    assert single.dtype == torch.float32
    assert constraint.gauge_log_prob(obs, u.float(), u.sum(-1)).dtype == torch.float64  # as the given log-density
    torch.testing.assert_close(single.double(), both(obs.float().double(), u.float().double()), rtol=1e-5, atol=1e-5)


@every_task
def test_nan_is_passed_on(task):
    obs, u = sample_obs(task, 40, 29), in_box(40, task.constraint.dim, 29)
    u[::2, 0] = math.nan
    u[1::4, -1] = math.nan
    bad = u.isnan().any(-1)
    for center in centers(task, obs):
        mapped = task.constraint.gauge_map(obs, u, center)
        assert mapped.isnan().any(-1)[bad].all()
        assert mapped[~bad].isfinite().all()
    infinite = torch.full((40, task.constraint.dim), math.inf, dtype=torch.float64)
    assert task.constraint.gauge_map(obs, infinite).isnan().all()


@pytest.mark.parametrize("name", sorted({*TASKS} - {"R+N", "R+L2", "disc"}))  # these ignore the observation
def test_nan_in_the_observation_is_passed_on(name):
    task = TASKS[name]
    obs, u = torch.full((20, 2 * task.constraint.dim), math.nan).double(), in_box(20, task.constraint.dim)
    assert task.constraint.gauge_map(obs, u).isnan().any(-1).all()
    assert task.constraint.gauge_log_prob(obs, u, u.sum(-1)).isnan().all()


@every_task
def test_it_asks_nothing_of_the_device(task):
    """PyTorch's meta device stands in for a GPU, as in test_device: reading a value raises an error."""
    obs, u = sample_obs(task, 10, 30).to("meta"), in_box(10, task.constraint.dim).to("meta").requires_grad_()
    for center in (None, task.constraint.center(obs)):
        ray = task.constraint.ray(obs, u, center)
        values = ray.gauge_map(), ray.gauge_log_prob(u.sum(-1)), ray.gauge_log_prob(u.sum(-1), unit_ball=True)
        for value in values:
            (gradient,) = torch.autograd.grad(value.sum(), u, retain_graph=True)
            assert value.device.type == gradient.device.type == "meta"


def test_one_evaluation_of_the_gauge_serves_map_and_density():
    class Counted(LinearConstraint):
        evaluations = 0

        def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
            self.evaluations += 1
            return super()._gauge_gradients(obs, direction, center)

    constraint = Counted(2, lambda obs: torch.tensor([[1.0, 2.0]]), lambda obs: torch.tensor([0.5]))
    u = in_box(6, 2).requires_grad_()
    ray = constraint.ray(no_obs(6), u, torch.zeros(2, dtype=torch.float64))
    (ray.gauge_map().sum() + ray.gauge_log_prob(u.sum(-1)).sum()).backward()
    assert constraint.evaluations == 1
    (ray.radial_map().sum() + ray.radial_log_prob(u.sum(-1)).sum()).backward()
    assert constraint.evaluations == 2


def test_parts_off_centre_agree_with_the_closed_form():
    obs = observation(3)
    closed, center = feasible_sets(3)["weighted l1 off centre"]
    general: Constraint = Intersection(closed, Box(3))
    u = in_box(50, 3, 9)
    mapped = closed.gauge_map(obs, u, center)
    torch.testing.assert_close(general.gauge_map(obs, u, center), mapped)
    # The same by the gradient of the gauge alone.
    gauge, gradient = gauge_and_gradient(closed, obs, u, center)
    torch.testing.assert_close((gradient * (mapped - center)).sum(-1), u.abs().amax(-1))
    assert gauge.min() > 0.0
