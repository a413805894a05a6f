"""ARAM: SAC with acceptance and rejection in an augmented MDP (Hung, Sun and Hsieh, ICLR 2025).

The policy draws actions until one is feasible. A rejected action is a transition too: it leads from a state back to the
same state at the cost of a penalty. So there are two rewards, the task's and minus the penalty, and a preference
lambda = (l, 1 - l) weighs them. The preference is an input of actor and critics. The critics learn both returns, for
all preferences at once.

An action is projected only after many rejections, and in evaluations, where the policy is deterministic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.optim import Optimizer

from algos.sac import SAC, GaussianActor, Temperature, squashed
from core.agent import Action, Agent
from core.captured import Captured
from core.config import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, POSITIVE_SHARE, SHARE, Config, setting
from core.maps import Project, Sample
from core.networks import MLP, Adam, Network, frozen_copy, rows_of, soft_update
from core.replay import Batch

MEASURED_STEPS = 1_000
"""The measures of acceptance are means over about this many of the last environment steps."""


@dataclass
class ARAMConfig(Config):
    """ARAM's own settings. The defaults are the constants of its published code, except for docs/deviations.md.

    Besides its penalty, a rejection delays all later rewards, which costs (1 - gamma) times their value. If the value
    is negative, the delay is a gain and works against the penalty. `reward_shift` can therefore raise the rewards.
    """

    temperature: float = setting(0.2, "ARAM: initial weight of the entropy", POSITIVE)
    learn_temperature: bool = setting(True, "ARAM: learn the weight of the entropy, as SAC does")
    reward_shift: float = setting(0.0, "ARAM: constant added to the task's rewards in gradient steps")
    rejection_penalty: float = setting(0.2, "ARAM: cost of a rejected action", NOT_NEGATIVE)
    most_rejections: int = setting(100, "ARAM: draws a step; if all are rejected, the last is projected", AT_LEAST_ONE)
    rejected_share: float = setting(0.2, "ARAM: initial share of rejected actions in a batch", SHARE)
    rejected_share_decay: float = setting(0.99, "ARAM: factor by which rejected_share decays", POSITIVE_SHARE)
    rejected_share_every: int = setting(10_000, "ARAM: environment steps between these decays", AT_LEAST_ONE)
    rejected_kept: int = setting(100_000, "ARAM: rejected actions kept per seed", AT_LEAST_ONE)
    preferences: int = setting(4, "ARAM: preferences compared in an actor step", AT_LEAST_ONE)
    snapshots: int = setting(4, "ARAM: earlier critics compared in an actor step", AT_LEAST_ONE)
    snapshot_every: int = setting(1_000, "ARAM: gradient steps between copies of the critic", AT_LEAST_ONE)
    snapshots_after: int = setting(20_000, "ARAM: gradient steps at the start without such copies", NOT_NEGATIVE)
    eval_preference: float = setting(0.9, "ARAM: weight of the task's reward in evaluations", SHARE)


class VectorCritic(Network):
    """`count` Q-functions per seed side by side. Each predicts two returns: the task's and the penalties'."""

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        hidden: Sequence[int],
        generators: Sequence[torch.Generator],
        count: int = 2,
    ):
        super().__init__()
        self.count = count
        self.net = MLP([obs_dim + action_dim + 2, *hidden, 2], [*generators] * count)

    def forward(self, obs: Tensor, action: Tensor, preference: Tensor) -> Tensor:
        """The returns (count, seeds, batch, 2) for obs (seeds, batch, n), action (seeds, batch, d) and preferences
        (seeds, 1 or batch, 2)."""
        x = with_preference(torch.cat([obs, action], dim=-1), preference)
        q = self.net(x.expand(self.count, *x.shape).flatten(0, 1))
        return q.view(self.count, *x.shape[:2], 2)


class ARAM(Agent):
    """ARAM for all seeds at once; tensors are (seeds, batch, features)."""

    config: ARAMConfig
    config_class = ARAMConfig
    family = "ARAM"
    maps = (Project,)
    placements = ("environment",)
    paper = {
        group: {key: value for key, value in settings.items() if key != "gsde"}
        | {"reward_shift": 0.2 if group == "Reacher" else 0.0}
        for group, settings in SAC.paper.items()
    }

    def build(self, init: Sequence[torch.Generator]) -> None:
        config, seeds = self.config, len(self.seeds)
        sizes = self.obs_dim, self.action_dim, config.hidden
        self.actor = GaussianActor(self.obs_dim + 2, self.action_dim, config.hidden, init).to(self.device)
        self.critic = VectorCritic(*sizes, init).to(self.device)
        self.critic_target = frozen_copy(self.critic)
        self.earlier = VectorCritic(*sizes, init, 2 * config.snapshots).to(self.device).requires_grad_(False)
        self.temperature = Temperature(seeds).to(self.device)
        self.temperature.log_alpha.data.fill_(config.temperature).log_()
        self.temperature.requires_grad_(config.learn_temperature)
        self.actor_optimizer = Adam(self.actor.parameters(), config.learning_rate)
        self.critic_optimizer = Adam(self.critic.parameters(), config.learning_rate)
        self.temperature_optimizer = Adam(self.temperature.parameters(), config.learning_rate)
        self.explored = Captured(self.suggestions, self.device)
        self.target_entropy = -float(self.action_dim)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(seeds, *shape, dtype=dtype, device=self.device)

        self.preference = zeros(2)  # of the current episode
        # A ring of the last rejected actions of each seed, with their observations.
        self.rejections = zeros(config.rejected_kept, self.obs_dim + self.action_dim)
        self.rejected, self.steps = (zeros(1, dtype=torch.int64) for _ in range(2))  # counts of actions and steps
        self.measured = torch.zeros(seeds, dtype=torch.int64)  # `steps` on the CPU: acting does not wait for a GPU
        self.missing = zeros(config.snapshots) + torch.inf  # 0 for each earlier critic, inf if there is none yet
        self.copies = torch.zeros(seeds, dtype=torch.int64)  # the number of copies of the critic so far
        # Means over steps: rejected draws, share of steps that project, share of the draws that are feasible.
        self.measures = torch.zeros(seeds, 3)
        self.entropy = zeros(1)  # of the policy at the last batch's states
        self.last_losses = {name: zeros() for name in ("critic_loss", "actor_loss")}

    def networks(self) -> dict[str, nn.Module]:
        return {
            "actor": self.actor,
            "critic": self.critic,
            "critic_target": self.critic_target,
            "earlier": self.earlier,
            "temperature": self.temperature,
        }

    def optimizers(self) -> dict[str, Optimizer]:
        optimizers: dict[str, Optimizer] = {"actor": self.actor_optimizer, "critic": self.critic_optimizer}
        return optimizers | ({"temperature": self.temperature_optimizer} if self.config.learn_temperature else {})

    def memory(self) -> dict[str, Tensor]:
        names = "preference", "rejections", "rejected", "steps", "measured", "missing", "copies", "measures", "entropy"
        return {name: getattr(self, name) for name in names} | self.last_losses

    @torch.no_grad()
    def clear(self, i: int) -> None:
        """Discard the seed's rejected actions as well, which may be NaN after it has diverged."""
        super().clear(i)
        self.rejected[i] = 0

    # ---------------------------------------------------------------- acting

    def start_episode(self, which: Sequence[int]) -> None:
        """Draw the preference of each new episode."""
        drawn = preferences(self.exploration.uniform(1, which=which))
        for i in which:
            self.preference[i] = drawn[i]

    @torch.no_grad()
    def act(self, obs: Tensor, center: Tensor | None, warming_up: Sequence[int], exploring: Sequence[int]) -> Action:
        """Draw until an action is feasible; if all `most_rejections` draws are rejected, project the last one.

        All draws of all seeds are made and checked at once. Draws after the first feasible one count only in
        `acceptance_rate`.
        """
        seeds, draws = len(self.seeds), self.config.most_rejections
        candidates = torch.zeros(seeds, draws, self.action_dim)
        if warming_up:
            uniform = self.exploration.uniform(draws, self.action_dim, which=warming_up)
            candidates[warming_up] = uniform.cpu()[warming_up]
        if exploring:
            candidates[exploring] = self.draw(obs.to(self.device), exploring).cpu()[exploring]
        feasible = self.constraint.violation(obs.unsqueeze(1), candidates) <= 0.0  # a NaN is rejected as well
        rejected = (~feasible).cumprod(-1).sum(-1)  # (seeds,): draws before the first feasible one
        exhausted = rejected == draws
        suggested = candidates[torch.arange(seeds), rejected.clamp(max=draws - 1)]
        executed = suggested
        if exhausted.any():
            executed = torch.where(exhausted.unsqueeze(-1), self.feasible(obs, suggested, None), suggested)
        self.remember([*warming_up, *exploring], obs, candidates, rejected, feasible.float().mean(-1))
        return Action(suggested, executed, suggested)

    def draw(self, obs: Tensor, which: Sequence[int]) -> Tensor:
        """`most_rejections` actions (seeds, draws, d) of the policy at obs (seeds, n). Only the rows `which` count."""
        return self.explored(obs, self.exploration.normal(self.config.most_rejections, self.action_dim, which=which))

    def suggestions(self, obs: Tensor, noise: Tensor) -> Tensor:
        """Actions of the policy at obs (seeds, n), for the episodes' preferences and `noise` (seeds, draws, d)."""
        return self.sample(obs.unsqueeze(1), self.preference.unsqueeze(1), noise).suggested

    def explore(self, obs: Tensor, which: Sequence[int]) -> Tensor:
        return self.draw(obs, which)[:, 0]

    def remember(
        self, which: Sequence[int], obs: Tensor, candidates: Tensor, rejected: Tensor, feasible: Tensor
    ) -> None:
        """Count a step of the seeds `which` and store their rejected actions, the first `rejected` of `candidates`.

        obs (seeds, n), `candidates` (seeds, draws, d), the counts `rejected` (seeds,) and the shares of feasible
        candidates `feasible` (seeds,) are on the CPU.
        """
        kept, draws = self.config.rejected_kept, candidates.shape[1]
        stepped = torch.zeros(len(self.seeds), dtype=torch.int64)
        stepped[list(which)] = 1
        count = (rejected * stepped).unsqueeze(-1)
        number = torch.arange(draws)
        seeds, numbers = ((number < count) & (number >= count - kept)).nonzero(as_tuple=True)
        if len(seeds):
            rows = torch.cat([obs[seeds], candidates[seeds, numbers]], dim=-1).to(self.device)
            seeds, numbers = seeds.to(self.device), numbers.to(self.device)
            self.rejections[seeds, (self.rejected[seeds, 0] + numbers) % kept] = rows
            self.rejected += count.to(self.device)
        self.steps += stepped.unsqueeze(-1).to(self.device)
        now = torch.cat([count, count == draws, feasible.unsqueeze(-1)], dim=-1)
        self.measured += stepped
        weight = stepped / self.measured.clamp(min=1, max=MEASURED_STEPS)
        self.measures.lerp_(now, weight.unsqueeze(-1))

    def policy(self, which: Sequence[int]) -> Callable[[Tensor], Tensor]:
        """The policy's mean action, projected, for the preference (`eval_preference`, 1 - `eval_preference`)."""
        actor, weight = rows_of(self.actor, which), self.config.eval_preference
        preference = torch.tensor([weight, 1.0 - weight], device=self.device)

        @torch.no_grad()
        def act(obs: Tensor) -> Tensor:
            mean, _ = actor(torch.cat([obs, preference.expand(*obs.shape[:-1], 2)], dim=-1))
            return self.feasible(obs, mean.tanh(), None)

        return act

    # ---------------------------------------------------------------- learning

    def sample(self, obs: Tensor, preference: Tensor, noise: Tensor) -> Sample:
        """A reparametrised action of the policy; preference (seeds, 1, 2) is the same for the whole batch."""
        return squashed(self.actor.sample(with_preference(obs, preference), noise))

    def update(self, batch: Batch) -> None:
        """One step of temperature, critics and actor, in this order."""
        self.updates += 1
        batch = self.with_rejections(batch._replace(reward=batch.reward + self.config.reward_shift))
        noise = self.update_noise.normal(2, *batch.action.shape[1:])
        drawn = preferences(self.update_noise.uniform(self.config.preferences, 1))
        preference = drawn[:, :1]  # of this gradient step: (seeds, 1, 2)
        sample = self.sample(batch.obs, preference, noise[:, 0])

        alpha = self.temperature.log_alpha.detach().exp()
        self.entropy.copy_(-sample.log_prob.detach().mean(-1, keepdim=True))
        if self.config.learn_temperature:
            surplus = self.target_entropy - self.entropy
            self.descend("temperature", -(self.temperature.log_alpha * surplus)[:, 0])

        with torch.no_grad():
            infeasible = self.constraint.violation(batch.obs, batch.action) > 0.0
            penalty = -self.config.rejection_penalty * infeasible.to(batch.reward.dtype)
            reward = torch.stack([batch.reward, penalty], dim=-1)
            following = self.sample(batch.next_obs, preference, noise[:, 1])
            returns = smaller_twin(self.critic_target(batch.next_obs, following.suggested, preference), preference)
            soft = returns - (alpha * following.log_prob).unsqueeze(-1)
            target = reward + self.config.gamma * (1 - batch.terminated).unsqueeze(-1) * soft
        q = self.critic(batch.obs, batch.action, preference)
        self.descend("critic", losses := 0.5 * (preference * (q - target).square()).sum(-1).mean(-1))
        self.last_losses["critic_loss"].copy_(losses.detach().mean(0))

        value = self.best_value(batch.obs, sample.suggested, preference, drawn) - alpha * sample.log_prob
        self.descend("actor", loss := -value.mean(-1))
        self.last_losses["actor_loss"].copy_(loss.detach())
        soft_update(self.critic_target, self.critic, self.config.tau)

    def with_rejections(self, batch: Batch) -> Batch:
        """Put rejected actions into the last places of the batch: transitions back to the same state, with reward 0."""
        config, size = self.config, batch.reward.shape[1]
        places = round(config.rejected_share * size)
        if not places:
            return batch
        kept = self.rejected.clamp(max=config.rejected_kept)
        number = 0.5 * (self.update_noise.uniform(places) + 1.0)  # in [0, 1], as rounding may give 1
        chosen = (number * kept).long().minimum(kept - 1).clamp(min=0)
        rows = self.rejections.gather(1, chosen.unsqueeze(-1).expand(-1, -1, self.rejections.shape[-1]))
        obs, action = rows.split([self.obs_dim, self.action_dim], dim=-1)
        # The share decays, but the shapes stay. A batch has no more rejected actions than a seed has stored.
        share = config.rejected_share * config.rejected_share_decay ** (self.steps // config.rejected_share_every)
        replace = torch.arange(places, device=kept.device) >= places - (share * size).round().minimum(kept)

        def replaced(column: Tensor, by: Tensor | float) -> Tensor:
            mask = replace.unsqueeze(-1) if column.dim() == 3 else replace
            first, last = column.split([size - places, places], dim=1)
            return torch.cat([first, torch.where(mask, by, last)], dim=1)

        return Batch(
            obs=replaced(batch.obs, obs),
            action=replaced(batch.action, action),
            reward=replaced(batch.reward, 0.0),
            terminated=replaced(batch.terminated, 0.0),
            next_obs=replaced(batch.next_obs, obs),
        )

    def best_value(self, obs: Tensor, action: Tensor, preference: Tensor, drawn: Tensor) -> Tensor:
        """The largest return (seeds, batch), weighed by `preference`, that a critic predicts in each state.

        The current critic and the earlier ones are evaluated for every preference in `drawn` (seeds, k, 2), which
        includes the step's own (Q-Pensieve, Hung et al., ICLR 2023). Only the largest return has a gradient, so the
        others are computed without one.
        """
        with torch.no_grad():
            worths = torch.stack([self.worths(obs, action, other, preference) for other in drawn.split(1, dim=1)])
            missing = pad(self.missing.T, (0, 0, 1, 0)).unsqueeze(-1)  # the current critic is never missing
            best = (worths - missing).flatten(0, 1).argmax(0)  # (seeds, batch)
            critics = worths.shape[1]
            condition = drawn.gather(1, (best // critics).unsqueeze(-1).expand(-1, -1, 2))
        return self.worths(obs, action, condition, preference).gather(0, (best % critics).unsqueeze(0)).squeeze(0)

    def worths(self, obs: Tensor, action: Tensor, condition: Tensor, preference: Tensor) -> Tensor:
        """The returns (1 + snapshots, seeds, batch) of the current and the earlier critics, weighed by `preference`.

        Of each pair of twin critics, the smaller return counts. The critics get the preference `condition` (seeds, 1 or
        batch, 2) as input.
        """
        returns = torch.cat([self.critic(obs, action, condition), self.earlier(obs, action, condition)])
        return (returns * preference).sum(-1).view(-1, 2, *action.shape[:2]).amin(1)

    @torch.no_grad()
    def start_rollout(self, which: Sequence[int]) -> None:
        """Store a copy of the critic every `snapshot_every` gradient steps, in the place of the oldest copy."""
        config = self.config
        for i in which:
            number = int(self.copies[i])
            if self.updates < config.snapshots_after + config.snapshot_every * (number + 1):
                continue
            slot = number % config.snapshots
            for copy, parameter in zip(self.earlier.parameters(), self.critic.parameters(), strict=True):
                self._rows(copy)[2 * slot : 2 * slot + 2, i] = self._rows(parameter)[:, i]
            self.missing[i, slot] = 0.0
            self.copies[i] += 1

    def statistics(self) -> dict[str, Tensor]:
        """Measures of about the last `MEASURED_STEPS` environment steps, and of the last gradient step.

        Of the environment steps: `acceptance_rate` is the share of a step's draws that are feasible, `rejected_draws`
        the number of rejected draws per step, and `fallbacks` the share of steps that project because all draws are
        rejected. `acceptance_rate` weighs all steps equally. The number of accepted draws over the number of draws made
        until one is accepted would not: most of these draws are in a few states where hardly any draw is feasible.
        """
        rejected, fallbacks, acceptance = self.measures.unbind(-1)
        return {
            "acceptance_rate": acceptance,
            "rejected_draws": rejected,
            "fallbacks": fallbacks,
            "temperature": self.temperature.log_alpha.detach().exp()[:, 0],
            "entropy": self.entropy[:, 0],
            **self.last_losses,
        }


def preferences(drawn: Tensor) -> Tensor:
    """Turn numbers (..., 1), uniform in [-1, 1), into preferences (..., 2), uniform on the simplex."""
    weight = 0.5 * (drawn + 1.0)
    return torch.cat([weight, 1.0 - weight], dim=-1)


def with_preference(obs: Tensor, preference: Tensor) -> Tensor:
    """Concatenate obs (seeds, batch, n) and preferences (seeds, 1 or batch, 2) to the input of a network."""
    return torch.cat([obs, preference.expand(*obs.shape[:-1], 2)], dim=-1)


def smaller_twin(returns: Tensor, preference: Tensor) -> Tensor:
    """The returns (seeds, batch, 2) of the twin that is worth less under `preference`, out of (2, seeds, batch, 2)."""
    worth = (returns * preference).sum(-1, keepdim=True)
    return torch.where(worth[0] <= worth[1], returns[0], returns[1])
