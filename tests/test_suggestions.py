"""The measures of an actor's suggestions in training.csv, compared with the agent's actual suggestions."""

import math

import pytest
import torch
from helpers import Breaks, assert_identical, outcome, train, train_through

import envs
from core.agent import Agent
from core.suggestions import EVERY, Suggestions
from store.folder import find_runs, read_run

WORDS = (
    "env=R+L2 seed=3,5 steps=90 learning_starts=25 batch_size=4 hidden=[8,8] eval_every=20 eval_episodes=1"
    " final_episodes=1 checkpoint_every=10 train_freq=1 gradient_steps=1"
)


def test_an_evaluation_takes_the_suggestions_since_the_one_before():
    suggestions = Suggestions()
    assert all(map(math.isnan, suggestions.take().values()))
    for violation in (0.5, -0.3, 0.1, 0.0):
        suggestions.add(violation)
    assert suggestions.take() == {"suggested_violation": pytest.approx(0.15), "suggested_infeasible": 0.5}
    suggestions.add(-1.0)
    assert suggestions.take() == {"suggested_violation": 0.0, "suggested_infeasible": 0.0}


@pytest.mark.parametrize("algo", ["DPro", "DPre", "DRad", "SPre", "SRad"])
def test_the_measures_are_those_of_what_the_map_was_given(tmp_path, monkeypatch, algo):
    act, constraint, seen = Agent.act, envs.constraint("R+L2"), {0: [], 1: []}

    def recorded(self, obs, center, warming_up, exploring):
        action = act(self, obs, center, warming_up, exploring)
        given = action.suggested.clamp(-1.0, 1.0) if algo in ("DPro", "DPre", "SPre") else action.suggested
        for i in [*warming_up, *exploring]:
            excess = constraint.violation(obs[i], given[i]).item() if i in exploring else None
            changed = (action.executed[i] - given[i]).abs().max().item() > 0.0
            seen[i].append((excess, changed))
        return action

    monkeypatch.setattr("sweep.train.check_training", lambda *_: None)  # the check calls `act` too
    monkeypatch.setattr(Agent, "act", recorded)
    train(tmp_path, f"algo={algo} {WORDS}")
    for i, folder in enumerate(find_runs(tmp_path)):
        training = read_run(folder).training
        assert training["step"].tolist() == [40, 60, 80, 90]
        for row, (start, end) in enumerate([(20, 40), (40, 60), (60, 80), (80, 90)]):
            steps = [seen[i][step] for step in range(start, end) if step % EVERY == 0 and step >= 25]
            excess = torch.tensor([violation for violation, _ in steps])
            assert len(steps) in (1, 2)
            assert training["suggested_violation"][row] == pytest.approx(excess.clamp(min=0).mean().item(), abs=1e-6)
            assert training["suggested_infeasible"][row] == (excess > 0).float().mean().item()
            if algo != "DRad" and algo != "SRad":  # a projection changes only infeasible ones
                assert training["suggested_infeasible"][row] == sum(changed for _, changed in steps) / len(steps)
        assert training["suggested_infeasible"].max() > 0


def test_resumed_measures_are_those_of_an_unbroken_run(tmp_path):
    words = f"algo=SRad {WORDS}"
    train(tmp_path / "unbroken", words)
    assert train_through(tmp_path / "broken", words, Breaks(150, 190, 230)) == 3
    assert_identical(outcome(tmp_path / "broken"), outcome(tmp_path / "unbroken"))
