"""The entropies that bench/entropy.py finds: against areas, against an integral, and from the command line."""

import importlib
import math
import sys

import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

import envs


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))  # the script changes it
    return importlib.import_module("bench.entropy")


def test_uniform_entropy_is_the_log_of_the_area(bench):
    angles = torch.tensor([0.5, 1.0, math.pi / 2, 2.5], dtype=torch.float64)
    obs = torch.zeros(4, 9, dtype=torch.float64)
    obs[:, 7] = angles
    for task, area in [
        ("R+N", torch.full_like(angles, 4.0)),
        ("R+L2", torch.full_like(angles, 0.05 * math.pi)),
        ("R+T", 0.05 * math.pi / angles.sin()),  # det Q = sin^2 theta_2; these ellipses are inside the box
    ]:
        found = bench.uniform_entropy(envs.constraint(task), obs)
        torch.testing.assert_close(found, area.log(), atol=1e-3, rtol=0)


def disc_entropy(std):
    """In unit-ball coordinates, of N(0, std^2 I) in two dimensions after radial squashing y = tanh(|v|) v / |v|."""

    def integrand(radius):
        log_normal = -0.5 * (radius / std) ** 2 - math.log(2 * math.pi * std**2)
        log_det = math.log(math.tanh(radius) / radius) - 2 * math.log(math.cosh(radius))
        return -2 * math.pi * radius * math.exp(log_normal) * (log_normal - log_det)

    return quad(integrand, 0, 12 * std)[0]


def test_the_largest_entropy_on_a_disc(bench):
    best = -minimize_scalar(lambda std: -disc_entropy(std), bounds=(0.1, 3), method="bounded").fun
    assert math.log(math.pi) - 0.1 < best < math.log(math.pi)
    obs = torch.zeros(2, 9, dtype=torch.float64)
    constraint = envs.constraint("R+L2")
    ball = bench.largest_entropy(constraint, obs, "radial", unit_ball=True)
    paper = bench.largest_entropy(constraint, obs, "radial", unit_ball=False)
    torch.testing.assert_close(ball, torch.full_like(ball, best), atol=5e-3, rtol=0)
    torch.testing.assert_close(paper, torch.full_like(paper, best + math.log(0.05)), atol=5e-3, rtol=0)


def test_no_policy_has_more_than_the_uniform_one(bench):
    obs = bench.visited_states("R+T", 8)
    constraint = envs.constraint("R+T")
    uniform = bench.uniform_entropy(constraint, obs)
    assert (bench.largest_entropy(constraint, obs, "radial", unit_ball=False) < uniform).all()
    # With the boundary's length beside the area there is more to spread over.
    assert (bench.largest_entropy(constraint, obs, "alpha", unit_ball=False) > uniform).all()


def test_from_the_command_line(bench, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "ASCENT_STEPS", 2)
    assert bench.main(["task=R+L2,H+M", "states=2", f"out={tmp_path}"]) == 0
    rows = (tmp_path / "entropy.md").read_text().splitlines()[2:]
    assert [row.split(" | ")[:2] for row in rows] == [["| R+L2", "-2"], ["| H+M", "-3"]]
    assert "| R+L2 |" in capsys.readouterr().out
    for words, bad in [(["task=R+X"], "R+X"), (["states=0"], "'0'"), (["seed=1"], "seed")]:
        assert bench.main(words) == 2
        assert bad in capsys.readouterr().err
