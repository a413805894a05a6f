"""What the algorithm files share: the feasibility map, warm-up actions, and one seed's share of the networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from constraints import Constraint
from core.config import Config
from core.random import Streams
from core.replay import Batch

MapName = Literal["project", "alpha", "radial"]
Placement = Literal["environment", "rollout", "layer"]


class Agent(ABC):
    """Base of the algorithms; learning tensors are (seeds, batch, features).

    The actor *suggests* an action and the feasibility map turns it into the *executed* one. `placement` says where
    the map stands (paper, Section "Algorithms for Action-Constrained RL"):

    - `environment`: beyond the border of the environment; critic and replay buffer see the suggested action;
    - `rollout`: between actor and environment; critic and buffer see the executed action, but the actor's loss is
      blind to the map;
    - `layer`: the last layer of the actor; critic and buffer see the executed action, gradients pass the map.
    """

    def __init__(
        self,
        config: Config,
        constraint: Constraint,
        obs_dim: int,
        seeds: Sequence[int],
        *,
        mapping: MapName,
        placement: Placement,
    ):
        self.config, self.constraint = config, constraint
        self.seeds, self.obs_dim, self.action_dim = seeds, obs_dim, constraint.dim
        self.mapping, self.placement = mapping, placement
        self.exploration = Streams(seeds, "explore")
        self.update_noise = Streams(seeds, "update")

    @property
    def bounded(self) -> bool:
        """Whether tanh keeps suggestions in the box: so before a projection, not before the other two maps."""
        return self.mapping == "project"

    @property
    def stores_centers(self) -> bool:
        """Whether the map needs a centre other than the origin: it is then computed once and replayed."""
        return self.mapping != "project" and not self.constraint.origin_centered

    def feasible(self, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        """The feasible action that the algorithm's map makes of a suggestion."""
        if self.mapping == "radial":
            return self.constraint.radial_map(obs, suggested, center)
        return self.pull_back(obs, suggested, center)

    def pull_back(self, obs: Tensor, action: Tensor, center: Tensor | None) -> Tensor:
        """A map that leaves feasible actions alone, for random ones: projection, or alpha for alpha and radial."""
        if self.mapping == "project":
            return self.constraint.project(obs, action)
        return self.constraint.alpha_map(obs, action, center)

    def warm_up(self, only: Sequence[int]) -> Tensor:
        """Random suggestions (seeds, d), uniform in the box, for the seeds `only`."""
        return self.exploration.uniform(self.action_dim, only=only)

    def penalty(self, obs: Tensor, suggested: Tensor) -> Tensor | float:
        """The + variants' term of the actor loss (seeds, batch), zero for the others (paper, "Algorithms")."""
        weight = self.config.penalty
        return 0.0 if weight is None else weight * self.constraint.penalty(obs, suggested)

    def start_rollout(self, only: Sequence[int]) -> None:  # noqa: B027 - most algorithms have nothing to do
        """Called for the seeds `only` before the first step of each of their rollouts."""

    @abstractmethod
    def networks(self) -> dict[str, nn.Module]:
        """The learned modules; each parameter's leading axis holds the seeds, once or (twin critics) twice."""

    @abstractmethod
    def explore(self, obs: Tensor, only: Sequence[int]) -> Tensor:
        """Suggestions (seeds, d) with exploration noise, for obs (seeds, n). Only the rows `only` count."""

    @abstractmethod
    def policy(self, which: Sequence[int]) -> Callable[[Tensor], Tensor]:
        """The present deterministic policy of the seeds `which`: obs (len(which), m, n) -> executed actions."""

    @abstractmethod
    def update(self, batch: Batch) -> None:
        """One gradient step of every seed."""

    def statistics(self) -> dict[str, Tensor]:
        """What the last gradient step tells about the state of training: name -> (seeds,). Empty before the first."""
        return {}

    @torch.no_grad()
    def state(self, i: int) -> dict[str, Tensor]:
        """A copy of the parameters of the seed in position i."""
        return {
            name: parameter.view(-1, len(self.seeds), *parameter.shape[1:])[:, i].clone()
            for name, parameter in self._parameters()
        }

    @torch.no_grad()
    def load_state(self, i: int, state: dict[str, Tensor]) -> None:
        """Put what `state` returned back into position i."""
        for name, parameter in self._parameters():
            parameter.view(-1, len(self.seeds), *parameter.shape[1:])[:, i] = state[name]

    def _parameters(self):
        for module_name, module in self.networks().items():
            for name, parameter in module.named_parameters():
                yield f"{module_name}.{name}", parameter
