"""TD3 under action constraints: DPro, DPre, DOpt, DAlpha, DRad, DGauge, DFlow and their + variants.

Fujimoto et al. (2018) with a feasibility map P_s between the actor mu and the critics (paper, Sections "Algorithms
Based on the Closest Point Projection" and "Other Mapping Techniques"). The names differ only in the map, its placement
(`core.agent.Agent`) and whether the actor's loss includes the penalty for infeasible suggestions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from core.agent import Agent
from core.captured import Captured
from core.config import AT_LEAST_ONE, NOT_NEGATIVE, Config, setting
from core.networks import MLP, Adam, TwinCritic, frozen_copy, rows_of, soft_update
from core.replay import Batch

MEASURES = ("critic_loss", "actor_loss", "mean_q")
"""Columns of training.csv. The critics' loss and value are means over both critics and the batch. The value is taken at
the actions of the batch."""


@dataclass
class TD3Config(Config):
    """TD3's own settings. All but the first are constants that the paper takes from Fujimoto et al."""

    action_noise: float = setting(0.1, "TD3, NFW: std of exploration noise", NOT_NEGATIVE)
    policy_delay: int = setting(2, "TD3, NFW: critic steps per actor step", AT_LEAST_ONE)
    target_noise: float = setting(0.2, "TD3, NFW: std of the noise on target actions", NOT_NEGATIVE)
    target_noise_clip: float = setting(0.5, "TD3, NFW: bound of the noise on target actions", NOT_NEGATIVE)


class TD3(Agent):
    """Twin delayed DDPG for all seeds at once; tensors are (seeds, batch, features)."""

    config: TD3Config
    config_class = TD3Config
    family = "TD3"
    takes_penalty = True
    paper = {
        "Reacher": {
            "gamma": 0.98, "hidden": [400, 300], "batch_size": 100, "learning_rate": 1e-3,
            "buffer_size": 200_000, "tau": 0.005, "action_noise": 0.1,
            "learning_starts": 100_000, "train_freq": "episode", "gradient_steps": -1,
        },
        "Hopper": {
            "gamma": 0.99, "hidden": [400, 300], "batch_size": 256, "learning_rate": 3e-4,
            "buffer_size": 1_000_000, "tau": 0.005, "action_noise": 0.1,
            "learning_starts": 100_000, "train_freq": 1, "gradient_steps": 1,
        },
        "Others": {
            "gamma": 0.99, "hidden": [400, 300], "batch_size": 100, "learning_rate": 1e-3,
            "buffer_size": 1_000_000, "tau": 0.005, "action_noise": 0.1,
            "learning_starts": 100_000, "train_freq": "episode", "gradient_steps": -1,
        },
    }  # fmt: skip

    def build(self, init: Sequence[torch.Generator]) -> None:
        hidden, learning_rate = self.config.hidden, self.config.learning_rate
        self.actor = MLP([self.obs_dim, *hidden, self.action_dim], init).to(self.device)
        self.critic = TwinCritic(self.obs_dim, self.action_dim, hidden, init).to(self.device)
        self.actor_target, self.critic_target = frozen_copy(self.actor), frozen_copy(self.critic)
        self.actor_optimizer = Adam(self.actor.parameters(), learning_rate)
        self.critic_optimizer = Adam(self.critic.parameters(), learning_rate)
        # Measures of the last step of each kind, one value per seed.
        self.measures = {name: torch.zeros(len(self.seeds), device=self.device) for name in MEASURES}

    def networks(self) -> dict[str, nn.Module]:
        return {
            "actor": self.actor,
            "critic": self.critic,
            "actor_target": self.actor_target,
            "critic_target": self.critic_target,
        }

    def optimizers(self) -> dict[str, Optimizer]:
        return {"actor": self.actor_optimizer, "critic": self.critic_optimizer}

    def memory(self) -> dict[str, Tensor]:
        return self.measures

    def statistics(self) -> dict[str, Tensor]:
        return self.measures

    @property
    def cycle(self) -> int:
        return self.config.policy_delay

    def suggest(self, actor: MLP, obs: Tensor) -> Tensor:
        """mu(s): the action before the map."""
        return self.squash(actor(obs))

    def explore(self, obs: Tensor, which: Sequence[int]) -> Tensor:
        return self.explored(obs, self.exploration.normal(self.action_dim, which=which))

    @cached_property
    def explored(self) -> Captured:
        """`noisy_suggestion`, as a CUDA graph on a GPU."""
        return Captured(self.noisy_suggestion, self.device)

    def noisy_suggestion(self, obs: Tensor, noise: Tensor) -> Tensor:
        """mu(s) plus exploration noise, for obs (seeds, n) and standard normal `noise` (seeds, d)."""
        noise = self.config.action_noise * noise
        return self.suggest(self.actor, obs.unsqueeze(1)).squeeze(1) + noise

    def policy(self, which: Sequence[int]) -> Callable[[Tensor], Tensor]:
        actor = rows_of(self.actor, which)

        @torch.no_grad()
        def act(obs: Tensor) -> Tensor:
            return self.feasible(obs, self.suggest(actor, obs), None)

        return act

    def update(self, batch: Batch) -> None:
        """A step of both critics and, every `policy_delay` steps, of the actor and the targets."""
        q_target = self.bootstrap(batch)
        q = self.critic(batch.obs, batch.action)
        self.descend("critic", losses := (q - q_target).square().mean(-1))
        self.measures["critic_loss"].copy_(losses.detach().mean(0))
        self.measures["mean_q"].copy_(q.detach().mean((0, 2)))

        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self.descend("actor", loss := self.actor_loss(batch))
            self.measures["actor_loss"].copy_(loss.detach())
            soft_update(self.actor_target, self.actor, self.config.tau)
            soft_update(self.critic_target, self.critic, self.config.tau)

    @torch.no_grad()
    def bootstrap(self, batch: Batch) -> Tensor:
        """r + gamma min_j Q'_j(s', a'), a' the smoothed target action: (seeds, batch)."""
        next_action = self.target_action(batch)
        next_q = self.critic_target(batch.next_obs, next_action).amin(0)
        return batch.reward + self.config.gamma * (1 - batch.terminated) * next_q

    def target_action(self, batch: Batch) -> Tensor:
        """The target actor's action, as the critic sees it, with clipped noise, put back by `Map.limit_target`."""
        action = self.suggest(self.actor_target, batch.next_obs)
        if self.placement != "environment":
            action = self.feasible(batch.next_obs, action, batch.next_center)
        noise = self.update_noise.normal(*action.shape[1:]) * self.config.target_noise
        action = action + noise.clamp(-self.config.target_noise_clip, self.config.target_noise_clip)
        return self.map.limit_target(self.constraint, batch.next_obs, action, batch.next_center)

    def actor_loss(self, batch: Batch) -> Tensor:
        """-Q_1 at the actor's action plus the penalty, mean over the batch: (seeds,)."""
        suggested = self.suggest(self.actor, batch.obs)
        action = suggested
        if self.placement == "layer":
            action = self.feasible(batch.obs, suggested, batch.center)
        q = self.critic.first(batch.obs, action)
        return (self.penalty(batch.obs, suggested) - q).mean(-1)
