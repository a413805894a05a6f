"""The training loop, with a scripted environment and an agent whose only parameter counts its gradient steps."""

import errno
from collections.abc import Sequence
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from algos import ALGORITHMS
from constraints import WeightedPositivePart
from core.agent import Agent
from core.config import Config
from core.maps import Alpha
from core.random import Streams
from core.seed import COUNTERS
from core.trainer import Trainer
from store.checkpoint import CheckpointFolder
from store.folder import is_finished, read_run
from store.interrupt import Interrupted
from store.writer import RunWriter

OBS, DIM = 3, 2
LENGTHS = (5, 7)  # of episodes, in turns; the shorter ones terminate, the longer ones are truncated
CONSTRAINT = WeightedPositivePart(lambda obs: obs[..., :DIM] + 1.0, 0.5, DIM)


def step_together(envs, actions):
    """Step scripted environments one by one; they do not check actions."""
    return [env.step(action) for env, action in zip(envs, actions, strict=True)]


class Scripted(gymnasium.Env):
    """The obs is (step, episode, number of the environment), the reward the action's first coordinate."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS,), np.float64)
    made = 0
    robot = SimpleNamespace(max_episode_steps=10)  # a progress bar reads this

    def __init__(self, fail=None):
        self.fail = fail  # called before every step
        self.number, self.episode, self.executed, self.closed = Scripted.made, -1, [], False
        Scripted.made += 1
        self.largest_violation = -1.0

    @property
    def executed_actions(self):
        return len(self.executed)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode += 1
        self.t = 0
        return self.obs(), {}

    def obs(self):
        return np.array([self.t, self.episode % 10, self.number], dtype=np.float64)

    def step(self, action):
        if self.fail is not None:
            self.fail(self)
        self.executed.append(np.array(action))
        self.t += 1
        over, short = self.t == LENGTHS[self.episode % 2], self.episode % 2 == 0
        return self.obs(), float(action[0]), over and short, over and not short, {}

    def close(self):
        self.closed = True

    def get_state(self):
        return {"episode": self.episode, "t": self.t, "executed": torch.tensor(np.array(self.executed))}

    def set_state(self, state):
        self.episode, self.t, self.executed = state["episode"], state["t"], list(state["executed"].numpy())


class Counter(Agent):
    """Its only parameter, one for each seed, counts gradient steps. Its policy earns the score of that number."""

    def __init__(self, config, seeds, scores=()):
        super().__init__(config, CONSTRAINT, OBS, seeds, map=Alpha(), placement="layer")
        self.scores, self.rollouts, self.episodes, self.trainer = scores, [], [], None

    def build(self, init):
        self.net = nn.Module()
        self.net.count = nn.Parameter(torch.zeros(len(self.seeds), 1))

    def networks(self):
        return {"net": self.net}

    def optimizers(self):
        return {}

    def explore(self, obs, which):
        return torch.full((len(self.seeds), DIM), 0.01)

    def policy(self, which: Sequence[int]):
        count = self.net.count.detach()[list(which)].clone()

        def act(obs):
            reward = torch.tensor([self.scores[int(n)] if self.scores else 0.0 for n in count])
            return reward.view(-1, 1, 1).expand(*obs.shape[:2], DIM)

        return act

    def update(self, batch):
        assert batch.obs.shape == (len(self.seeds), self.config.batch_size, OBS)
        with torch.no_grad():
            self.net.count += 1

    def start_episode(self, which):
        self.episodes += [(i, self.trainer.seeds[i].env.episode, self.trainer.seeds[i].env.t) for i in which]

    def start_rollout(self, which):
        self.rollouts += [(i, self.trainer.seeds[i].steps) for i in which]


def make_trainer(tmp_path, seeds=(4,), scores=(), agent=None, fail=None, fail_in_evaluation=None, **settings):
    settings = {"steps": 50, "learning_starts": 10, "batch_size": 4, "eval_every": 20} | settings
    settings = {"eval_episodes": 2, "final_episodes": 3} | settings
    config = Config(algo="Counter", env="Scripted", **settings) if agent is None else agent.config
    agent = agent or Counter(config, list(seeds), scores)
    writers = [
        RunWriter(tmp_path / "Scripted" / "Counter" / f"seed={seed}", {}, {}, config.eval_episodes) for seed in seeds
    ]
    trainer = Trainer(
        config,
        agent,
        [Scripted(fail) for _ in seeds],
        lambda: Scripted(fail_in_evaluation),
        step_together,
        writers,
        progress=False,
    )
    agent.trainer = trainer
    return trainer


def folder(trainer, i=0):
    return trainer.seeds[i].writer.folder


def saved_count(trainer, name, i=0):
    return float(torch.load(folder(trainer, i) / f"{name}.pt", weights_only=True)["net.count"])


def transitions(trainer, i=0):
    """obs, action, reward, terminated, next_obs, center, next_center of the seed in position i, in order."""
    replay = trainer.replay
    rows = replay.rows.view(len(trainer.seeds), replay.capacity, -1)[i, : replay.added[i]]
    return rows.split(replay.widths, -1)


# ---------------------------------------------------------------- evaluations and the best parameters


@pytest.mark.parametrize("steps, at", [(50, [20, 40, 50]), (40, [20, 40]), (15, [15])])
def test_evaluations_every_so_many_steps_and_at_the_end(tmp_path, steps, at):
    trainer = make_trainer(tmp_path, seeds=(4, 6), steps=steps)
    trainer.run()
    for i in range(2):
        evaluations = read_run(folder(trainer, i)).evaluations
        assert evaluations.step.tolist() == at and evaluations.returns.shape == (len(at), 2)


def scores_at(evaluations):
    """Scores by number of gradient steps: the given ones, and 0.9 at numbers without an evaluation."""
    return [evaluations.get(n, 0.9) for n in range(60)]


@pytest.mark.parametrize(
    "scores, best_step",
    [
        ((0.2, 0.4, 0.1), 40),
        ((0.4, 0.2, 0.1), 20),
        ((0.1, 0.2, 0.4), 50),
        ((-0.4, -0.3, -0.4), 40),
        ((0.4, 0.2, 0.4), 20),
    ],
)
def test_the_result_is_that_of_the_best_parameters(tmp_path, scores, best_step):
    # One gradient step after each of the steps 11, 12, ...: evaluations come after 9, 29 and 39 of them.
    counts = dict(zip((20, 40, 50), (9, 29, 39), strict=True))
    trainer = make_trainer(tmp_path, scores=scores_at(dict(zip(counts.values(), scores, strict=True))))
    (result,) = trainer.run()
    evaluations = read_run(folder(trainer)).evaluations
    # The first two episodes of an environment have 5 and 7 steps; here evaluation uses two environments.
    means = np.array([evaluations.returns[k] / scores[k] for k in range(3)])
    assert set(means.round(3).flatten()) <= {5.0, 7.0}
    assert evaluations.step[evaluations.return_mean.argmax()] == result["best_step"] == best_step
    assert saved_count(trainer, "best") == counts[best_step] and saved_count(trainer, "last") == 39
    best = max(scores)
    per_step = np.array(result["returns"]) / best
    assert len(result["returns"]) == 3 and set(per_step.round(3)) <= {5.0, 7.0}
    assert result["return_mean"] == pytest.approx(np.mean(result["returns"]))
    assert result["gradient_steps"] == 39 and result["steps"] == 50
    assert read_run(folder(trainer)).result["best_step"] == best_step


def test_every_seed_has_a_best_of_its_own(tmp_path):
    class PerSeed(Counter):
        def __init__(self, config, seeds):
            super().__init__(config, seeds)
            self.net.count.data[1] = 100.0  # where the second seed's number of gradient steps starts

        def policy(self, which):
            counts = self.net.count.detach().flatten().tolist()
            tables = [scores_at({9: 0.2, 29: 0.4, 39: 0.1}), scores_at({9: 0.3, 29: 0.1, 39: 0.2})]
            scores = [tables[i][int(counts[i]) - 100 * i] for i in which]
            return lambda obs: torch.tensor(scores).view(-1, 1, 1).expand(*obs.shape[:2], DIM)

    config = Config("Counter", "Scripted", steps=50, learning_starts=10, batch_size=4, eval_every=20, final_episodes=2)
    trainer = make_trainer(tmp_path, seeds=(4, 6), agent=PerSeed(config, [4, 6]))
    results = trainer.run()
    assert [result["best_step"] for result in results] == [40, 20]
    assert [saved_count(trainer, "best", i) for i in range(2)] == [29, 109]
    assert [saved_count(trainer, "last", i) for i in range(2)] == [39, 139]
    assert [result["return_mean"] for result in results] == pytest.approx([0.4 * 5, 0.3 * 5])  # an episode of 5 steps


def test_a_first_evaluation_that_is_nan_does_not_stay_best(tmp_path):
    trainer = make_trainer(tmp_path, scores=scores_at({9: float("nan"), 29: -0.4, 39: -0.5}))
    (result,) = trainer.run()
    assert result["best_step"] == 40 and saved_count(trainer, "best") == 29
    assert np.isfinite(result["return_mean"])


def test_a_later_evaluation_that_is_nan_is_not_best(tmp_path):
    trainer = make_trainer(tmp_path, scores=scores_at({9: -0.4, 29: float("nan"), 39: -0.5}))
    (result,) = trainer.run()
    assert result["best_step"] == 20 and saved_count(trainer, "best") == 9


# ---------------------------------------------------------------- rollouts and gradient steps


@pytest.mark.parametrize(
    "train_freq, gradient_steps, learning_starts, wanted",
    [
        (8, 8, 10, 5 * 8),  # after the steps 16, 24, 32, 40, 48
        (8, 8, 16, 4 * 8),  # a rollout that ends with the warm-up is still warm-up
        (8, 3, 10, 5 * 3),
        (8, -1, 10, 5 * 8),
        (1, 1, 10, 39),  # after the steps 11 to 49: the run ends with step 50
        (1, 2, 0, 49 * 2),
        ("episode", -1, 10, 7 + 5 + 7 + 5 + 7 + 5 + 7),  # episodes end at 5, 12, 17, 24, 29, 36, 41 and 48
        ("episode", -1, 12, 5 + 7 + 5 + 7 + 5 + 7),
        ("episode", 2, 10, 7 * 2),
        (1, 1, 50, 0),
    ],
)
def test_the_number_of_gradient_steps(tmp_path, train_freq, gradient_steps, learning_starts, wanted):
    trainer = make_trainer(
        tmp_path, train_freq=train_freq, gradient_steps=gradient_steps, learning_starts=learning_starts
    )
    (result,) = trainer.run()
    assert result["gradient_steps"] == saved_count(trainer, "last") == wanted


@pytest.mark.parametrize(
    "train_freq, starts", [(8, [0, 8, 16, 24, 32, 40, 48]), ("episode", [0, 5, 12, 17, 24, 29, 36, 41, 48])]
)
def test_the_agent_hears_of_every_rollout(tmp_path, train_freq, starts):
    trainer = make_trainer(tmp_path, seeds=(4, 6), train_freq=train_freq, gradient_steps=2)
    trainer.run()
    for i in range(2):
        assert [step for j, step in trainer.agent.rollouts if j == i] == starts


@pytest.mark.parametrize("train_freq", [1, 8, "episode"])
def test_the_agent_hears_of_every_episode_before_its_first_step(tmp_path, train_freq):
    trainer = make_trainer(tmp_path, seeds=(4, 6), train_freq=train_freq, gradient_steps=2)
    trainer.run()
    for i in range(2):  # only of training, warm-up included
        started = [(episode, t) for j, episode, t in trainer.agent.episodes if j == i]
        assert started == [(episode, 0) for episode in range(trainer.seeds[i].env.episode + 1)] and len(started) == 9


def test_warm_up_actions_then_exploration(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.run()
    executed = np.stack(trainer.seeds[0].env.executed)
    assert executed.shape == (50, DIM)
    stream = Streams([4], "explore")
    obs, center = (transitions(trainer)[k] for k in (0, 5))
    for step in range(10):
        wanted = CONSTRAINT.alpha_map(obs[step], stream.uniform(DIM)[0], center[step])
        np.testing.assert_allclose(executed[step], wanted.numpy(), atol=1e-6)
    np.testing.assert_allclose(executed[10:], 0.01, atol=1e-6)


# ---------------------------------------------------------------- what is stored


@pytest.mark.parametrize("train_freq", [1, "episode"])
def test_stored_transitions(tmp_path, train_freq):
    trainer = make_trainer(tmp_path, seeds=(4, 6), train_freq=train_freq)
    trainer.run()
    for i, env in enumerate(seed.env for seed in trainer.seeds):
        obs, action, reward, terminated, next_obs, center, next_center = transitions(trainer, i)
        assert len(obs) == 50
        wanted, t, episode = [], 0, 0
        for _ in range(50):
            over = t + 1 == LENGTHS[episode % 2]
            # A time limit is not stored as an end.
            wanted.append([t, episode, env.number, over and episode % 2 == 0, t + 1, episode, env.number])
            t, episode = (0, episode + 1) if over else (t + 1, episode)
        assert torch.equal(torch.cat([obs, terminated, next_obs], -1), torch.tensor(wanted).float())
        assert torch.equal(action, torch.from_numpy(np.stack(env.executed)))
        assert torch.equal(reward[:, 0], action[:, 0])
        # The centre of s' is that of the episode's last observation, not of the next episode's first one.
        torch.testing.assert_close(center, CONSTRAINT.center(obs), rtol=0, atol=1e-6)
        torch.testing.assert_close(next_center, CONSTRAINT.center(next_obs), rtol=0, atol=1e-6)
        assert not torch.equal(center[1:], next_center[:-1])


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_buffer_has_suggestions_where_the_environment_maps_and_executed_actions_elsewhere(tmp_path, name):
    algorithm = ALGORITHMS[name]
    config = algorithm.paper_config(name, "Scripted", "Hopper", steps=40)
    config.hidden, config.learning_starts, config.batch_size, config.eval_every = [8, 8], 20, 4, 40
    config.eval_episodes = config.final_episodes = 1
    if name.startswith("D") or name == "NFW":
        config.action_noise = 1.0
    if name == "ARAM":
        config.most_rejections = 1  # so that it projects what it rejects
    agent = algorithm.build(config, CONSTRAINT, OBS, [4])
    agent.map.use_untrained(CONSTRAINT, torch.zeros(1, OBS))
    trainer = make_trainer(tmp_path, agent=agent)
    trainer.run()
    obs, stored, *_ = transitions(trainer)
    executed = torch.from_numpy(np.stack(trainer.seeds[0].env.executed))
    assert CONSTRAINT.violation(obs, executed).max() <= 1e-6
    if name in ("DPre", "DPre+", "SPre", "SPre+", "ARAM"):
        for part in (slice(0, 20), slice(20, 40)):  # warm-up, training
            assert (CONSTRAINT.violation(obs[part], stored[part]) > 0.01).any()
        torch.testing.assert_close(CONSTRAINT.project(obs, stored), executed)
    else:
        assert torch.equal(stored, executed)


# ---------------------------------------------------------------- early ends


class BrokenError(Exception):
    pass


def test_an_exception_saves_the_parameters_and_closes_everything(tmp_path):
    def fail(env):
        if env.executed_actions == 30:
            raise BrokenError

    trainer = make_trainer(tmp_path, seeds=(4, 6), fail=fail)
    with pytest.raises(BrokenError):
        trainer.run()
    for i in range(2):
        assert saved_count(trainer, "last", i) == 20  # after the steps 11 to 30
        assert saved_count(trainer, "best", i) == 9
        assert not is_finished(folder(trainer, i)) and read_run(folder(trainer, i)).evaluations.step.tolist() == [20]
    assert all(seed.env.closed for seed in trainer.seeds)
    assert all(env.closed for i in range(2) for env in trainer.evaluator.of_seed(i))


def test_an_interrupt_during_the_final_evaluation_keeps_the_last_parameters(tmp_path):
    def fail(env):
        if env.episode > 3:  # three evaluations are episodes 1 to 3 of each environment
            raise KeyboardInterrupt

    scores = scores_at({9: 0.4, 29: 0.2, 39: 0.1})
    trainer = make_trainer(tmp_path, scores=scores, fail_in_evaluation=fail)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert read_run(folder(trainer)).evaluations.step.tolist() == [20, 40, 50]
    assert saved_count(trainer, "last") == 39 and saved_count(trainer, "best") == 9
    assert not is_finished(folder(trainer))


def test_a_failure_leaves_finished_seeds_as_they_are(tmp_path):
    def fail(env):
        if env is trainer.seeds[0].env and env.executed_actions == 41:
            raise BrokenError

    trainer = make_trainer(tmp_path, seeds=(4, 6), fail=fail, steps=42, train_freq="episode", gradient_steps=-1)
    # The second seed's first episode has 7 steps: its last one ends after the run, at 43, the first one's at 41.
    trainer.seeds[1].env.episode = 0
    with pytest.raises(BrokenError):
        trainer.run()
    assert not is_finished(folder(trainer, 0)) and saved_count(trainer, "last", 0) == 7 + 5 + 7 + 5 + 7 + 5
    assert is_finished(folder(trainer, 1)) and saved_count(trainer, "last", 1) == 5 + 7 + 5 + 7 + 5


def test_counts_of_the_result(tmp_path):
    (result,) = make_trainer(tmp_path, eval_episodes=2, final_episodes=2).run()
    # Three evaluations and the final one in two environments; each alternates episodes of 7 and 5 steps.
    assert result["executed_actions"] == 50 + 2 * (7 + 5 + 7 + 5)
    assert result["largest_violation"] == -1.0 and result["seeds_in_lockstep"] == 1


def test_one_folder_that_cannot_be_written_costs_only_its_own_parameters(tmp_path, capsys):
    def fail(env):
        if env.executed_actions == 30:
            raise BrokenError

    trainer = make_trainer(tmp_path, seeds=(4, 6, 8), fail=fail)
    save = trainer.seeds[1].writer.save_parameters

    def no_space_for_the_last(name, parameters):
        if name == "last":
            raise OSError(errno.ENOSPC, "No space left on device")
        save(name, parameters)

    trainer.seeds[1].writer.save_parameters = no_space_for_the_last
    with pytest.raises(BrokenError):
        trainer.run()
    assert "last parameters not saved" in capsys.readouterr().err
    assert [(folder(trainer, i) / "last.pt").exists() for i in range(3)] == [True, False, True]


def test_an_interrupt_while_the_best_parameters_are_in_place_keeps_the_last_ones(tmp_path):
    trainer = make_trainer(tmp_path, scores=scores_at({9: 0.4, 29: 0.2, 39: 0.1}))
    policy, calls = trainer.agent.policy, []

    def interrupted(which):
        calls.append(saved := trainer.agent.net.count.item())
        if len(calls) == 4:  # three evaluations, then the policy of the best parameters
            assert saved == 9
            raise KeyboardInterrupt
        return policy(which)

    trainer.agent.policy = interrupted
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert saved_count(trainer, "last") == 39 and saved_count(trainer, "best") == 9


def test_statistics_stand_beside_each_evaluation_after_the_first_gradient_step(tmp_path):
    class Measured(Counter):
        def statistics(self):
            assert (self.net.count > 0).all()  # not called before the first gradient step
            return {"count": self.net.count.detach()[:, 0], "double": 2 * self.net.count.detach()[:, 0]}

    config = Config("Counter", "Scripted", steps=50, learning_starts=25, batch_size=4, eval_every=20, eval_episodes=2)
    config.final_episodes = 2
    trainer = make_trainer(tmp_path, seeds=(4, 6), agent=Measured(config, [4, 6]))
    trainer.run()
    for i in range(2):
        # No gradient step by step 20; one after each of the steps 26, 27, ... but the last.
        table = (folder(trainer, i) / "training.csv").read_text()
        header, *rows = (line.split(",") for line in table.splitlines())
        assert header == ["step", "count", "double", "suggested_violation", "suggested_infeasible"]
        assert [row[:3] for row in rows] == [["40", "14.0", "28.0"], ["50", "24.0", "48.0"]]
        assert read_run(folder(trainer, i)).evaluations.step.tolist() == [20, 40, 50]


def test_an_algorithm_without_statistics_has_those_of_its_suggestions(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.run()
    assert list(read_run(folder(trainer)).training) == ["step", "suggested_violation", "suggested_infeasible"]


def test_a_checkpoint_restores_every_counter_and_the_agent(tmp_path):
    def stop():
        if trainer.seeds[0].steps == 30:
            raise Interrupted(15)

    trainer = make_trainer(tmp_path)
    trainer.stop_if_asked = stop
    with pytest.raises(Interrupted):
        trainer.run()
    (checkpoint,), _ = CheckpointFolder(folder(trainer)).read()
    again = make_trainer(tmp_path / "again")
    again.restore([checkpoint])
    before, after = trainer.seeds[0], again.seeds[0]
    assert after.steps == 30 and again.agent.net.count.item() == 20 - 1
    assert all(getattr(after, name) == getattr(before, name) for name in COUNTERS)
    assert after.best.mean == before.best.mean and after.best.step == 20 and not after.ended
    assert torch.equal(again.obs, trainer.obs) and torch.equal(again.center, trainer.center)
    assert torch.equal(again.replay.rows[: again.replay.added[0]], trainer.replay.rows[: trainer.replay.added[0]])
