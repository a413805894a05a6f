"""The check before a run calls constraint, map and algorithm as the run will, and its message names what fails."""

import pytest
import torch
from helpers import run_command
from torch import nn

import envs
from algos import ALGORITHMS, Algorithm
from algos.sac import SAC
from algos.td3 import TD3
from constraints import Ball, LinearConstraint
from core.maps import Map, Radial
from envs import TASKS, Task
from envs.reacher import Reacher
from store.folder import read_results

WORDS = "env=R+X steps=20 learning_starts=10 batch_size=4 hidden=[8] eval_every=20 eval_episodes=1 final_episodes=1"


class BreaksPenalty(Ball):
    def _penalty(self, obs, action):
        return (action * obs[..., :3]).sum(-1)


class BreaksOracle(Ball):
    def _linear_oracle(self, obs, gradient):
        return gradient * 10


class BreaksGauge(Ball):
    def _gauge_and_gradient(self, at, direction, center):
        return direction @ torch.eye(3, dtype=direction.dtype), direction


class OneAxis(LinearConstraint):
    """Fails for observations with two leading axes."""

    def A(self, obs):
        return torch.ones(len(obs), 1, 2)

    def b(self, obs):
        return torch.ones(len(obs), 1)


class OneAxisMap(Map):
    def __call__(self, constraint, obs, suggested, center):
        mapped = constraint.radial_map(obs, suggested, center)
        return torch.stack([row * 1.0 for row in mapped.view(-1, 2)]).view(len(mapped), 2)


class Infeasible(Map):
    def __call__(self, constraint, obs, suggested, center):
        return suggested * 1.0


class DensityOfAnotherShape(Radial):
    def with_log_prob(self, constraint, obs, sample, center):
        action, log_prob = super().with_log_prob(constraint, obs, sample, center)
        return action, log_prob.unsqueeze(-1)


class NoGradient(Map):
    def __call__(self, constraint, obs, suggested, center):
        return constraint.radial_map(
            obs, suggested + (suggested - suggested).square().sum(-1, keepdim=True).sqrt(), center
        )


class SharedLayer(TD3):
    def build(self, init):
        super().build(init)
        self.actor.extra = nn.Linear(2, 2)


class CannotBeSaved(TD3):
    def training_state(self, i):
        return super().training_state(i) | {"robot": Reacher}


class RobotCannotBeSaved(Reacher):
    simulators = {}  # Reacher's simulators are other classes

    def get_state(self):
        return [1.0]


def row(monkeypatch, agent=TD3, map=None, placement="layer"):
    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(agent, map or Radial(), placement))


@pytest.mark.parametrize(
    "algo, constraint, said",
    [
        (
            "DPre+",
            BreaksPenalty(0.5, 2),
            "the constraint of R+X does not work: penalty at observations of shape (2, 3, 9): ",
        ),
        (
            "NFW",
            BreaksOracle(0.5, 2),
            "does not work: linear_oracle at observations of shape (2, 3, 9): the result violates",
        ),
        ("DRad", BreaksGauge(0.5, 2), "does not work: radial_map at observations of shape (2, 3, 9): "),
        ("SAlpha", BreaksGauge(0.5, 2), "does not work: alpha_map at observations of shape (2, 3, 9): "),
        ("DPre", OneAxis(dim=2), "does not work: project at observations of shape (2, 3, 9): "),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_method_of_the_constraint_that_the_run_will_use(tmp_path, monkeypatch, capsys, algo, constraint, said):
    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, constraint, "", "", 20))
    assert run_command([f"algo={algo}", *WORDS.split(), f"results={tmp_path}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not list(tmp_path.iterdir())


@pytest.mark.parametrize("algo", ["DPro", "DRad", "SPre"])
def test_the_least_violation_at_the_start_is_no_mistake(tmp_path, monkeypatch, algo):
    rows, bounds = torch.tensor([[1.0, 0.0], [-1.0, 0.0]]).double(), torch.full((2,), -0.5).double()
    constraint = LinearConstraint(2, lambda obs: rows, lambda obs: bounds, on_empty="least")
    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, constraint, "", "", 20))
    assert run_command([f"algo={algo}", *WORDS.split(), f"results={tmp_path}"]) == 0
    (run,) = read_results(tmp_path)[0]
    assert run.result["largest_violation"] == pytest.approx(0.5, abs=2e-6)


@pytest.mark.parametrize("algo", ["DPre", "DRad"])
def test_methods_that_the_run_does_not_use_may_break(tmp_path, monkeypatch, algo):
    constraint = BreaksOracle(0.5, 2) if algo == "DRad" else BreaksGauge(0.5, 2)
    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, constraint, "", "", 20))
    assert run_command([f"algo={algo}", *WORDS.split(), f"results={tmp_path}"]) == 0


@pytest.mark.parametrize(
    "agent, map, said",
    [
        (TD3, OneAxisMap(), "the map OneAxisMap does not work on R+X: shape '[2, 2]' is invalid"),
        (
            TD3,
            Infeasible(),
            "Mine on R+X: the map Infeasible, __call__ gives an action that violates the constraint by",
        ),
        (SAC, DensityOfAnotherShape(), "not finite numbers of shape (2, 3)"),
        (
            TD3,
            NoGradient(),
            "the map NoGradient does not work on R+X: the gradient through __call__ is infinite or NaN",
        ),
        (SharedLayer, Radial(), "Mine: parameter actor.extra.weight has shape (2, 2) for one seed and (2, 2) for 2"),
        (CannotBeSaved, Radial(), "the state of Mine cannot be saved in a checkpoint: "),
    ],
    ids=lambda value: getattr(value, "__name__", type(value).__name__),
)
def test_maps_and_algorithms_of_ones_own(tmp_path, monkeypatch, capsys, agent, map, said):
    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, Ball(0.5, 2), "", "", 20))
    row(monkeypatch, agent, map)
    assert run_command(["algo=Mine", *WORDS.split(), f"results={tmp_path}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not list(tmp_path.iterdir())


def test_a_robot_whose_state_cannot_be_saved(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(TASKS, "R+X", Task(RobotCannotBeSaved, Ball(0.5, 2), "", "", 20))
    assert run_command(["algo=DPre", *WORDS.split(), f"results={tmp_path}"]) == 2
    assert "the robot of R+X does not work: RobotCannotBeSaved.get_state() returns [1.0]" in capsys.readouterr().err


def test_an_error_in_an_algorithms_own_code_keeps_its_traceback(tmp_path, monkeypatch):
    class Broken(TD3):
        def actor_loss(self, batch):
            return 1 / 0

    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, Ball(0.5, 2), "", "", 20))
    row(monkeypatch, Broken)
    with pytest.raises(ZeroDivisionError):
        run_command(["algo=Mine", *WORDS.split(), f"results={tmp_path}"])
    assert not list(tmp_path.iterdir())  # before anything was written


def test_the_check_leaves_no_trace(tmp_path, monkeypatch):
    """It changes neither the task's constraint nor the state of PyTorch's random numbers."""
    constraint = TASKS["R+L2"].constraint
    before = dict(vars(constraint)), torch.get_rng_state()
    assert run_command(["algo=SRad", *WORDS.replace("R+X", "R+L2").split(), f"results={tmp_path}"]) == 0
    assert dict(vars(constraint)) == before[0] and torch.equal(torch.get_rng_state(), before[1])
    assert envs.constraint("R+L2") is constraint
