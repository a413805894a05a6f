"""`algos.check_algorithm`: every algorithm passes, and a message names each broken contract and its remedy."""

import time

import numpy as np
import pytest
import torch
from torch import nn

import algos
from algos import ALGORITHMS, Algorithm
from algos.check import ContractError
from algos.td3 import TD3
from core.maps import Alpha, Project
from core.words import ConfigError


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_name_keeps_the_contracts(name):
    started = time.process_time()
    algos.check_algorithm(name)
    assert time.process_time() - started < 10


def test_an_unknown_name():
    with pytest.raises(ConfigError, match="unknown algorithm 'DPri'; did you mean DPr"):
        algos.check_algorithm("DPri")


class OrnsteinUhlenbeck(TD3):
    """TD3 with noise that is correlated within an episode: it needs a memory that is reset when an episode starts."""

    def build(self, init):
        super().build(init)
        self.noise = torch.zeros(len(self.seeds), self.action_dim)

    def memory(self):
        return super().memory() | {"noise": self.noise}

    def start_episode(self, which):
        fresh = self.exploration.normal(self.action_dim, which=which)
        for i in which:
            self.noise[i] = fresh[i]

    @torch.no_grad()
    def explore(self, obs, which):
        fresh = self.exploration.normal(self.action_dim, which=which)
        for i in which:  # the other rows do not change
            self.noise[i] = 0.85 * self.noise[i] + 0.3 * fresh[i]
        return self.suggest(self.actor, obs.unsqueeze(1)).squeeze(1) + self.noise


class DrawsOutside(TD3):
    def target_action(self, batch):
        return super().target_action(batch) + 0.0 * torch.randn_like(batch.action)


class DrawsFromNumPy(TD3):
    def explore(self, obs, which):
        return super().explore(obs, which) + float(np.random.rand())


class SharedLayer(TD3):
    def build(self, init):
        super().build(init)
        self.actor.extra = nn.Linear(2, 2)


class DrawsWeightsOutside(TD3):
    def build(self, init):
        super().build(init)
        with torch.random.fork_rng():
            self.actor.layers[0].weight.data.uniform_()


class ForgetsAnOptimizer(TD3):
    def optimizers(self):
        return {"critic": self.critic_optimizer}


class ForgetsANetwork(TD3):
    def networks(self):
        return {"critic": self.critic, "critic_target": self.critic_target, "actor_target": self.actor_target}


class ForgetsATarget(TD3):
    def networks(self):
        return {"critic": self.critic, "actor": self.actor, "actor_target": self.actor_target}


class ForgetsItsMemory(OrnsteinUhlenbeck):
    def memory(self):
        return TD3.memory(self)


class CopiesItsMemory(OrnsteinUhlenbeck):
    def memory(self):
        return {name: tensor.clone() for name, tensor in super().memory().items()}


class DrawsForAll(TD3):
    def explore(self, obs, which):
        return super().explore(obs, range(len(self.seeds)))


class ExploresInDoublePrecision(TD3):
    def explore(self, obs, which):
        return super().explore(obs, which).double()


class RemembersForAll(OrnsteinUhlenbeck):
    def explore(self, obs, which):
        suggested = super().explore(obs, which)
        self.noise.mul_(0.9)
        return suggested


class ForgetsTheMap(TD3):
    def policy(self, which):
        policy = super().policy(which)
        return lambda obs: policy(obs) * 3


class SharesAMean(TD3):
    def bootstrap(self, batch):
        return super().bootstrap(batch) - batch.reward.mean()


class RemembersEarlierTrainings(TD3):
    steps = 0

    def update(self, batch):
        RemembersEarlierTrainings.steps += 1
        super().update(batch._replace(reward=batch.reward + 0.01 * RemembersEarlierTrainings.steps))


class LivePolicy(TD3):
    def policy(self, which):
        def act(obs):
            everyone = obs.new_zeros(len(self.seeds), *obs.shape[1:])
            everyone[which] = obs
            return self.feasible(obs, self.suggest(self.actor, everyone)[which].detach(), None)

        return act


class NoisyPolicy(TD3):
    def policy(self, which):
        policy = super().policy(which)

        def act(obs):
            self.exploration.normal(2)
            return policy(obs)

        return act


class CountsNoUpdates(TD3):
    def update(self, batch):
        super().update(batch)
        self.updates -= 1


class LosesLosses(TD3):
    def descend(self, name, losses):
        super().descend(name, losses)
        self.losses.pop("actor", None)


class ChangesItsMeasures(TD3):
    def statistics(self):
        return {name: losses.mean(0).expand(len(self.seeds)) for name, losses in self.losses.items()}


class MeasuresWithoutMemory(TD3):
    def statistics(self):
        return {"loss": self.losses["critic"].mean(0)}


class MeasuresOfAnotherShape(TD3):
    def statistics(self):
        return {"loss": self.losses["critic"]}


BROKEN = {
    DrawsOutside: "draws random numbers from PyTorch's global generator in training, .* self.update_noise",
    DrawsFromNumPy: "draws random numbers from NumPy's global generator",
    SharedLayer: r"parameter actor.extra.weight has shape \(2, 2\) for one seed and \(2, 2\) for 3, .*networks.MLP",
    DrawsWeightsOutside: r"initial values of actor.layers.0.weight .* generator init\[i\]",
    ForgetsAnOptimizer: "no optimiser in optimizers.. trains parameter actor.layers.0.weight",
    ForgetsANetwork: "parameter 0 of the optimiser 'actor' is not in networks",
    ForgetsATarget: "the module self.critic_target is not in networks",
    ForgetsItsMemory: r"interrupted and resumed differs .* first in transitions .* memory\(\)",
    CopiesItsMemory: r"memory\(\)\['.*'\] is a copy",
    ExploresInDoublePrecision: r"explore\(\) returns torch.float64, expected torch.float32",
    DrawsForAll: "draws from the stream of position 1; pass which=which to the streams",
    RemembersForAll: r"changes memory\(\)\['noise'\] of position 1; .* only the rows `which`",
    ForgetsTheMap: "violates the constraint by .* the map",
    SharesAMean: "seed 5 learns something different alone than among others",
    RemembersEarlierTrainings: "two trainings of the same seeds differ, first in ",
    LivePolicy: "its own copy of the parameters, as core.networks.rows_of",
    NoisyPolicy: "a policy draws random numbers",
    CountsNoUpdates: "does not add 1 to self.updates",
    LosesLosses: r"never calls self.descend\('actor', losses\)",
    ChangesItsMeasures: r"statistics\(\) returns the names \['critic', 'actor'\] now and \['critic'\] before",
    MeasuresWithoutMemory: r"interrupted and resumed fails, .*KeyError\('critic'\).* memory\(\)",
    MeasuresOfAnotherShape: r"statistics\(\)\['loss'\] has shape \(2, 3\), expected \(seeds,\)",
}


@pytest.mark.parametrize("agent", BROKEN, ids=lambda agent: agent.__name__)
def test_a_broken_contract_is_named_with_its_remedy(monkeypatch, agent):
    monkeypatch.setattr(agent, "paper", {"Others": TD3.paper["Others"] | {"train_freq": 1, "gradient_steps": 1}})
    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(agent, Project(), "rollout"))
    before = torch.get_rng_state()
    with pytest.raises(ContractError, match=f"(?s)^Mine: .*{BROKEN[agent]}"):
        algos.check_algorithm("Mine")
    torch.set_rng_state(before)


def test_noise_that_starts_with_an_episode_keeps_the_contracts(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(OrnsteinUhlenbeck, Alpha(), "layer"))
    algos.check_algorithm("Mine")


def test_a_setting_of_each_group_of_robots_is_checked(monkeypatch):
    class OnReacher(TD3):
        paper = {"Others": TD3.paper["Others"], "Reacher": TD3.paper["Reacher"] | {"policy_delay": 1}}

        def explore(self, obs, which):
            return super().explore(obs, range(len(self.seeds)) if self.config.policy_delay == 1 else which)

    monkeypatch.setitem(ALGORITHMS, "Mine", Algorithm(OnReacher, Project(), "rollout"))
    with pytest.raises(ContractError, match="stream of position 1"):
        algos.check_algorithm("Mine")
    monkeypatch.setattr(OnReacher, "paper", {"Others": TD3.paper["Others"]})
    algos.check_algorithm("Mine")
