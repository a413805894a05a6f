"""Sets with learned coefficients: environments and trainings use their current values."""

import gymnasium
import numpy as np
import pytest
import torch
from helpers import run_command

import envs
import plot
from algos import ALGORITHMS
from constraints import HalfSpace, WeightedL1
from envs import TASKS, Constrained, Task
from envs.reacher import Reacher
from store.folder import find_runs, read_run

SHORT = "seed=0,1 steps=90 learning_starts=40 batch_size=8 hidden=[8,8] eval_every=60 checkpoint_every=20"


def learned(inputs, outputs):
    """A function of observations with parameters that require gradients."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = torch.nn.Linear(inputs, outputs, dtype=torch.float64)
    return lambda obs: network(obs[..., :inputs].double())


def test_the_wrapper_executes_feasible_actions():
    constraint = WeightedL1(weight=learned(3, 1), bound=0.01, dim=1)
    env = Constrained(gymnasium.make("Pendulum-v1"), constraint, mapping="project")
    obs, moved = env.reset(seed=0)[0], 0
    for suggestion in (1.0, -1.0, 0.5, 0.0):
        following, *_, info = env.step(np.array([suggestion]))
        executed = torch.from_numpy(info["executed_action"])
        assert constraint.violation(torch.from_numpy(obs).double(), executed) <= 1e-6
        obs, moved = following, moved + (executed.item() != suggestion)
    assert moved >= 2 and executed.item() == 0.0


@pytest.fixture
def task(monkeypatch):
    constraint = HalfSpace(learned(9, 2), 0.05, 2)
    monkeypatch.setitem(TASKS, "R+Learned", Task(Reacher, constraint, "a learned row", "n a \\leq 0.05", 300))
    return constraint


def test_an_environment_projects_and_draws(task):
    env = envs.make("R+Learned", project=True, render_mode="rgb_array", show_set=True)
    obs, _ = env.reset(seed=0)
    executed = env.step(np.ones(2))[-1]["executed_action"]
    assert task.violation(torch.from_numpy(obs), torch.from_numpy(executed)) <= 1e-6
    assert env.render().shape[-1] == 3


def test_its_actions_are_drawn(task, tmp_path):
    words = f"algo=DRad env=R+Learned {SHORT} eval_episodes=1 final_episodes=1".replace("seed=0,1", "seed=0")
    assert run_command([*words.split(), f"results={tmp_path}"]) == 0
    (folder,) = find_runs(tmp_path)
    assert plot.main(["actions", str(folder), "format=png"]) == 0


@pytest.mark.parametrize("algo", sorted(ALGORITHMS))
def test_every_algorithm_trains_on_them(task, algo, tmp_path):
    words = f"algo={algo} env=R+Learned {SHORT} eval_episodes=1 final_episodes=1"
    words += " flow_steps=5" * (algo in ("DFlow", "SFlow"))
    assert run_command([*words.split(), f"results={tmp_path}"]) == 0
    results = [read_run(folder).result for folder in find_runs(tmp_path)]
    assert len(results) == 2 and all(result["largest_violation"] <= 1e-6 for result in results)
