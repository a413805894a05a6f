"""`Constraint.sample`: points in any set, uniform, feasible, reproducible."""

import math

import pytest
import torch
from feasible_sets import SHAPES, TASKS, no_obs, observation, random_set, sample_obs
from scipy import stats

import envs
from constraints import Box, ConstraintError, LinearConstraint, PlanarEllipse, QuadraticConstraint, WeightedL1
from constraints.sample import round_axes

COUNT = 4000


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def by_rejection(constraint, obs, count, seed=1):
    """Uniform points (count, d) of a set that is not small in the box."""
    source, kept, have = generator(seed), [], 0
    while have < count:
        drawn = 2.0 * torch.rand(50_000, constraint.dim, generator=source, dtype=torch.float64) - 1.0
        kept.append(drawn[constraint.violation(obs, drawn) <= 0.0])
        have += len(kept[-1])
    return torch.cat(kept)[:count]


def assert_same_distribution(points, reference):
    """Kolmogorov-Smirnov tests of each coordinate and of two functions of all coordinates; first and second moments."""
    for measure in (*range(points.shape[-1]), "largest", "sum"):
        one, other = (
            {"largest": x.abs().amax(-1), "sum": x.sum(-1)}[measure] if isinstance(measure, str) else x[:, measure]
            for x in (points, reference)
        )
        assert stats.ks_2samp(one.numpy(), other.numpy()).pvalue > 1e-4, measure
    spread = reference.std(0)
    assert ((points.mean(0) - reference.mean(0)).abs() < 5.0 * spread * (2.0 / COUNT) ** 0.5).all()
    assert ((points.T.cov() - reference.T.cov()).abs() < 0.08 * spread[:, None] * spread).all()


SIMPLEX_ROWS = torch.cat((-torch.eye(4), torch.ones(1, 4))).double()
SIMPLEX_BOUNDS = torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
SETS = {name: TASKS[name].constraint for name in ("R+L2", "R+O10", "R+M", "H+M", "H+O+S", "cut ellipse", "HC+MA")}
SETS["box"] = Box(3)
SETS["simplex"] = LinearConstraint(4, lambda obs: SIMPLEX_ROWS, lambda obs: SIMPLEX_BOUNDS)


@pytest.mark.parametrize("constraint", SETS.values(), ids=SETS.keys())
def test_points_are_distributed_as_those_of_rejection(constraint):
    weight = observation(constraint.dim)
    obs = torch.cat((weight, 1.0 + weight.cos()))
    points = constraint.sample(obs, COUNT, generator())
    assert points.shape == (COUNT, constraint.dim) and points.dtype == torch.float64
    assert constraint.violation(obs, points).max() <= 0.0
    assert_same_distribution(points, by_rejection(constraint, obs, COUNT))


@pytest.mark.parametrize("name", TASKS)
def test_the_gauge_of_uniform_points_to_the_power_of_d_is_uniform(name):
    """This holds for every convex set and any interior point, and needs no reference, however thin the set is."""
    task = TASKS[name]
    constraint, count = task.constraint, 300
    obs = sample_obs(task, 12, seed=3)
    points = constraint.sample(obs, count, generator(2))
    assert points.shape == (12, count, constraint.dim)
    each = obs.unsqueeze(1)
    assert constraint.violation(each, points).max() <= 1e-9
    share = constraint.gauge(each, points - constraint.center(each), constraint.center(each)) ** constraint.dim
    assert stats.kstest(share.flatten().numpy(), "uniform").pvalue > 1e-4


@pytest.mark.parametrize("aspect", [1.0, 1e3, 1e6])
def test_thin_sets_are_as_good_as_round_ones(aspect):
    """A diamond along the axes and an ellipse across them, with exact references by scaling."""
    obs = torch.tensor([aspect, 1.0], dtype=torch.float64)
    diamond = WeightedL1(lambda obs: obs, 1.0, 2)
    points = diamond.sample(obs, COUNT, generator()) * obs
    reference = by_rejection(diamond, torch.ones(2, dtype=torch.float64), COUNT)
    assert_same_distribution(points, reference)

    aspect = min(aspect, 1e4)  # the limit of the oracle for general ellipses
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    Q = turn @ torch.diag(torch.tensor([4.0 * aspect**2, 4.0], dtype=torch.float64)) @ turn.T
    ellipse = QuadraticConstraint(2, lambda obs: Q, 1.0)
    points = ellipse.sample(obs, COUNT, generator()) @ turn * torch.tensor([2.0 * aspect, 2.0], dtype=torch.float64)
    disc = QuadraticConstraint(2, lambda obs: torch.eye(2, dtype=torch.float64), 1.0)
    assert_same_distribution(points, by_rejection(disc, obs, COUNT))


def test_a_singular_ellipse_that_only_the_box_bounds():
    constraint = envs.constraint("R+T")
    assert isinstance(constraint, PlanarEllipse)
    for theta in (0.0, 1e-6, math.pi):
        obs = torch.zeros(11, dtype=torch.float64)
        obs[7] = theta
        points = constraint.sample(obs, COUNT, generator())
        assert constraint.violation(obs, points).max() <= 0.0
        assert_same_distribution(points, by_rejection(constraint, obs, COUNT))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape[0] <= 6], ids=str)
def test_points_of_sets_of_ones_own_are_feasible(shape, seed):
    constraint, obs = random_set(*shape, seed=seed, batch=1), no_obs(1)
    points = constraint.sample(obs, 20, generator(seed))
    assert points.shape == (1, 20, constraint.dim)
    assert constraint.violation(obs.unsqueeze(1), points).max() <= 1e-9
    assert len(points[0].unique(dim=0)) == 20


def test_the_axes_of_an_ellipse_make_it_the_unit_ball():
    root = torch.tensor([[3.0, 1.0, 0.0], [0.0, 1e-3, 0.5], [0.0, 0.0, 7.0]], dtype=torch.float64)
    covariance = root @ root.T  # the ellipse a' covariance^-1 a <= 1

    def oracle(gradient):
        bent = (covariance @ gradient.unsqueeze(-1)).squeeze(-1)
        return bent / (gradient * bent).sum(-1, keepdim=True).sqrt()

    axes = round_axes(oracle, torch.zeros(5, 3, dtype=torch.float64))
    assert axes.shape == (5, 3, 3)
    assert torch.allclose(axes @ axes.mT, covariance.expand(5, 3, 3), rtol=1e-9, atol=1e-12)


def test_a_generator_repeats_its_points_and_others_differ():
    constraint, obs = envs.constraint("W+M"), torch.randn(17, dtype=torch.float64, generator=generator())
    first, again, other = (constraint.sample(obs, 5, generator(seed)) for seed in (7, 7, 8))
    assert torch.equal(first, again) and not torch.equal(first, other)
    torch.manual_seed(3)
    first = constraint.sample(obs, 5)
    torch.manual_seed(3)
    assert torch.equal(first, constraint.sample(obs, 5))
    assert len(first.unique(dim=0)) == 5


def test_dtype_and_leading_dimensions_are_those_of_the_observation():
    for name in ("R+N", "R+L2", "R+M"):
        obs = torch.zeros(2, 3, 11)
        points = envs.constraint(name).sample(obs, 4, generator())
        assert points.shape == (2, 3, 4, 2) and points.dtype == torch.float32
        assert envs.constraint(name).violation(obs.unsqueeze(-2), points).max() <= 1e-6


@pytest.mark.parametrize("rows, bounds", [([[1.0, 0.0], [-1.0, 0.0]], [0.0, 0.0]), ([[1.0], [-1.0]], [0.3, -0.3])])
def test_a_flat_set_is_sampled_within_its_tolerance(rows, bounds):
    rows, bounds = torch.tensor(rows, dtype=torch.float64), torch.tensor(bounds, dtype=torch.float64)
    constraint = LinearConstraint(rows.shape[1], lambda obs: rows, lambda obs: bounds, on_empty="least")
    points = constraint.sample(torch.zeros(1, dtype=torch.float64), 400, generator())
    assert points.isfinite().all() and (points[..., 0] - bounds[0]).abs().max() <= 1e-6
    if rows.shape[1] == 2:  # uniform along the other axis
        assert points[..., 1].std() == pytest.approx(3**-0.5, abs=0.05)


def test_what_has_no_uniform_points_is_refused():
    constraint = envs.constraint("R+M")
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        constraint.sample(torch.zeros(11), 0)
    with pytest.raises(TypeError, match="float32 or float64"):
        constraint.sample(torch.zeros(11, dtype=torch.int64), 1)
    empty = LinearConstraint(2, lambda obs: torch.ones(1, 2), lambda obs: torch.tensor([-3.0]))
    with pytest.raises(ConstraintError):
        empty.sample(torch.zeros(1), 3)
    assert constraint.sample(torch.full((11,), torch.nan), 2).isnan().all()
