"""The entropies that bench/entropy.py finds: against areas, against an integral, and from the command line."""

import importlib
import math
import sys

import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

import envs
from constraints import Ball, Box


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))  # the script changes it
    return importlib.import_module("bench.entropy")


def reacher_states(angles):
    """Observations of Reacher (states, 9) with these theta_2."""
    obs = torch.zeros(len(angles), 9, dtype=torch.float64)
    obs[:, 7] = torch.tensor(angles, dtype=torch.float64)
    return obs


def test_uniform_entropy_is_the_log_of_the_volume(bench):
    obs = reacher_states([0.5, 1.0, math.pi / 2, 2.5])
    volumes = [
        (Box(2), torch.full((4,), 4.0)),
        (Box(6), torch.full((4,), 64.0)),
        (Ball(0.05, 3), torch.full((4,), 4 / 3 * math.pi * 0.05**1.5)),
        (envs.constraint("R+T"), 0.05 * math.pi / obs[:, 7].sin()),  # det Q = sin^2 theta_2; inside the box here
    ]
    for constraint, volume in volumes:
        found = bench.uniform_entropy(constraint, obs)
        torch.testing.assert_close(found, volume.double().log(), atol=5e-3, rtol=0)


def disc_entropy(std):
    """Entropy, in unit-ball coordinates, of N(0, std^2 I) in two dimensions after y = tanh(|v|) v / |v| (radial)."""

    def integrand(radius):
        log_normal = -0.5 * (radius / std) ** 2 - math.log(2 * math.pi * std**2)
        log_det = math.log(math.tanh(radius) / radius) - 2 * math.log(math.cosh(radius))
        return -2 * math.pi * radius * math.exp(log_normal) * (log_normal - log_det)

    return quad(integrand, 0, 12 * std)[0]


def alpha_disc_entropy(std):
    """The same after the alpha map: inside it has the density of the Gaussian, on the circle that of the angle."""
    outside = math.exp(-0.5 / std**2)

    def integrand(radius):
        log_normal = -0.5 * (radius / std) ** 2 - math.log(2 * math.pi * std**2)
        return -2 * math.pi * radius * math.exp(log_normal) * log_normal

    return quad(integrand, 0, 1)[0] - outside * math.log(outside / (2 * math.pi))


@pytest.mark.parametrize(("mapping", "entropy"), [("radial", disc_entropy), ("alpha", alpha_disc_entropy)])
def test_the_largest_entropy_on_a_disc(bench, mapping, entropy):
    best = -minimize_scalar(lambda std: -entropy(std), bounds=(0.1, 3), method="bounded").fun
    constraint = envs.constraint("R+L2")
    ball = bench.largest_entropy(constraint, reacher_states([0.0, 1.0]), mapping, unit_ball=True)
    torch.testing.assert_close(ball, torch.full_like(ball, best), atol=5e-3, rtol=0)


def test_volume_and_boundary_scale_apart(bench):
    """On a disc of radius r, probability inside adds 2 log r to the entropy, probability on the circle log r."""
    radius, obs = 0.05**0.5, reacher_states([0.0])
    constraint = envs.constraint("R+L2")
    ball = bench.largest_entropy(constraint, obs, "radial", unit_ball=True)
    paper = bench.largest_entropy(constraint, obs, "radial", unit_ball=False)
    torch.testing.assert_close(paper, ball + 2 * math.log(radius), atol=1e-3, rtol=0)

    def paper_alpha(std):
        outside = math.exp(-0.5 / std**2)
        return alpha_disc_entropy(std) + (2 - outside) * math.log(radius)

    best = -minimize_scalar(lambda std: -paper_alpha(std), bounds=(0.1, 5), method="bounded").fun
    alpha = bench.largest_entropy(constraint, obs, "alpha", unit_ball=False)
    torch.testing.assert_close(alpha, torch.full_like(alpha, best), atol=5e-3, rtol=0)


def test_srad_cannot_reach_its_target_on_the_tip_task(bench):
    """The claim of docs/entropy.md, checked by a gradient-free search over a grid of standard deviations."""
    angles = [0.0, 0.5, 1.0]
    obs, constraint = reacher_states(angles), envs.constraint("R+T")
    found = bench.largest_entropy(constraint, obs, "radial", unit_ball=False)
    assert ((found > -2.5) & (found < -2.3)).all()
    noise = bench.normal_noise(2**11, 2, seed=5).unsqueeze(1)
    log_stds = torch.cartesian_prod(*[torch.linspace(-6.0, 3.0, 19, dtype=torch.float64)] * 2)
    for state, most in zip(obs, found, strict=True):
        policy = torch.distributions.Normal(torch.zeros_like(log_stds), log_stds.exp())
        searched = -bench.log_density(constraint, state, policy.stddev * noise, policy, "radial", False).mean(0)
        assert most - 0.15 < searched.max() < most + 0.02


def test_from_the_command_line(bench, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "ASCENT_STEPS", 2)
    assert bench.main(["task=R+L2,H+M", "states=2", f"out={tmp_path}"]) == 0
    rows = (tmp_path / "entropy.md").read_text().splitlines()[4:]
    assert [row.split(" | ")[:2] for row in rows] == [["| R+L2", "-2"], ["| H+M", "-3"]]
    assert "| R+L2 |" in capsys.readouterr().out
    for words, bad in [(["task=R+X"], "R+X"), (["states=0"], "'0'"), (["seed=1"], "seed")]:
        assert bench.main(words) == 2
        assert bad in capsys.readouterr().err
    assert bench.main(["--help"]) == 0 and "python bench/entropy.py" in capsys.readouterr().out


def test_interrupted_it_keeps_what_it_has(bench, tmp_path, capsys, monkeypatch):
    def measure(task, states):
        if task == "R+T":
            raise KeyboardInterrupt
        return [task, "-2"]

    monkeypatch.setattr(bench, "measure", measure)
    assert bench.main(["task=R+L2,R+T,H+M", f"out={tmp_path}"]) == 130
    assert (tmp_path / "entropy.md").read_text().splitlines()[4:] == ["| R+L2 | -2 |"]
    assert "interrupted" in capsys.readouterr().err
