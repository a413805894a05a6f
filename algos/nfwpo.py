"""NFW: Neural Frank-Wolfe Policy Optimization (Lin et al., 2021) with TD3's techniques (paper, Section "NFWPO").

Critics, exploration and targets are TD3's with projected actions. The actor does not follow the critic's gradient
through the projection. It regresses on a reference action that a Frank-Wolfe step finds inside the feasible set.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from algos.td3 import TD3, TD3Config
from core.config import POSITIVE_SHARE, setting
from core.maps import Project
from core.replay import Batch


@dataclass
class NFWPOConfig(TD3Config):
    fw_learning_rate: float = setting(0.01, "NFW: step size of Frank-Wolfe", POSITIVE_SHARE)


class NFWPO(TD3):
    """TD3 whose actor regresses on Frank-Wolfe reference actions."""

    config: NFWPOConfig
    config_class = NFWPOConfig
    maps = (Project,)
    placements = ("rollout",)
    takes_penalty = False
    paper = {
        "Reacher": TD3.paper["Reacher"] | {"fw_learning_rate": 0.05},
        "Hopper": TD3.paper["Hopper"] | {"fw_learning_rate": 0.01},
        "Others": TD3.paper["Others"] | {"fw_learning_rate": 0.01},
    }

    def actor_loss(self, batch: Batch) -> Tensor:
        """|mu(s) - a_s|^2, no gradient through a_s, mean over the batch: (seeds,)."""
        suggested = self.suggest(self.actor, batch.obs)
        reference = self.reference_action(batch.obs, suggested.detach())
        return (suggested - reference).square().sum(-1).mean(-1)

    def reference_action(self, obs: Tensor, suggested: Tensor) -> Tensor:
        """a_s = P_s(mu(s) + alpha (c_s - P_s(mu(s)))), c_s = argmax over the set of <c, grad_a Q_1(s, P_s(mu(s)))>."""
        with torch.no_grad():  # coefficients of the set may be learned
            projected = self.constraint.project(obs, suggested)
        (gradient,) = torch.autograd.grad(self.critic.first(obs, projected.requires_grad_()).sum(), projected)
        with torch.no_grad():
            vertex = self.constraint.linear_oracle(obs, gradient)
            step = self.config.fw_learning_rate * (vertex - projected)
            return self.constraint.project(obs, suggested + step)
