"""SAC under action constraints: SPre, SPre+, SAlpha, SRad, SGauge and SFlow.

Haarnoja et al. (2018) with a learned temperature and a feasibility map (paper, Section "Incorporating Action
Constraints to SAC"). The actor's Gaussian is squashed by tanh if the map demands it. The critic sees the result (SPre,
whose environment projects) or the mapped action, with the map's log-density (`core.maps`). On Reacher the exploration
noise is state-dependent (gSDE, Raffin et al. 2022).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus
from torch.optim import Optimizer

from core.agent import Agent
from core.captured import Captured
from core.config import Config, setting
from core.maps import Sample
from core.networks import MLP, Adam, TwinCritic, frozen_copy, rows_of, soft_update
from core.replay import Batch

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


@dataclass
class SACConfig(Config):
    """SAC's own setting."""

    gsde: bool = setting(False, "SAC: state-dependent exploration")


def normal_log_prob(residual: Tensor, log_std: Tensor) -> Tensor:
    """Log-density (...) of independent normals (..., d), `residual` standard deviations from their means."""
    constant = 0.5 * math.log(2 * math.pi) * log_std.shape[-1]
    return -(log_std + 0.5 * residual.square()).sum(-1) - constant


def squashed(sample: Sample) -> Sample:
    """The sample after a tanh."""
    raw = sample.suggested
    # log tanh' = 2 (log 2 - raw - softplus(-2 raw)), accurate for every raw.
    log_slope = -2 * (raw + softplus(-2 * raw)).sum(-1) + 2 * math.log(2) * raw.shape[-1]
    return sample._replace(suggested=raw.tanh(), log_prob=sample.log_prob - log_slope)


class GaussianActor(nn.Module):
    """One network gives mean and standard deviation. The noise is independent at every step."""

    def __init__(self, obs_dim: int, action_dim: int, hidden: Sequence[int], generators: Sequence[torch.Generator]):
        super().__init__()
        self.net = MLP([obs_dim, *hidden, 2 * action_dim], generators)
        self.noise_shape = (action_dim,)

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log of the standard deviation (seeds, batch, d) of the action before any map."""
        mean, log_std = self.net(obs).chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def sample(self, obs: Tensor, noise: Tensor) -> Sample:
        """A reparametrised sample, before any tanh; `noise` is standard normal (seeds, batch, d)."""
        mean, log_std = self(obs)
        std = log_std.exp()
        return Sample(mean + std * noise, mean, std, normal_log_prob(noise, log_std))


class StateDependentActor(nn.Module):
    """gSDE: noise is latent . theta, so that it varies smoothly with the state while theta stays the same.

    theta (latent, d) is normal with standard deviation exp(log_std), hence the noise of one state is normal with
    variance latent^2 . std^2. The latent features are the last hidden layer. The noise's gradient trains them too.
    """

    MEAN_BOUND = 2.0
    LOG_STD_INIT = -3.0
    VARIANCE_FLOOR = 1e-6  # all latent features of a state may be zero; the density must not be infinite there

    def __init__(self, obs_dim: int, action_dim: int, hidden: Sequence[int], generators: Sequence[torch.Generator]):
        super().__init__()
        self.features = MLP([obs_dim, *hidden], generators)
        self.mean = MLP([hidden[-1], action_dim], generators)
        self.log_std = nn.Parameter(torch.full((len(generators), hidden[-1], action_dim), self.LOG_STD_INIT))
        self.noise_shape = (hidden[-1], action_dim)

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (seeds, batch, d) of the action before any map, and the latent features (seeds, batch, latent)."""
        latent = self.features(obs).relu()
        return self.mean(latent).clamp(-self.MEAN_BOUND, self.MEAN_BOUND), latent

    def sample(self, obs: Tensor, noise: Tensor) -> Sample:
        """A reparametrised sample, before any tanh; `noise` is standard normal (seeds, latent, d)."""
        mean, latent = self(obs)
        theta_std = self.log_std.exp()
        std = (latent.square() @ theta_std.square() + self.VARIANCE_FLOOR).sqrt()
        deviation = latent @ (theta_std * noise)
        return Sample(mean + deviation, mean, std, normal_log_prob(deviation / std, std.log()))


class SAC(Agent):
    """Soft actor-critic for all seeds at once; tensors are (seeds, batch, features)."""

    config: SACConfig
    config_class = SACConfig
    family = "SAC"
    placements = ("environment", "layer")
    needs_log_prob = True
    takes_penalty = True
    paper = {
        "Reacher": {
            "gamma": 0.98, "hidden": [400, 300], "batch_size": 256, "learning_rate": 7.3e-4,
            "buffer_size": 300_000, "tau": 0.02, "gsde": True,
            "learning_starts": 100_000, "train_freq": 8, "gradient_steps": 8,
        },
        "Hopper": {
            "gamma": 0.99, "hidden": [256, 256], "batch_size": 256, "learning_rate": 3e-4,
            "buffer_size": 1_000_000, "tau": 0.005, "gsde": False,
            "learning_starts": 100_000, "train_freq": 1, "gradient_steps": 1,
        },
        "Others": {
            "gamma": 0.99, "hidden": [256, 256], "batch_size": 256, "learning_rate": 3e-4,
            "buffer_size": 1_000_000, "tau": 0.005, "gsde": False,
            "learning_starts": 100_000, "train_freq": 1, "gradient_steps": 1,
        },
    }  # fmt: skip

    def build(self, init: Sequence[torch.Generator]) -> None:
        config, seeds = self.config, len(self.seeds)
        actor_class = StateDependentActor if config.gsde else GaussianActor
        self.actor = actor_class(self.obs_dim, self.action_dim, config.hidden, init).to(self.device)
        self.critic = TwinCritic(self.obs_dim, self.action_dim, config.hidden, init).to(self.device)
        self.critic_target = frozen_copy(self.critic)
        self.temperature = Temperature(seeds).to(self.device)
        self.actor_optimizer = Adam(self.actor.parameters(), config.learning_rate)
        self.critic_optimizer = Adam(self.critic.parameters(), config.learning_rate)
        self.temperature_optimizer = Adam(self.temperature.parameters(), config.learning_rate)
        self.target_entropy = -float(self.action_dim)
        self.rollout_noise = torch.zeros(seeds, *self.actor.noise_shape, device=self.device)
        self.entropy = torch.zeros(seeds, 1, device=self.device)  # of the policy at the last batch's states
        self.last_losses = {name: torch.zeros(seeds, device=self.device) for name in ("critic_loss", "actor_loss")}

    def networks(self) -> dict[str, nn.Module]:
        return {
            "actor": self.actor,
            "critic": self.critic,
            "critic_target": self.critic_target,
            "temperature": self.temperature,
        }

    def optimizers(self) -> dict[str, Optimizer]:
        return {
            "actor": self.actor_optimizer,
            "critic": self.critic_optimizer,
            "temperature": self.temperature_optimizer,
        }

    def memory(self) -> dict[str, Tensor]:
        return {"rollout_noise": self.rollout_noise, "entropy": self.entropy, **self.last_losses}

    def start_rollout(self, which: Sequence[int]) -> None:
        """With gSDE, draw one theta for the whole rollout."""
        if self.config.gsde:
            fresh = self.exploration.normal(*self.actor.noise_shape, which=which)
            for i in which:
                self.rollout_noise[i] = fresh[i]

    def explore(self, obs: Tensor, which: Sequence[int]) -> Tensor:
        if self.config.gsde:
            noise = self.rollout_noise
        else:
            noise = self.exploration.normal(*self.actor.noise_shape, which=which).unsqueeze(1)
        return self.explored(obs, noise)

    @cached_property
    def explored(self) -> Captured:
        """`noisy_suggestion`, as a CUDA graph on a GPU."""
        return Captured(self.noisy_suggestion, self.device)

    def noisy_suggestion(self, obs: Tensor, noise: Tensor) -> Tensor:
        """A sample of the policy at obs (seeds, n), before the map; `noise` as in the actor's `sample`."""
        return self.squash(self.actor.sample(obs.unsqueeze(1), noise).suggested.squeeze(1))

    def policy(self, which: Sequence[int]) -> Callable[[Tensor], Tensor]:
        actor = rows_of(self.actor, which)

        @torch.no_grad()
        def act(obs: Tensor) -> Tensor:
            mean, _ = actor(obs)
            return self.feasible(obs, self.squash(mean), None)

        return act

    def sample(self, obs: Tensor, center: Tensor | None, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """An action as the critic sees it, its log-density (seeds, batch), and the suggestion before the map."""
        sample = self.actor.sample(obs, noise)
        if self.map.squashes:
            sample = squashed(sample)
        if self.placement == "environment":
            return sample.suggested, sample.log_prob, sample.suggested
        action, log_prob = self.map.with_log_prob(self.constraint, obs, sample, center)
        return action, log_prob, sample.suggested

    def update(self, batch: Batch) -> None:
        """One step of temperature, critics and actor, in this order."""
        noise, next_noise = self.draw_noise(batch)
        action, log_prob, suggested = self.sample(batch.obs, batch.center, noise)

        alpha = self.temperature.log_alpha.detach().exp()
        self.entropy.copy_(-log_prob.detach().mean(-1, keepdim=True))
        surplus = self.target_entropy - self.entropy
        self.descend("temperature", -(self.temperature.log_alpha * surplus)[:, 0])

        with torch.no_grad():
            next_action, next_log_prob, _ = self.sample(batch.next_obs, batch.next_center, next_noise)
            next_value = self.critic_target(batch.next_obs, next_action).amin(0) - alpha * next_log_prob
            q_target = batch.reward + self.config.gamma * (1 - batch.terminated) * next_value
        q = self.critic(batch.obs, batch.action)
        self.descend("critic", losses := 0.5 * (q - q_target).square().mean(-1))
        self.last_losses["critic_loss"].copy_(losses.detach().mean(0))

        value = torch.minimum(*self.critic(batch.obs, action)) - alpha * log_prob
        self.descend("actor", loss := (self.penalty(batch.obs, suggested) - value).mean(-1))
        self.last_losses["actor_loss"].copy_(loss.detach())
        soft_update(self.critic_target, self.critic, self.config.tau)

    def statistics(self) -> dict[str, Tensor]:
        temperature = self.temperature.log_alpha.detach().exp()[:, 0]
        return {"temperature": temperature, "entropy": self.entropy[:, 0], **self.last_losses}

    def draw_noise(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Draw the noise of the samples at s and at s'. With gSDE, one theta serves both for the whole batch."""
        if self.config.gsde:
            theta = self.update_noise.normal(*self.actor.noise_shape)
            return theta, theta
        noise = self.update_noise.normal(2, *batch.action.shape[1:])
        return noise[:, 0], noise[:, 1]


class Temperature(nn.Module):
    """The entropy coefficient alpha of every seed, learned as log_alpha (seeds, 1). It starts at alpha = 1."""

    def __init__(self, seeds: int):
        super().__init__()
        self.log_alpha = nn.Parameter(torch.zeros(seeds, 1))
