"""Every algorithm on every task: it trains, it moves its parameters, and it executes feasible actions only."""

import json

import pytest
import torch
from helpers import run_command

from algos import ALGORITHMS
from envs import TASKS
from sweep import train

SHORT = ["learning_starts=20", "batch_size=8", "hidden=[16,16]", "eval_episodes=1", "final_episodes=1"]


def settings(algo, task):
    """Settings of a short run with gradient steps. If TD3 waits for the end of an episode, the run has a short one or
    changes `train_freq`."""
    robot = TASKS[task].robot.__name__
    if algo == "ARAM":
        return {"steps": 40, "snapshots_after": 0, "snapshot_every": 5}
    if ALGORITHMS[algo].agent.family == "SAC" or robot == "Hopper":
        return {"steps": 40}
    # An episode of HalfCheetah is 1,000 steps: too long for thirteen algorithms twice.
    return {"HalfCheetah": {"steps": 40, "train_freq": 10}, "Reacher": {"steps": 151}, "Walker2d": {"steps": 120}}[
        robot
    ]


@pytest.mark.usefixtures("small_flows")
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_pair(tmp_path, capsys, monkeypatch, algo, task):
    chosen, fresh = settings(algo, task), {}

    def make_trainer(*arguments, **options):
        trainer = original(*arguments, **options)
        fresh.update(trainer.agent.state(0))
        return trainer

    original = train.make_trainer
    monkeypatch.setattr(train, "make_trainer", make_trainer)
    words = [f"algo={algo}", f"env={task}", "seed=0", f"results={tmp_path}", *(f"{k}={v}" for k, v in chosen.items())]
    assert run_command([*words, *SHORT]) == 0
    (folder,) = tmp_path.glob("*/*/seed=0")
    result = json.loads((folder / "result.json").read_text())
    assert result["largest_violation"] <= 1e-6
    assert result["executed_actions"] >= chosen["steps"] + 2 and result["steps"] == chosen["steps"]
    assert result["gradient_steps"] > 0
    assert str(folder) in capsys.readouterr().out

    last = torch.load(folder / "last.pt", weights_only=True)
    assert all(parameter.isfinite().all() for parameter in last.values())
    assert last.keys() == fresh.keys()
    modules = {name.split(".")[0] for name in last} - {"map"}  # which is not trained any more
    assert {"actor", "critic", "critic_target"} <= modules and ("actor_target" in modules) == (
        ALGORITHMS[algo].agent.family == "TD3"
    )
    for module in modules:
        names = [name for name in last if name.startswith(f"{module}.")]
        assert any(not torch.equal(last[name], fresh[name]) for name in names), f"{module} has not moved"
        if module.endswith("_target"):
            sources = {name: name.replace("_target", "", 1) for name in names}
            assert any(not torch.equal(last[name], last[source]) for name, source in sources.items()), module


def test_every_executed_action_is_counted(tmp_path):
    """The counts of training and evaluation environments add up: nothing is executed unchecked."""
    words = ["algo=DPre", "env=R+M", "seed=0-1", "steps=150", f"results={tmp_path}", *SHORT]
    assert run_command([*words, "eval_every=50"]) == 0
    for seed in (0, 1):
        (path,) = tmp_path.glob(f"*/*/seed={seed}/result.json")
        # 150 training steps, three evaluations and the final one of an episode each
        assert json.loads(path.read_text())["executed_actions"] == 150 + (3 + 1) * 150
