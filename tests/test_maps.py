"""Maps as objects, refused combinations, settings; a user's own map and off-policy algorithm."""

import json
from dataclasses import dataclass

import pytest
import torch
from helpers import config_of, run_command

from algos import ALGORITHMS, PAPER, Algorithm, paper_settings, saved_config, setting_keys
from algos.aram import ARAM
from algos.nfwpo import NFWPO
from algos.sac import SAC
from algos.td3 import TD3
from constraints import WeightedPositivePart
from core.agent import Agent
from core.config import NOT_NEGATIVE, Config, keys_of, resolve, saved_settings, setting
from core.flow import Flow
from core.maps import Alpha, Gauge, Map, Project, Radial, Sample
from core.networks import MLP, Adam, frozen_copy, rows_of, soft_update
from core.replay import Batch, Replay
from core.words import ConfigError, split_names
from envs import TASKS
from plots.definitions import hyperparameter_table

DIM, OBS = 2, 3
CONSTRAINT = WeightedPositivePart(lambda obs: 2.0 * obs[..., :DIM] + 3.0, 0.8, DIM)  # its centre is not the origin
ALL_MAPS = (Project(), Alpha(), Radial(), Gauge(), Flow())


class Soft(Map):
    """A user's own map: a = c + v / (1 + L(v))."""

    def __call__(self, constraint, obs, suggested, center):
        center = constraint.center(obs) if center is None else center
        offset = suggested - center
        return center + offset / (1 + constraint.gauge(obs, offset, center)).unsqueeze(-1)

    def with_log_prob(self, constraint, obs, sample, center):
        center = constraint.center(obs) if center is None else center
        gauge = constraint.gauge(obs, sample.suggested - center, center)
        log_prob = sample.log_prob + (constraint.dim + 1) * torch.log1p(gauge)
        return self(constraint, obs, sample.suggested, center), log_prob


class Bare(Map):
    """A map without a density."""

    def __call__(self, constraint, obs, suggested, center):
        return constraint.radial_map(obs, suggested, center)


# ---------------------------------------------------------------- densities


def sac(map, **settings):
    """An agent of one seed whose actor is N((0.3, -0.5), diag(0.8, 0.5)^2) at every state."""
    algorithm = Algorithm(SAC, map, "layer")
    overrides = {"hidden": "[4,4]", "gsde": "false"} | settings
    config = resolve(algorithm.paper_config("mine", "W+M", "Others", steps=1), overrides)
    agent = algorithm.build(config, CONSTRAINT, OBS, [0])
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.zero_()
        agent.actor.net.layers[-1].bias[0, 0] = torch.tensor([0.3, -0.5, *torch.tensor([0.8, 0.5]).log().tolist()])
    return agent


@pytest.mark.parametrize("map", [Gauge(), Radial(), Soft()], ids=lambda map: type(map).__name__)
def test_the_density_of_mapped_actions_is_that_of_a_histogram(map):
    agent = sac(map)
    obs = torch.tensor([0.1, -0.4, 0.0]).expand(1, 400_000, OBS)
    with torch.no_grad():
        noise = torch.randn(1, obs.shape[1], DIM, generator=torch.Generator().manual_seed(0))
        action, log_prob, _ = agent.sample(obs, agent.centers(obs), noise)
    assert CONSTRAINT.violation(obs, action).max() <= 1e-6
    # E[1 / density] over the samples in a region is the region's area, whatever the distribution there.
    low, high = torch.tensor([-0.5, -0.4]), torch.tensor([0.05, 0.05])
    inside = ((action > low) & (action < high)).all(-1)
    assert CONSTRAINT.violation(obs[0, 0], torch.tensor([0.05, 0.05])) < 0  # the box lies in the set
    area = (inside * (-log_prob.double()).exp()).mean()
    assert area == pytest.approx(float((high - low).prod()), rel=0.02)


@pytest.mark.parametrize("map", [Gauge(), Radial(), Soft()], ids=lambda map: type(map).__name__)
def test_the_density_of_mapped_actions_follows_the_jacobian(map):
    agent = sac(map)
    obs = torch.randn(50, OBS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    raw = torch.randn(50, DIM, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    suggested = raw.tanh() if map.squashes else raw
    zero = torch.zeros(50, dtype=torch.float64)
    sample = Sample(suggested, torch.zeros_like(raw), torch.ones_like(raw), zero)
    centers = CONSTRAINT.center(obs)
    mapped, log_prob = agent.map.with_log_prob(CONSTRAINT, obs, sample, centers)
    torch.testing.assert_close(mapped, agent.map(CONSTRAINT, obs, suggested, centers))
    for i in range(50):
        jacobian = torch.autograd.functional.jacobian(
            lambda u, i=i: agent.map(CONSTRAINT, obs[i], u, centers[i]), suggested[i]
        )
        torch.testing.assert_close(log_prob[i], -torch.linalg.slogdet(jacobian)[1], rtol=1e-6, atol=1e-6)


def test_sgauge_adds_the_slope_of_the_tanh_and_stays_finite_far_out():
    agent = sac(Gauge())
    obs = torch.randn(1, 6, OBS, generator=torch.Generator().manual_seed(3))
    agent.actor.net.layers[-1].bias.data[..., :DIM] = 60.0  # tanh is 1 in float32
    action, log_prob, suggested = agent.sample(obs, agent.centers(obs), torch.zeros(1, 6, DIM))
    assert (suggested == 1).all() and log_prob.isfinite().all() and (log_prob > 50).all()
    assert CONSTRAINT.violation(obs, action).max() <= 1e-6
    (gradient,) = torch.autograd.grad(log_prob.sum(), agent.actor.net.layers[-1].bias)
    assert gradient.isfinite().all()
    agent.actor.net.layers[-1].bias.data[..., :DIM] = 0.0  # at u = 0 the map gives the centre
    action, log_prob, _ = agent.sample(obs, agent.centers(obs), torch.zeros(1, 6, DIM))
    torch.testing.assert_close(action, CONSTRAINT.center(obs))
    (gradient,) = torch.autograd.grad((action.sum() + log_prob.sum()), agent.actor.net.layers[-1].bias)
    assert gradient.isfinite().all() and agent.target_entropy == -DIM


def test_the_entropy_in_unit_ball_coordinates_is_a_setting_of_the_map():
    obs, noise = torch.randn(1, 5, OBS), torch.randn(1, 5, DIM)
    plain, ball = sac(Gauge()), sac(Gauge(), entropy="ball")
    action, log_prob, suggested = ball.sample(obs, ball.centers(obs), noise)
    assert plain.map == Gauge() and ball.map == Gauge(entropy="ball")
    ray = CONSTRAINT.ray(obs, suggested, ball.centers(obs))
    before, after = (agent.sample(obs, agent.centers(obs), noise) for agent in (plain, ball))
    difference = ray.gauge_log_prob(torch.zeros(1, 5), True) - ray.gauge_log_prob(torch.zeros(1, 5))
    torch.testing.assert_close(after[1] - before[1], difference)
    assert torch.equal(before[0], action)


# ---------------------------------------------------------------- which combinations there are


@pytest.mark.parametrize(
    "agent, map, placement, reason",
    [
        (SAC, Project(), "layer", "SAC needs the log-density of mapped actions, and Project has no with_log_prob"),
        (SAC, Project(), "rollout", "SAC is implemented for placement environment and layer, not rollout"),
        (SAC, Alpha(), "environment", "Alpha supports placement layer, not environment"),
        (SAC, Gauge(), "rollout", "SAC is implemented for placement environment and layer, not rollout"),
        (SAC, Bare(), "layer", "Bare has no with_log_prob"),
        (TD3, Alpha(), "rollout", "Alpha supports placement layer, not rollout"),
        (TD3, Gauge(), "environment", "Gauge supports placement layer, not environment"),
        (TD3, Project(), "wrapper", "unknown placement 'wrapper'"),
        (NFWPO, Project(), "layer", "NFWPO is implemented for placement rollout, not layer"),
        (NFWPO, Radial(), "rollout", "NFWPO is implemented for Project, not Radial"),
        (ARAM, Project(), "rollout", "ARAM is implemented for placement environment, not rollout"),
        (TD3, Bare, "layer", "map must be an object such as Bare(), got the class"),
        (TD3, "Alpha", "layer", "TD3 is implemented for Map, not str"),
    ],
)
def test_a_combination_that_is_not_implemented_is_refused_with_the_reason(agent, map, placement, reason):
    with pytest.raises(ValueError) as error:
        Algorithm(agent, map, placement)
    assert reason in str(error.value)


def test_a_penalty_that_the_actor_loss_does_not_use_is_refused():
    class Blind(DDPG):
        takes_penalty = False

    assert not Agent.takes_penalty
    for agent, placement in ((NFWPO, "rollout"), (Blind, "layer")):
        Algorithm(agent, Project(), placement)
        with pytest.raises(ValueError, match=f"^{agent.__name__} takes no penalty: its actor loss does not use it$"):
            Algorithm(agent, Project(), placement, penalty=True)


def test_an_agent_that_is_not_complete_is_refused_with_what_is_missing():
    class Half(Agent):
        def build(self, init):
            pass

    class Nameless(DDPG):
        paper = {"Reacher": {}}

    with pytest.raises(ValueError) as error:
        Algorithm(Half, Project(), "layer")
    missing = "explore, networks, optimizers, policy, update, family, paper"
    assert str(error.value) == f"Half is not complete: it does not define {missing}"
    with pytest.raises(ValueError, match="^Nameless.paper needs an entry 'Others'"):
        Algorithm(Nameless, Project(), "layer")


def test_what_is_accepted_is_what_the_table_has_and_no_more():
    accepted = set()
    for agent in (TD3, SAC, NFWPO, ARAM):
        for map in ALL_MAPS:
            for placement in ("environment", "rollout", "layer"):
                try:
                    Algorithm(agent, map, placement)
                except ValueError:
                    continue
                accepted.add((agent, type(map), placement))
    assert accepted == {(row.agent, type(row.map), row.placement) for row in ALGORITHMS.values()}


@pytest.mark.parametrize("map", ALL_MAPS, ids=lambda map: type(map).__name__)
def test_maps_stand_only_where_random_actions_and_suggestions_fit(map):
    """Pulling back twice changes nothing. A map that may stand elsewhere than in a layer pulls back by itself, and its
    suggestions are in the box."""
    obs = torch.randn(200, OBS, generator=torch.Generator().manual_seed(4))
    action = 2 * torch.rand(200, DIM, generator=torch.Generator().manual_seed(5)) - 1
    pulled_back = map.pull_back(CONSTRAINT, obs, action, None)
    torch.testing.assert_close(map.pull_back(CONSTRAINT, obs, pulled_back, None), pulled_back)
    if map.placements != ("layer",):
        assert map.squashes and torch.equal(map(CONSTRAINT, obs, action, None), pulled_back)


# ---------------------------------------------------------------- a user's own map and algorithm


@pytest.mark.parametrize("agent", [TD3, SAC])
def test_a_map_of_ones_own_is_one_class(agent, tmp_path, monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(agent, Soft(), "layer"))
    words = "algo=Mine env=W+M seed=0,1 steps=120 learning_starts=40 batch_size=8 hidden=[8,8] train_freq=1"
    words += " gradient_steps=1 eval_every=60 eval_episodes=1 final_episodes=1"
    assert run_command([*words.split(), f"results={tmp_path}"]) == 0
    results = [json.loads(path.read_text()) for path in tmp_path.glob("*/*/seed=*/result.json")]
    assert len(results) == 2 and all(result["gradient_steps"] == 79 for result in results)
    assert all(result["largest_violation"] <= 1e-6 for result in results)


def test_centres_are_computed_once_and_replayed(monkeypatch):
    """If the map needs centres, they are stored, and no gradient step computes one."""
    calls = []

    def center(self, obs):
        calls.append(obs.shape)
        return original(self, obs)

    original = WeightedPositivePart.center
    agent, steps = sac(Soft()), 5
    replay = Replay([0], steps, OBS, DIM, agent.stores_centers)
    monkeypatch.setattr(WeightedPositivePart, "center", center)
    obs = torch.randn(steps + 1, 1, OBS, generator=torch.Generator().manual_seed(0))
    now = agent.centers(obs[0])
    for t in range(steps):
        action = agent.act(obs[t], now, [], [0])
        then = agent.centers(obs[t + 1])
        zero = torch.zeros(1, 1)
        replay.add([0], Batch(obs[t], action.stored, zero, zero, obs[t + 1], now, then))
        now = then
        agent.update(batch := replay.sample(4))
    assert agent.stores_centers and calls == [(1, OBS)] * (steps + 1)  # one call for each observation
    torch.testing.assert_close(batch.center, original(CONSTRAINT, batch.obs))
    torch.testing.assert_close(batch.next_center, original(CONSTRAINT, batch.next_obs))
    assert not Algorithm(TD3, Project(), "layer").map.replays_center(CONSTRAINT)
    assert not Soft().replays_center(TASKS["HC+O"].constraint)  # its centre is the origin


def test_the_settings_of_a_map_are_keys_of_its_algorithms(monkeypatch):
    @dataclass
    class Scaled(Soft):
        scale: float = setting(1.0, "what it is multiplied with")

    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(TD3, Scaled(), "layer"))
    config = config_of(["algo=Mine", "env=R+M", "scale=0.5"])
    assert (config.scale, config_of("algo=Mine env=R+M").scale) == (0.5, 1.0) and "scale" in setting_keys()
    assert ALGORITHMS["Mine"].build(config, CONSTRAINT, OBS, [0]).map == Scaled(0.5)
    # TD3 does not have settings that only densities use.
    assert "entropy" not in keys_of(ALGORITHMS["DAlpha"].config_class)
    assert {"entropy", "boundary_weight"} <= keys_of(ALGORITHMS["SAlpha"].config_class).keys()


def test_a_setting_that_cannot_be_a_key_is_refused():
    @dataclass
    class Slow(Soft):
        tau: float = setting(0.7, "how slow")

    @dataclass
    class Dense(Soft):
        gsde: bool = setting(False, "not on the command line of TD3", of_density=True)

    @dataclass
    class Seeded(Soft):
        seed: int = setting(0, "its name is the key of another field")

    @dataclass
    class Weighted(Soft):
        penalty: float = setting(2.0, "only the names with + have this setting already")

    @dataclass
    class Plain(Soft):
        scale: float = 1.0

    @dataclass
    class PlainConfig(DDPGConfig):
        rate: float = 1.0

    class PlainDDPG(DDPG):
        config_class = PlainConfig

    Algorithm(TD3, Dense(), "layer")
    Algorithm(TD3, Weighted(), "layer")
    for agent, map, penalty, reason in (
        (TD3, Slow(), False, "Slow.tau has the same name as a setting of TD3"),
        (SAC, Dense(), False, "Dense.gsde has the same name as a setting of SAC"),
        (TD3, Seeded(), False, "Seeded.seed has the same name as a setting of TD3"),
        (TD3, Weighted(), True, "Weighted.penalty has the same name as a setting of TD3"),
        (TD3, Plain(), False, "Plain.scale must be made with core.config.setting"),
        (PlainDDPG, Soft(), False, "PlainConfig.rate must be made with core.config.setting"),
    ):
        with pytest.raises(ValueError) as error:
            Algorithm(agent, map, "layer", penalty)
        assert str(error.value) == reason


# ---------------------------------------------------------------- settings


def test_names_of_the_paper_and_all():
    groups = {"paper": PAPER}
    assert split_names("algorithm", "paper", ALGORITHMS, groups) == list(PAPER)
    assert split_names("algorithm", "all", ALGORITHMS, groups) == list(ALGORITHMS)
    assert split_names("algorithm", "DGauge,paper,DPre", ALGORITHMS, groups) == ["DGauge", *PAPER]
    with pytest.raises(ConfigError, match="did you mean paper"):
        split_names("algorithm", "papr", ALGORITHMS, groups)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_saved_settings_come_back(name):
    task = TASKS["R+M"]
    base = paper_settings(name, "R+M", task.robot, task.steps)
    config = resolve(base, {"seed": "3,5-7", "train_freq": "20", "hidden": "[8,4]"})
    saved = saved_settings(config, 5)
    assert saved["seed"] == "5" and saved["train_freq"] == "20" and "results" not in saved
    config.seeds = (5,)
    assert saved_config(saved) == config
    # Older run folders have keys with None for settings that the algorithm does not have.
    assert saved_config({"fw_learning_rate": None, "gsde": None, "penalty": None} | saved) == config


@dataclass
class DDPGConfig(Config):
    noise: float = setting(0.1, "DDPG: std of exploration noise", NOT_NEGATIVE)


class DDPG(Agent):
    """Lillicrap et al. (2016), written from `core.agent.Agent` alone."""

    config: DDPGConfig
    config_class = DDPGConfig
    family = "DDPG"
    paper = {"Others": {"gamma": 0.98, "tau": 0.05}}
    placements = ("layer",)
    takes_penalty = True

    def build(self, init):
        self.actor = MLP([self.obs_dim, *self.config.hidden, self.action_dim], init).to(self.device)
        self.critic = MLP([self.obs_dim + self.action_dim, *self.config.hidden, 1], init).to(self.device)
        self.actor_target, self.critic_target = frozen_copy(self.actor), frozen_copy(self.critic)
        self.steps = {
            name: Adam(module.parameters(), self.config.learning_rate)
            for name, module in (("actor", self.actor), ("critic", self.critic))
        }

    def networks(self):
        names = ("actor", "critic", "actor_target", "critic_target")
        return {name: getattr(self, name) for name in names}

    def optimizers(self):
        return self.steps

    @torch.no_grad()
    def explore(self, obs, which):
        noise = self.config.noise * self.exploration.normal(self.action_dim, which=which)
        return self.squash(self.actor(obs.unsqueeze(1))).squeeze(1) + noise

    def policy(self, which):
        actor = rows_of(self.actor, which)
        return lambda obs: self.feasible(obs, self.squash(actor(obs)), None)

    def q(self, critic, obs, action):
        return critic(torch.cat([obs, action], -1)).squeeze(-1)

    def update(self, batch):
        with torch.no_grad():
            suggested = self.squash(self.actor_target(batch.next_obs))
            next_action = self.feasible(batch.next_obs, suggested, batch.next_center)
            next_q = self.q(self.critic_target, batch.next_obs, next_action)
            target = batch.reward + self.config.gamma * (1 - batch.terminated) * next_q
        self.descend("critic", (self.q(self.critic, batch.obs, batch.action) - target).square().mean(-1))
        suggested = self.squash(self.actor(batch.obs))
        action = self.feasible(batch.obs, suggested, batch.center)
        self.descend("actor", (self.penalty(batch.obs, suggested) - self.q(self.critic, batch.obs, action)).mean(-1))
        soft_update(self.actor_target, self.actor, self.config.tau)
        soft_update(self.critic_target, self.critic, self.config.tau)


@pytest.mark.parametrize("map", [Project(), Alpha(), Radial(), Gauge(), Soft()], ids=lambda map: type(map).__name__)
def test_an_off_policy_algorithm_of_ones_own_is_one_class_and_one_row(map, tmp_path, monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(DDPG, map, "layer", penalty=True))
    words = "algo=Mine env=W+M seed=0,1 steps=100 learning_starts=40 batch_size=8 hidden=[8,8] noise=0.2 penalty=2"
    assert config_of(words).gamma == 0.98
    assert run_command([*words.split(), "eval_episodes=1", "final_episodes=1", f"results={tmp_path}"]) == 0
    results = [json.loads(path.read_text()) for path in tmp_path.glob("*/*/seed=*/result.json")]
    assert len(results) == 2 and all(result["gradient_steps"] == 59 for result in results)
    assert all(result["largest_violation"] <= 1e-6 for result in results)
    # The algorithm has its own column in the table of hyperparameters.
    assert ("Others", "DDPG") in {(r["robot"], r["base"]) for r in hyperparameter_table().records}
