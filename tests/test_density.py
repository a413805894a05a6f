"""The log-densities after the radial and alpha maps: against 400-digit arithmetic, and as probabilities."""

import itertools
import math

import mpmath
import numpy as np
import pytest
import torch
from feasible_sets import SETS, feasible_sets, gauge_and_gradient, observation
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from constraints.density import alpha_boundary_log_density, log_ray_integral, radial_log_det


def gaussian(dim: int) -> tuple[Tensor, Tensor]:
    axis = torch.arange(dim, dtype=torch.float64)
    return 0.3 * torch.sin(axis + 0.5), 0.5 + 0.1 * torch.cos(axis)


def normal_log_prob(action: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return torch.distributions.Normal(mean, std).log_prob(action).sum(-1)


# ---------------------------------------------------------------- the radial map's log-determinant

GAUGES = (1e-10, 1e-6, 1e-3, 0.03, 0.3, 0.999, 1.0, 1.5, 4.0, 11.0, 50.0, 1e3, 1e4)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 4e-7), (torch.float64, 1e-15)])
@pytest.mark.parametrize("dim", [1, 2, 6, 20])
def test_radial_log_det_and_its_gradient_match_high_precision(dtype, tolerance, dim):
    gauge = torch.tensor(GAUGES, dtype=dtype, requires_grad=True)
    value = radial_log_det(gauge, dim)
    (slope,) = torch.autograd.grad(value.sum(), gauge)
    with mpmath.workdps(60):
        for g, v, s in zip(gauge.tolist(), value.tolist(), slope.tolist(), strict=True):
            x = mpmath.mpf(g)
            exact = (dim - 1) * mpmath.log(mpmath.tanh(x) / x) + 2 * mpmath.log(mpmath.sech(x))
            exact_slope = (dim - 1) * (2 / mpmath.sinh(2 * x) - 1 / x) - 2 * mpmath.tanh(x)
            assert abs(v - exact) <= tolerance * (g + abs(exact)), (g, v, exact)
            assert abs(s - exact_slope) <= tolerance * abs(exact_slope), (g, s, exact_slope)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_radial_log_det_is_smooth_at_the_centre(dtype):
    gauge = torch.zeros(3, dtype=dtype, requires_grad=True)
    value = radial_log_det(gauge, 6)
    (slope,) = torch.autograd.grad(value.sum(), gauge)
    assert torch.equal(value, torch.zeros_like(value))
    assert torch.equal(slope, torch.zeros_like(slope))


@pytest.mark.parametrize("name", SETS)
def test_radial_log_prob_is_the_jacobian_determinant(name):
    dim = 6
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    generator = torch.Generator().manual_seed(0)
    for level in (1e-3, 0.3, 1.0, 3.0, 6.0):
        direction = torch.randn(dim, dtype=torch.float64, generator=generator)
        action = center + level * direction / constraint.gauge(obs, direction, center)
        jacobian = torch.autograd.functional.jacobian(lambda a: constraint.radial_map(obs, a, center), action)
        log_prob = constraint.radial_log_prob(obs, action, torch.zeros((), dtype=torch.float64), center)
        assert -log_prob.item() == pytest.approx(torch.linalg.slogdet(jacobian).logabsdet.item(), abs=1e-9)


# ---------------------------------------------------------------- the ray integral


def exact_ray_integral(slope: float, intercept: float, dim: int) -> tuple[float, float, float]:
    """log I and its two derivatives by the paper's recursion with erf; 400 digits make up for its cancellation."""
    with mpmath.workdps(400):
        a, b = mpmath.mpf(slope), mpmath.mpf(intercept)
        edge = mpmath.exp(-((a + b) ** 2))
        moments = [mpmath.sqrt(mpmath.pi) / (2 * a) * mpmath.erfc(a + b)]
        for n in range(dim + 1):  # 2 A^2 J_{n+1} + 2 A B J_n = e + n J_{n-1}
            moments.append((edge + n * moments[max(n - 1, 0)] - 2 * a * b * moments[n]) / (2 * a * a))
        integral, first, second = moments[dim - 1 : dim + 2]
        by_slope = -2 * (a * second + b * first) / integral
        by_intercept = -2 * (a * first + b * integral) / integral
        return float(mpmath.log(integral)), float(by_slope), float(by_intercept)


def assert_ray_integral_exact(cases: list[tuple[float, float]], dim: int):
    slope, intercept = torch.tensor(cases, dtype=torch.float64).unbind(-1)
    results = torch.stack(log_ray_integral(slope, intercept, dim), -1)
    for case, result in zip(cases, results.tolist(), strict=True):
        exact = exact_ray_integral(*case, dim)
        # No method can avoid roundings of the intercept and of its square: 1e-15 (A + B)^2.
        assert result == pytest.approx(exact, rel=1e-9, abs=1e-9 + 1e-15 * sum(case) ** 2), (case, dim)


@pytest.mark.parametrize("dim", [1, 2, 3, 6, 11, 20])
def test_ray_integral_and_its_derivatives_are_exact(dim):
    slopes = (1e-2, 0.1, 0.5, 1.0, 3.0, 10.0, 100.0)
    intercepts = (-50.0, -12.0, -4.0, -1.0, 0.0, 0.5, 1.0, 3.0, 12.0, 50.0)
    assert_ray_integral_exact(list(itertools.product(slopes, intercepts)), dim)


@pytest.mark.parametrize("dim", [1, 2, 6, 20])
def test_ray_integral_at_extremes(dim):
    slopes = (1e-5, 1e-2, 1.0, 1e2, 1e4, 1e6)
    intercepts = (-1e5, -1e3, 0.0, 1e3, 1e5)
    assert_ray_integral_exact(list(itertools.product(slopes, intercepts)), dim)


# ---------------------------------------------------------------- the boundary density


def test_boundary_density_matches_quadrature_of_its_definition():
    offset, normal = (0.5, -0.3, 0.2), (1.2, -0.7, 0.95)
    center = (0.1, 0.0, -0.2)
    for mean, std in [
        ((0.2, 0.1, 0.0), (0.5, 0.3, 0.8)),
        ((3.0, -2.0, 1.0), (0.5, 0.3, 0.8)),  # far along the ray
        ((-3.0, 2.0, -1.0), (0.5, 0.3, 0.8)),  # far on the other side
        ((0.2, 0.1, 0.0), (100.0, 50.0, 80.0)),
        ((0.601, -0.301, 0.001), (1e-4, 1e-3, 1e-4)),
    ]:
        arguments = (torch.tensor(x, dtype=torch.float64) for x in (offset, normal, center, mean, std))
        value = alpha_boundary_log_density(*arguments).item()
        with mpmath.workdps(40):
            v, c, m, s = ([mpmath.mpf(x) for x in y] for y in (offset, center, mean, std))
            precision = sum((a / b) ** 2 for a, b in zip(v, s, strict=True))
            peak = sum(a * (e - o) / b**2 for a, b, e, o in zip(v, s, m, c, strict=True)) / precision
            spread = 1 / mpmath.sqrt(precision)

            def log_density(t, v=v, c=c, m=m, s=s):
                parts = (((o + t * a - e) / b) ** 2 / 2 + mpmath.log(b) for a, o, e, b in zip(v, c, m, s, strict=True))
                return -sum(parts) - 1.5 * mpmath.log(2 * mpmath.pi) + 2 * mpmath.log(t)

            top = max(peak, mpmath.mpf(1))
            stops = sorted({max(mpmath.mpf(1), top + k * spread) for k in (-20, -8, -3, -1, 0, 1, 3, 8, 20)})
            reference = log_density(top)
            integral = mpmath.quad(lambda t, r=reference: mpmath.exp(log_density(t) - r), stops)
            exact = reference + mpmath.log(integral) - mpmath.log(math.hypot(*normal))
        assert value == pytest.approx(float(exact), rel=1e-9)


def test_boundary_density_in_one_dimension_is_the_tail_probability():
    bound = torch.linspace(-1.0, 1.0, 9, dtype=torch.float64).unsqueeze(-1)
    center = torch.full_like(bound, -1.5)
    mean, std = torch.full_like(bound, -2.0), torch.full_like(bound, 0.1)
    offset = bound - center
    value = alpha_boundary_log_density(offset, 1 / offset, center, mean, std)
    torch.testing.assert_close(value, torch.special.log_ndtr((mean - bound) / std)[:, 0], rtol=1e-10, atol=0.0)


def random_arguments(batch: int, dim: int, seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    offset, normal, center, mean = (torch.randn(batch, dim, dtype=torch.float64, generator=generator) for _ in range(4))
    std = 0.1 + torch.rand(batch, dim, dtype=torch.float64, generator=generator)
    return [x.requires_grad_() for x in (offset, normal, 0.2 * center, mean, std)]


@pytest.mark.parametrize("dim", [1, 2, 6, 15])
def test_boundary_density_gradients(dim):
    assert gradcheck(alpha_boundary_log_density, random_arguments(12, dim, seed=dim), eps=1e-6, rtol=1e-5)


def test_second_derivatives_are_refused():
    arguments = random_arguments(2, 3, seed=0)
    for value in (alpha_boundary_log_density(*arguments), radial_log_det(arguments[-1], 3)):
        with pytest.raises(RuntimeError, match="first derivatives only"):
            torch.autograd.grad(value.sum(), arguments[-1], create_graph=True)


@pytest.mark.parametrize("dim", [2, 6, 20])
def test_boundary_density_in_float32(dim):
    arguments = random_arguments(200, dim, seed=dim)
    single = [x.detach().float().requires_grad_() for x in arguments]
    double = [x.detach().double().requires_grad_() for x in single]
    value, exact = alpha_boundary_log_density(*single), alpha_boundary_log_density(*double)
    assert value.dtype == torch.float32
    torch.testing.assert_close(value, exact.float(), rtol=0.0, atol=0.0)
    gradients = torch.autograd.grad(value.sum(), single)
    exact_gradients = torch.autograd.grad(exact.sum(), double)
    for gradient, exact_gradient in zip(gradients, exact_gradients, strict=True):
        assert gradient.dtype == torch.float32
        torch.testing.assert_close(gradient, exact_gradient.float(), rtol=1e-6, atol=0.0)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    dim=st.integers(1, 20),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    offset_scale=st.floats(-3.0, 0.3),
    mean_scale=st.floats(-3.0, 4.0),
    std_scale=st.tuples(st.floats(-4.0, 2.0), st.floats(-4.0, 2.0)),
    toward=st.sampled_from([-1.0, 0.0, 1.0]),
)
def test_boundary_density_is_finite(seed, dim, dtype, offset_scale, mean_scale, std_scale, toward):
    generator = torch.Generator().manual_seed(seed)
    offset, normal, center, mean = (torch.randn(8, dim, generator=generator).to(dtype) for _ in range(4))
    offset = 10**offset_scale * (offset + 0.1 * offset.sign())
    mean = 10**mean_scale * (mean if toward == 0.0 else toward * offset / offset.norm(dim=-1, keepdim=True))
    low, high = std_scale
    std = 10 ** (low + (high - low) * torch.rand(8, dim, generator=generator)).to(dtype)
    arguments = [x.detach().requires_grad_() for x in (offset, normal, center, mean, std)]
    value = alpha_boundary_log_density(*arguments)
    assert value.isfinite().all()
    for gradient in torch.autograd.grad(value.sum(), arguments):
        assert gradient.isfinite().all()


# ---------------------------------------------------------------- the densities are probabilities


def panels(count: int, nodes: int) -> tuple[Tensor, Tensor]:
    """Composite Gauss-Legendre rule on [-1, 1]."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    edges = np.linspace(-1.0, 1.0, count + 1)
    half = 1.0 / count
    points = (edges[:-1, None] + half * (x + 1.0)).ravel()
    return torch.from_numpy(points), torch.from_numpy(np.tile(w * half, count))


def cone_rule(dim: int, count: int, nodes: int) -> tuple[Tensor, Tensor]:
    """Directions p on the surface of the cube [-1, 1]^dim and weights du: c + s p has volume s^(d-1) ds du."""
    points, weights = panels(count, nodes)
    grid = torch.cartesian_prod(*[points] * (dim - 1)).reshape(-1, dim - 1) if dim > 1 else torch.zeros(1, 0)
    du = torch.ones(1, dtype=torch.float64)
    for _ in range(dim - 1):
        du = torch.outer(du, weights).ravel()
    faces = []
    for axis, sign in itertools.product(range(dim), (-1.0, 1.0)):
        side = torch.full((len(grid), 1), sign, dtype=torch.float64)
        faces.append(torch.cat((grid[:, :axis], side, grid[:, axis:]), -1))
    return torch.cat(faces).double(), du.repeat(2 * dim)


def radial_rule(nodes: int) -> tuple[Tensor, Tensor]:
    x, w = np.polynomial.legendre.leggauss(nodes)
    return torch.from_numpy(x + 1.0) / 2, torch.from_numpy(w) / 2


def surface_rule(constraint, obs, center, direction, du) -> tuple[Tensor, Tensor]:
    """Surface elements dsigma = |grad L| L(p)^-d du of the boundary, and points that the alpha map sends there."""
    gauge, gradient = gauge_and_gradient(constraint, obs, direction, center)
    outside = center + 2.0 * direction / gauge.unsqueeze(-1)
    return outside, gradient.norm(dim=-1) * gauge ** -direction.shape[-1] * du


RESOLUTION = {1: (1, 1), 2: (200, 4), 3: (16, 3)}
# The measured errors of the rules are 1e-6 (radial, 3-D) and below 1e-10. Edges of a set do no harm, because the mass
# of a whole ray from the centre is a smooth function of its direction.
RADIAL_TOLERANCE = {1: 1e-9, 2: 1e-9, 3: 1e-5}
ALPHA_TOLERANCE = 1e-9


unit_ball_too = pytest.mark.parametrize("unit_ball", [False, True], ids=["actions", "unit ball"])


def cone_content(direction: Tensor, du: Tensor, gauge: Tensor, unit_ball: bool) -> Tensor:
    """d times the volume of each cone up to the boundary, in actions or in unit-ball coordinates."""
    return (direction.norm(dim=-1) if unit_ball else gauge) ** -direction.shape[-1] * du


@unit_ball_too
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("name", SETS)
def test_radial_density_integrates_to_one(name, dim, unit_ball):
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    mean, std = gaussian(dim)
    direction, du = cone_rule(dim, *RESOLUTION[dim])
    gauge = constraint.gauge(obs, direction, center)
    # The mapped action has gauge tanh(s). The density is smooth in s, and negligible beyond 16.
    s, ds = (16.0 * x for x in radial_rule(32 if dim == 3 else 64))
    action = center + (s / gauge.unsqueeze(-1)).unsqueeze(-1) * direction.unsqueeze(-2)
    log_prob = constraint.ray(obs, action, center).radial_log_prob(normal_log_prob(action, mean, std), unit_ball)
    volume = (s.tanh() ** (dim - 1) * s.cosh() ** -2 * ds) * cone_content(direction, du, gauge, unit_ball).unsqueeze(-1)
    assert (log_prob.exp() * volume).sum().item() == pytest.approx(1.0, abs=RADIAL_TOLERANCE[dim])


@unit_ball_too
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("name", SETS)
def test_alpha_interior_and_boundary_mass_sum_to_one(name, dim, unit_ball):
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    mean, std = gaussian(dim)
    direction, du = cone_rule(dim, *RESOLUTION[dim])
    gauge = constraint.gauge(obs, direction, center)
    level, dlevel = radial_rule(12)
    inside = center + (level / gauge.unsqueeze(-1)).unsqueeze(-1) * direction.unsqueeze(-2)
    cones = cone_content(direction, du, gauge, unit_ball)
    volume = (level ** (dim - 1) * dlevel) * cones.unsqueeze(-1)
    density = constraint.ray(obs, inside, center).alpha_log_prob(mean, std, unit_ball).exp()
    interior = (density * volume).sum().item()
    outside, area = surface_rule(constraint, obs, center, direction, du)
    density = constraint.ray(obs, outside, center).alpha_log_prob(mean, std, unit_ball).exp()
    boundary = (density * (cones if unit_ball else area)).sum().item()
    assert 0.05 < interior < 0.95
    assert interior + boundary == pytest.approx(1.0, abs=ALPHA_TOLERANCE)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_alpha_boundary_density_is_per_euclidean_area_on_the_box(dim):
    constraint, center = feasible_sets(dim)["box off centre"]
    mean, std = gaussian(dim)
    boundary, area = cone_rule(dim, 40, 3)  # the surface of the box itself
    outside = center + 2.0 * (boundary - center)
    log_prob = constraint.alpha_log_prob(observation(dim), outside, mean, std, center)
    normal = torch.distributions.Normal(mean, std)
    interior = (normal.cdf(torch.ones(dim)) - normal.cdf(-torch.ones(dim))).prod()
    assert ((log_prob.exp() * area).sum() + interior).item() == pytest.approx(1.0, abs=1e-7)


def test_alpha_boundary_density_on_a_sphere_is_uniform_for_an_isotropic_gaussian():
    dim, radius_square, std = 6, 0.6, 0.4
    constraint, center = feasible_sets(dim)["ball"]
    generator = torch.Generator().manual_seed(0)
    action = 5.0 * torch.randn(50, dim, dtype=torch.float64, generator=generator)
    log_prob = constraint.alpha_log_prob(observation(dim), action, center, torch.full_like(center, std), center)
    area = 2.0 * math.pi ** (dim / 2) / math.gamma(dim / 2) * radius_square ** ((dim - 1) / 2)
    outside = torch.special.gammaincc(
        torch.tensor(dim / 2, dtype=torch.float64), torch.tensor(radius_square / (2.0 * std**2), dtype=torch.float64)
    )
    torch.testing.assert_close(log_prob, (outside / area).log().expand(50), rtol=1e-10, atol=0.0)


def quasi_normal(count: int, dim: int, seed: int) -> Tensor:
    uniform = torch.quasirandom.SobolEngine(dim, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    return torch.special.ndtri(uniform.clamp(1e-12, 1 - 1e-12))


@pytest.mark.parametrize("name", SETS)
def test_alpha_mass_in_six_dimensions(name):
    dim = 6
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    mean, std = 0.4 * gaussian(dim)[0], 0.8 * gaussian(dim)[1]
    action = mean + std * quasi_normal(2**15, dim, seed=1)
    interior = (constraint.gauge(obs, action - center, center) <= 1.0).double().mean().item()
    unit = torch.nn.functional.normalize(quasi_normal(2**15, dim, seed=2), dim=-1)
    gauge, gradient = gauge_and_gradient(constraint, obs, unit, center)
    cosine = (unit * gradient).sum(-1) / gradient.norm(dim=-1)
    log_prob = constraint.alpha_log_prob(obs, center + 2.0 * unit / gauge.unsqueeze(-1), mean, std, center)
    area_of_sphere = 2.0 * math.pi ** (dim / 2) / math.gamma(dim / 2)
    boundary = area_of_sphere * (log_prob.exp() * gauge ** (1 - dim) / cosine).mean().item()
    # Measured error of the Sobol points: at most 0.0011.
    assert interior + boundary == pytest.approx(1.0, abs=0.003)
    assert 0.01 < interior < 0.95


@pytest.mark.parametrize("name", ["box off centre", "positive part", "ball", "ellipse cut by the box"])
def test_alpha_density_matches_a_histogram_of_mapped_samples(name):
    dim, bins, samples = 2, 12, 200_000
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    mean, std = gaussian(dim)
    direction, du = cone_rule(dim, 10 * bins, 4)
    outside, area = surface_rule(constraint, obs, center, direction, du)
    mass = constraint.alpha_log_prob(obs, outside, mean, std, center).exp() * area
    probability = mass.reshape(4 * bins, -1).sum(-1)  # the panels of a face come in order

    generator = torch.Generator().manual_seed(3)
    action = mean + std * torch.randn(samples, dim, dtype=torch.float64, generator=generator)
    mapped = constraint.alpha_map(obs, action, center)
    offset = mapped[constraint.gauge(obs, action - center, center) > 1.0] - center
    axis = offset.abs().argmax(-1)
    main = offset.gather(-1, axis.unsqueeze(-1))[:, 0]
    along = offset.gather(-1, 1 - axis.unsqueeze(-1))[:, 0] / main.abs()
    column = ((along + 1.0) / 2.0 * bins).long().clamp(0, bins - 1)
    observed = torch.bincount((2 * axis + (main > 0.0)) * bins + column, minlength=4 * bins)

    expected = samples * torch.cat((probability, 1.0 - probability.sum(0, keepdim=True)))
    observed = torch.cat((observed, samples - observed.sum(0, keepdim=True)))
    statistic = ((observed - expected) ** 2 / expected).sum().item()
    assert expected.min() > 20.0
    # chi-square with `4 * bins` degrees of freedom, plus four standard deviations; the seed is fixed
    assert statistic < 4 * bins + 4.0 * math.sqrt(8.0 * bins)


@pytest.mark.parametrize("name", SETS)
def test_unit_ball_density_is_that_of_the_coordinates(name):
    """In six dimensions, where integrals cost too much: against the Jacobian of y = L(v) v / |v| by autograd."""
    dim = 6
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    generator = torch.Generator().manual_seed(7)
    action = center + 0.3 * torch.randn(5, dim, dtype=torch.float64, generator=generator)
    log_prob = constraint.ray(obs, action, center).radial_log_prob(torch.zeros(5, dtype=torch.float64), unit_ball=True)

    def coordinates(action: Tensor) -> Tensor:
        offset = constraint.radial_map(obs, action, center) - center
        return constraint.gauge(obs, offset, center) * offset / offset.norm()

    for k in range(5):
        jacobian = torch.autograd.functional.jacobian(coordinates, action[k])
        assert -log_prob[k].item() == pytest.approx(torch.linalg.slogdet(jacobian).logabsdet.item(), abs=1e-9)


def test_log_reach_at_the_center_is_finite():
    constraint, center = feasible_sets(3)["ball"]
    action = center.clone().requires_grad_()
    reach = constraint.ray(observation(3), action, center).log_reach()
    (gradient,) = torch.autograd.grad(reach, action)
    assert reach.item() == 0.0
    assert torch.equal(gradient, torch.zeros(3, dtype=torch.float64))


def test_floor_is_added_to_the_determinant():
    constraint, center = feasible_sets(3)["positive part"]
    action = center + torch.linspace(0.0, 12.0, 30, dtype=torch.float64).unsqueeze(-1) * gaussian(3)[1]
    ray = constraint.ray(observation(3), action, center)
    zero = torch.zeros(30, dtype=torch.float64)
    expected = -torch.log((-ray.radial_log_prob(zero)).exp() + 1e-6)
    torch.testing.assert_close(ray.radial_log_prob(zero, floor=1e-6), expected)


def test_boundary_weight_scales_the_boundary_s_measure_alone():
    constraint, center = feasible_sets(3)["ball"]
    mean, std = gaussian(3)
    action = center + torch.linspace(0.1, 3.0, 20, dtype=torch.float64).unsqueeze(-1) * std
    ray = constraint.ray(observation(3), action, center)
    gain = ray.alpha_log_prob(mean, std) - ray.alpha_log_prob(mean, std, boundary_weight=5.0)
    outside = ray.gauge > 1.0
    assert 0 < outside.sum() < 20
    torch.testing.assert_close(gain, math.log(5.0) * outside.double())


@unit_ball_too
@pytest.mark.parametrize("name", SETS)
def test_gradients_through_reparametrised_sampling(name, unit_ball):
    dim = 3
    constraint, center = feasible_sets(dim)[name]
    obs = observation(dim)
    generator = torch.Generator().manual_seed(5)
    noise = torch.randn(24, dim, dtype=torch.float64, generator=generator)
    mean, std = (x.expand(24, dim).clone().requires_grad_() for x in gaussian(dim))

    def alpha(mean: Tensor, std: Tensor) -> Tensor:
        return constraint.ray(obs, mean + std * noise, center).alpha_log_prob(mean, std, unit_ball)

    def radial(mean: Tensor, std: Tensor) -> Tensor:
        action = mean + std * noise
        return constraint.ray(obs, action, center).radial_log_prob(normal_log_prob(action, mean, std), unit_ball)

    infeasible = constraint.gauge(obs, mean + std * noise - center, center) > 1.0
    assert infeasible.any()
    assert not infeasible.all()
    assert gradcheck(alpha, (mean, std), eps=1e-6, rtol=1e-5)
    assert gradcheck(radial, (mean, std), eps=1e-6, rtol=1e-5)
