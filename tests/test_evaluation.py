"""Evaluation: episodes that are stepped together have the same returns as each one alone."""

import numpy as np
import pytest
import torch
from helpers import CHECKPOINTED, train

import envs
from core.evaluation import Evaluator
from core.random import stream_seed

SEEDS, EPISODES = (3, 5, 8), 2


def policy(task, spoiled=None):
    """A feasible policy, linear in the observation and different for each seed.

    For the seed in position `spoiled`, the first episode's 21st action is NaN.
    """
    constraint, calls = envs.constraint(task), []

    def act(obs):
        weight = torch.randn(len(SEEDS), obs.shape[-1], constraint.dim, generator=torch.Generator().manual_seed(0))
        actions = constraint.project(obs, torch.tanh(obs @ weight))
        calls.append(obs)
        if spoiled is not None and len(calls) == 21:
            actions[spoiled, 0] = torch.nan
        return actions

    return act


def one_by_one(task, act):
    """The returns, the environments and the seeds' error messages, from a loop over `env.step`."""
    robots = [[envs.make(task) for _ in range(EPISODES)] for _ in SEEDS]
    obs, returns, refused = [], np.zeros((len(SEEDS), EPISODES)), {}
    for seed, row in zip(SEEDS, robots, strict=True):
        for j, env in enumerate(row):
            env.reset(seed=stream_seed(seed, "evaluation", j))
        obs.append([env.reset()[0] for env in row])
    running = {(i, j) for i in range(len(SEEDS)) for j in range(EPISODES)}
    while running:
        actions = act(torch.tensor(np.array(obs), dtype=torch.float32)).numpy()
        for i, j in sorted(running):
            try:
                obs[i][j], reward, terminated, truncated, _ = robots[i][j].step(actions[i, j])
            except envs.InfeasibleActionError as error:
                refused[i] = str(error)
                reward, terminated = np.nan, True
            returns[i, j] += reward
            if terminated or truncated:
                running.remove((i, j))
    return returns, [env for row in robots for env in row], refused


@pytest.mark.parametrize("task", ["R+L2", "W+M"])  # walkers fall after different numbers of steps
@pytest.mark.parametrize("spoiled", [None, 1])
def test_episodes_stepped_together_return_what_single_steps_do(task, spoiled):
    evaluator = Evaluator(lambda: envs.make(task), SEEDS, EPISODES, envs.step_together, stop_if_asked=lambda: None)
    returns = evaluator.run(policy(task, spoiled), range(len(SEEDS)), EPISODES)
    wanted, robots, refused = one_by_one(task, policy(task, spoiled))
    np.testing.assert_array_equal(returns, wanted)
    assert evaluator.refused == refused and refused.keys() == ({1} if spoiled else set())
    assert np.isnan(returns).sum() == (spoiled is not None)
    for env, alone in zip((env for i in range(len(SEEDS)) for env in evaluator.of_seed(i)), robots, strict=True):
        assert (env.executed_actions, env.largest_violation) == (alone.executed_actions, alone.largest_violation)
    if task == "W+M":
        assert len({env.executed_actions for env in robots}) > 2
    for env in robots:
        env.close()
    evaluator.close()


def test_a_long_evaluation_has_a_bar_of_its_own(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("core.progress.EVALUATION_DELAY", 0.0)
    train(tmp_path, CHECKPOINTED.replace("eval_episodes=1", "eval_episodes=2"))
    err = capsys.readouterr().err
    assert "DPre R+N (2 seeds together) training" in err
    # The longest episodes of Reacher have 150 steps; one final episode of each seed, side by side.
    assert "DPre R+N (2 seeds together) evaluation" in err and "/150 [" in err
