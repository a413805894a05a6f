"""Returns on Reacher without the luck of their starts."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import run_command

from core.evaluation import Evaluator
from envs.reacher import FLOATS, LIMIT, REACH, Reacher, State
from plots.grouping import group_runs
from plots.starts import adjusted_returns, adjusted_table, final_gains, gains, mean_gain
from store.folder import read_results

WORDS = (
    "algo=DPre env=R+L2 seed=3,5 steps=600 learning_starts=450 hidden=[4] batch_size=4 eval_every=150 eval_episodes=3"
    " final_episodes=7 threads=1"
)


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Short runs, and the first observations (seeds, episodes, 9) of their final episodes."""
    together, starts = Evaluator._together, []

    def recorded(self, policy, which, count):
        first = []

        def watched(obs):
            first.append(obs.clone())
            return policy(obs)

        returns = together(self, watched, which, count)
        starts.append(first[0].numpy())
        return returns

    monkeypatch.setattr(Evaluator, "_together", recorded)
    assert run_command([*WORDS.split(), f"results={tmp_path}"]) == 0
    return read_results(tmp_path)[0], np.concatenate(starts[-3:], axis=1)


def test_final_starts_follow_from_the_seed(trained):
    runs, starts = trained
    for run, obs in zip(runs, starts, strict=True):
        found = final_gains(run.task, run.seed, len(run.evaluations.step), 3, 7)
        assert np.allclose(found, gains(obs.astype(np.float64)), atol=1e-4)  # agents see float32


def test_the_adjustment_shifts_a_return_by_the_luck_of_its_start(trained):
    runs, starts = trained
    for run, obs in zip(runs, starts, strict=True):
        luck = gains(obs.astype(np.float64)) - mean_gain()
        assert np.allclose(np.array(run.result["returns"]) - adjusted_returns(run), luck, atol=1e-4)
    table = adjusted_table(group_runs(runs)[0])
    assert table.header[-2:] == [f"s.e. of {len(runs[0].result['returns'])} episodes", "the same, adjusted"]
    (record,) = table.records
    means = [adjusted_returns(run).mean() for run in runs]
    assert record["n"] == 2 and np.isclose(record["adjusted_mean"], np.mean(means))
    assert np.isclose(record["adjusted_se"], np.std(means, ddof=1) / 2**0.5)


def test_seeds_that_diverged_are_left_out_and_counted(trained):
    sound, other = trained[0]
    failure = {"step": 500, "reason": "a parameter is not finite", "result": other.result}
    runs = [sound, replace(other, result=None, failure=failure)]
    table = adjusted_table(group_runs(runs)[0])
    assert table.records[0]["n"] == 1 and table.records[0]["diverged"] == 1
    assert " (1 of 2 diverged, left out)" in table.sections[0][0][2].lines[0]
    table = adjusted_table(group_runs(runs[1:])[0])
    assert table.sections[0][0][2].lines == ("– (1 of 1 diverged, left out)",) and table.records == []


def test_gain_is_what_the_arm_can_make_up():
    angles = np.linspace(-LIMIT, LIMIT, 20_001)
    tips = [State(0.0, q2, 0, 0, 0, 0, 0, 0).fingertip(FLOATS) for q2 in angles]
    radii = np.hypot(*np.array(tips).T)
    assert np.allclose((radii.min(), radii.max()), REACH, atol=1e-6)
    robot, rng = Reacher(), np.random.default_rng(0)
    obs = np.array([robot.reset(rng) for _ in range(200)])
    target = np.linalg.norm(obs[:, :2], axis=-1)
    rest = np.abs(target[:, None] - radii).min(-1)  # the smallest distance of any posture
    assert np.allclose(gains(obs), 100 * (np.linalg.norm(obs[:, 2:4], axis=-1) - rest), atol=0.01)


def test_mean_gain_agrees_with_random_starts():
    robot, rng = Reacher(), np.random.default_rng(1)
    drawn = gains(np.array([robot.reset(rng) for _ in range(20_000)]))
    assert abs(drawn.mean() - mean_gain()) < 4 * drawn.std() / len(drawn) ** 0.5
    assert abs(mean_gain(2**12) - mean_gain()) < 0.05
