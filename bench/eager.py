"""TD3 and SAC for one seed, written as in most programs: eager PyTorch, one operation after the other.

The steps follow CleanRL's `td3_continuous_action.py` and `sac_continuous_action.py`: modules of `torch.nn`,
`torch.optim.Adam`, a loop over parameters for the targets, and batches that NumPy gathers on the CPU. SAC's actor
learns in every step, as ours does.
"""

from __future__ import annotations

import copy
import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from core.config import Config

TRANSITIONS = 1_000
"""Number of transitions in the replay buffer."""


def mlp(sizes: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in zip(sizes, sizes[1:], strict=False):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class EagerUpdate:
    """Takes gradient steps of TD3 or SAC (`base`) with the settings of `config`, on random transitions."""

    def __init__(self, base: str, config: Config, obs_dim: int, action_dim: int):
        self.config, self.device, self.updates = config, torch.device(config.device), 0
        self.action_dim, self.is_sac = action_dim, base == "SAC"
        outputs = 2 * action_dim if self.is_sac else action_dim
        self.actor = mlp([obs_dim, *config.hidden, outputs]).to(self.device)
        self.critics = [mlp([obs_dim + action_dim, *config.hidden, 1]).to(self.device) for _ in range(2)]
        self.actor_target, self.critic_targets = copy.deepcopy(self.actor), copy.deepcopy(self.critics)
        self.log_alpha = torch.zeros(1, device=self.device, requires_grad=True)
        rate = config.learning_rate
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=rate)
        self.critic_optimizer = torch.optim.Adam([p for critic in self.critics for p in critic.parameters()], lr=rate)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], lr=rate)
        self.rng = np.random.default_rng(0)
        widths = obs_dim, action_dim, obs_dim, 1, 1
        self.columns = [self.rng.standard_normal((TRANSITIONS, width), np.float32) for width in widths]

    def update(self) -> None:
        """One gradient step, sampling included."""
        rows = self.rng.integers(0, TRANSITIONS, self.config.batch_size)
        obs, action, next_obs, reward, terminated = (torch.as_tensor(c[rows]).to(self.device) for c in self.columns)
        self.updates += 1
        with torch.no_grad():
            next_action, next_log_prob = self.next_action(next_obs)
            next_inputs = torch.cat([next_obs, next_action], 1)
            next_q = torch.min(*(target(next_inputs) for target in self.critic_targets))
            if self.is_sac:
                next_q = next_q - self.log_alpha.exp() * next_log_prob
            q_target = reward + (1 - terminated.clamp(0, 1)) * self.config.gamma * next_q
        inputs = torch.cat([obs, action], 1)
        loss = sum(F.mse_loss(critic(inputs), q_target) for critic in self.critics)
        self.descend(self.critic_optimizer, loss)
        if self.is_sac:
            self.update_sac_actor(obs)
            self.move_targets([(self.critics, self.critic_targets)])
        elif self.updates % self.config.policy_delay == 0:
            suggested = torch.tanh(self.actor(obs))
            self.descend(self.actor_optimizer, -self.critics[0](torch.cat([obs, suggested], 1)).mean())
            self.move_targets([(self.critics, self.critic_targets), ([self.actor], [self.actor_target])])

    def next_action(self, obs: Tensor) -> tuple[Tensor, Tensor | None]:
        if self.is_sac:
            return self.sample(obs)
        action = torch.tanh(self.actor_target(obs))
        clip = self.config.target_noise_clip
        noise = (torch.randn_like(action) * self.config.target_noise).clamp(-clip, clip)
        return (action + noise).clamp(-1, 1), None

    def sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.actor(obs).chunk(2, -1)
        normal = torch.distributions.Normal(mean, log_std.clamp(-20, 2).exp(), validate_args=False)
        raw = normal.rsample()
        action = torch.tanh(raw)
        log_prob = normal.log_prob(raw) - 2 * (math.log(2) - raw - F.softplus(-2 * raw))
        return action, log_prob.sum(1, keepdim=True)

    def update_sac_actor(self, obs: Tensor) -> None:
        action, log_prob = self.sample(obs)
        q = torch.min(*(critic(torch.cat([obs, action], 1)) for critic in self.critics))
        self.descend(self.actor_optimizer, (self.log_alpha.exp().detach() * log_prob - q).mean())
        surplus = (log_prob - self.action_dim).detach()
        self.descend(self.alpha_optimizer, (-self.log_alpha.exp() * surplus).mean())

    def descend(self, optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    def move_targets(self, pairs: list) -> None:
        tau = self.config.tau
        for sources, targets in pairs:
            for source, target in zip(sources, targets, strict=True):
                for p, target_p in zip(source.parameters(), target.parameters(), strict=True):
                    target_p.data.copy_(tau * p.data + (1 - tau) * target_p.data)
