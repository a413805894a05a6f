"""Centres of user-defined sets: unique, continuous in the observation, and deep inside."""

from __future__ import annotations

import math

import pytest
import torch
from feasible_sets import no_obs, random_set
from scipy.optimize import linprog
from torch import Tensor

from constraints import Constraint, ConstraintError, Intersection, LinearConstraint, QuadraticConstraint
from constraints.general.scaled_sets import scale_sets


def fixed(rows: Tensor, bounds: Tensor) -> LinearConstraint:
    return LinearConstraint(rows.shape[-1], lambda obs: rows, lambda obs: bounds)


def both_sides(normal: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """low <= normal.a <= high as two rows, for normals (..., d)."""
    bounds = torch.tensor([high, -low], dtype=torch.float64).expand(*normal.shape[:-1], 2)
    return torch.stack((normal, -normal), -2), bounds


def turning(count: int, span: float = 2.0 * math.pi) -> tuple[Tensor, Tensor]:
    angle = torch.linspace(0.0, span, count, dtype=torch.float64)
    return angle, torch.stack((angle.cos(), angle.sin()), -1)


def slab(count: int) -> tuple[Tensor, Tensor]:
    return both_sides(turning(count)[1], -0.1, 0.1)


def slab_off_centre(count: int) -> tuple[Tensor, Tensor]:
    return both_sides(turning(count)[1], 0.3, 0.5)


def wedge(count: int) -> tuple[Tensor, Tensor]:
    """A slab whose sides turn against each other: the deepest point jumps from one end to the other."""
    tilt = torch.linspace(-0.05, 0.05, count, dtype=torch.float64)
    upper, lower = torch.stack((tilt.sin(), tilt.cos()), -1), torch.stack((tilt.sin(), -tilt.cos()), -1)
    return torch.stack((upper, lower), -2), torch.full((count, 2), 0.1, dtype=torch.float64)


def wedge_off_centre(count: int) -> tuple[Tensor, Tensor]:
    """The same wedge, away from the origin."""
    rows, bounds = wedge(count)
    return rows, bounds + 0.5 * torch.tensor([1.0, -1.0], dtype=torch.float64)


def row_in_and_out(count: int) -> tuple[Tensor, Tensor]:
    """A third row moves along the edge between the other two, starting beyond the edge's end on the box."""
    shift = torch.linspace(1.2, -0.6, count, dtype=torch.float64)
    rows = torch.tensor([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], dtype=torch.float64)
    bounds = torch.stack((torch.full_like(shift, 0.4), torch.full_like(shift, 0.3), shift), -1)
    return rows.expand(count, 3, 3), bounds


def row_vanishes(count: int) -> tuple[Tensor, Tensor]:
    """w.a <= -1, where one coordinate of w passes through 0, as a velocity does."""
    w = torch.stack((torch.linspace(-3.0, 3.0, count), torch.full((count,), 4.0), torch.full((count,), -2.0)), -1)
    return w.double().unsqueeze(-2), torch.full((count, 1), -1.0, dtype=torch.float64)


PATHS = [slab, slab_off_centre, wedge, wedge_off_centre, row_in_and_out, row_vanishes]


@pytest.mark.parametrize("path", PATHS)
def test_center_is_continuous(path):
    """Ten times as many points on the path make the longest step ten times shorter."""
    steps = []
    for count in (201, 2001, 20001):
        center = fixed(*path(count)).center(no_obs(count))
        steps.append(center.diff(dim=0).norm(dim=-1).max().item())
    assert steps[1] <= 0.2 * steps[0] + 1e-9 and steps[2] <= 0.2 * steps[1] + 1e-9


@pytest.mark.parametrize("seed", range(8))
def test_center_is_continuous_on_random_paths(seed):
    generator = torch.Generator().manual_seed(seed)
    dim, rows = [(2, 3), (3, 6), (6, 2), (6, 12)][seed % 4]
    ends = torch.randn(2, rows, dim, generator=generator, dtype=torch.float64)
    steps = []
    for count in (300, 3000):
        share = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None, None]
        center = fixed(torch.lerp(ends[0], ends[1], share), torch.full((count, rows), 0.3)).center(no_obs(count))
        steps.append(center.diff(dim=0).norm(dim=-1).max().item())
    assert steps[1] <= 0.2 * steps[0] + 1e-9


@pytest.mark.parametrize("path", PATHS)
def test_center_is_continuous_where_an_ellipse_is_added(path):
    steps = []
    for count in (201, 2001):
        rows, bounds = path(count)
        dim = rows.shape[-1]
        both = Intersection(fixed(rows, bounds), QuadraticConstraint(dim, lambda obs, d=dim: torch.eye(d), 2.0))
        center = both.center(no_obs(count))
        assert both.violation(no_obs(count), center).max() < 0.0
        steps.append(center.diff(dim=0).norm(dim=-1).max().item())
    assert steps[1] <= 0.2 * steps[0] + 1e-6


@pytest.mark.parametrize("width", [0.3, 1e-3, 1e-6, 3e-8])
def test_center_of_a_long_ellipse_that_turns_outside_the_box(width):
    """The deepest points lie along its axis, and many of them are equally deep."""

    def matrix(obs: Tensor) -> Tensor:
        axis, across = torch.stack((obs.cos(), obs.sin()), -1), torch.stack((-obs.sin(), obs.cos()), -1)
        return axis.mT @ axis / 9.0 + across.mT @ across / width**2

    turn = torch.linspace(-0.3, 0.3, 301, dtype=torch.float64).unsqueeze(-1)
    ellipse = QuadraticConstraint(2, matrix, 1.0, lambda obs: obs.new_tensor([1.5, 0.0]))
    center = ellipse.center(turn)
    assert ellipse.violation(turn, center).max() < 0.0
    assert center.diff(dim=0).norm(dim=-1).max() <= 0.02


def test_several_centres_for_one_action():
    constraint = fixed(torch.eye(2, dtype=torch.float64), torch.full((2,), 0.5))
    obs, action, center = torch.zeros(3), torch.ones(2), torch.tensor([[0.0, 0.0], [0.2, 0.0], [-0.5, 0.1]])
    for method in (constraint.gauge, constraint.alpha_map, constraint.gauge_map):
        expected = torch.stack([method(obs, action, each) for each in center])
        torch.testing.assert_close(method(obs, action, center), expected)


def test_a_small_turn_is_a_small_step():
    """If the slab turns a little, the image of an action under every map moves only a little."""
    rows, bounds = both_sides(torch.stack((turning(2, 0.01)[1] * 0.5**0.5).unbind(), 0), -0.1, 0.1)
    slab_ = fixed(rows, bounds)
    action = torch.tensor([0.4, -0.9], dtype=torch.float64).expand(2, 2)
    assert slab_.center(no_obs(2)).diff(dim=0).norm() <= 0.02
    for mapped in (slab_.radial_map, slab_.alpha_map, slab_.gauge_map, slab_.project):
        assert mapped(no_obs(2), action).diff(dim=0).norm() <= 0.02


def test_center_does_not_depend_on_the_order_of_the_rows_or_their_scale():
    generator = torch.Generator().manual_seed(3)
    constraint = random_set(5, 12, 0, 1, 1.0, seed=5, batch=50)
    rows, bounds, _ = constraint.explicit(no_obs(50))
    order = torch.randperm(12, generator=generator)
    scale = 10.0 ** torch.randn(50, 12, generator=generator, dtype=torch.float64)
    expected = constraint.center(no_obs(50))
    shuffled = fixed((rows * scale[..., None])[:, order], (bounds * scale)[:, order]).center(no_obs(50))
    twice = fixed(torch.cat((rows, rows), 1), torch.cat((bounds, bounds), 1)).center(no_obs(50))
    torch.testing.assert_close(shuffled, expected, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(twice, expected, rtol=0.0, atol=1e-9)
    # A sample has the same centre alone and in a batch.
    alone = fixed(rows[7], bounds[7]).center(no_obs(1))
    torch.testing.assert_close(alone[0], expected[7], rtol=0.0, atol=1e-9)


def test_free_joints_stay_at_zero():
    normal = torch.tensor([1.0, -1.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert fixed(*both_sides(normal, -0.1, 0.1)).center(no_obs(1)).abs().max() <= 1e-12
    center = fixed(*both_sides(normal, 0.3, 0.4)).center(no_obs(1))[0]
    assert center[2:].abs().max() <= 1e-12
    assert center[0] > 0.1 and abs(center[0] + center[1]) <= 1e-12


def largest_radius(constraint: Constraint, obs: Tensor) -> list[float]:
    """The largest radius of each sample, computed by SciPy."""
    sets = scale_sets(constraint.explicit(obs), obs.shape[:-1])
    solid = (sets.rows != 0.0).any(-1, keepdim=True).double()
    objective = [0.0] * constraint.dim + [-1.0]
    return [
        linprog(objective, torch.cat((rows, one), -1).numpy(), bounds.numpy(), bounds=(None, None)).x[-1]
        for rows, one, bounds in zip(sets.rows, solid, sets.bounds, strict=True)
    ]


@pytest.mark.parametrize("dim, rows", [(1, 2), (2, 4), (6, 2), (6, 30), (12, 20)])
def test_center_has_nearly_the_largest_radius(dim, rows):
    constraint, obs = random_set(dim, rows, 0, 1, 1.0, seed=dim + rows, batch=20), no_obs(20)
    depth = -constraint.violation(obs, constraint.center(obs))
    radius = torch.tensor(largest_radius(constraint, obs), dtype=torch.float64)
    assert (depth >= 0.9 * radius - 1e-10).all() and (depth <= radius + 1e-10).all()


@pytest.mark.parametrize("width", [1e-2, 1e-5, 1e-8])
def test_center_of_thin_sets(width):
    normals = torch.nn.functional.normalize(
        torch.randn(200, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1
    )
    thin = fixed(*both_sides(normals, 0.2, 0.2 + width))
    depth = -thin.violation(no_obs(200), thin.center(no_obs(200)))
    assert (depth >= 0.44 * width).all()
    # A thin wedge, whose tip is nearest to the origin.
    tip = fixed(
        torch.tensor([[-width, 1.0], [-width, -1.0]], dtype=torch.float64), torch.full((2,), -0.1 * width).double()
    )
    assert -tip.violation(no_obs(1), tip.center(no_obs(1))) >= 0.7 * width


def test_flat_and_empty_sets_have_no_center():
    flat, empty = (fixed(*both_sides(torch.tensor([[0.6, 0.8]]).double(), 0.2, high)) for high in (0.2, 0.1))
    with pytest.raises(ConstraintError, match="sample 0: the set has no interior"):
        flat.center(no_obs(1))
    with pytest.raises(ConstraintError, match="sample 0: the set is empty"):
        empty.center(no_obs(1))


def test_oracle_takes_the_sets_that_project_takes():
    """Rows that miss each other by rounding, are given twice, or are parallel up to rounding."""
    cases = [
        ([[1.0, 0.0], [-1.0, 0.0]], [0.0, -1e-9]),
        ([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]], [0.5, -0.5, 0.5]),
        ([[1.0, 1.0], [1.0, 1.0 + 1e-13], [-1.0, -1.0 - 1e-12]], [0.3, 0.3, -0.3]),
        ([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], [0.2, -0.2, 0.3, -0.3 - 5e-9]),
    ]
    slope = torch.tensor([[1.0, 0.3], [-1.0, 2.0], [0.0, 1.0], [0.0, 0.0]], dtype=torch.float64)
    for rows, bounds in cases:
        constraint = fixed(torch.tensor(rows, dtype=torch.float64), torch.tensor(bounds, dtype=torch.float64))
        best = constraint.linear_oracle(no_obs(), slope)
        assert constraint.violation(no_obs(), best).max() <= 1e-8
        # No point of the set is further along the slope.
        ahead = constraint.project(no_obs(), best + slope)
        torch.testing.assert_close(
            ((ahead - best) * slope).sum(-1).clamp(min=0.0), torch.zeros(4).double(), atol=2e-8, rtol=0.0
        )


def test_center_with_an_ellipse_does_not_jump():
    """The centre moves away from the origin before the origin leaves the intersection."""
    steps = []
    for count in (201, 2001):
        shift = torch.linspace(0.2, -0.2, count, dtype=torch.float64)
        row = fixed(torch.tensor([[0.6, 0.8]], dtype=torch.float64), shift.unsqueeze(-1))
        both = Intersection(row, QuadraticConstraint(2, lambda obs: torch.eye(2), 0.25))
        center = both.center(no_obs(count))
        assert both.violation(no_obs(count), center).max() < -1e-3
        assert center[0].abs().max() == 0.0
        steps.append(center.diff(dim=0).norm(dim=-1).max().item())
    assert steps[1] <= 0.2 * steps[0] + 1e-9
