"""What the algorithm files share: the feasibility map, warm-up actions, and one seed's share of the networks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from constraints import Constraint
from core.config import Config
from core.networks import descend
from core.random import Streams
from core.replay import Batch

MapName = Literal["project", "alpha", "radial"]
Placement = Literal["environment", "rollout", "layer"]


def stores_centers(mapping: MapName, constraint: Constraint) -> bool:
    """Whether the replay buffer has centres, two a transition: where the map needs one other than the origin."""
    return mapping != "project" and not constraint.origin_centered


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
        self.device = torch.device(config.device)  # of networks, batches and what `explore` and `policy` are given
        self.exploration = Streams(seeds, "explore", self.device)
        self.update_noise = Streams(seeds, "update", self.device)
        self.updates = 0  # gradient steps so far, where an algorithm counts them
        self.losses: dict[str, Tensor] = {}  # (..., seeds) of the last step of each optimiser

    @property
    def bounded(self) -> bool:
        """Whether tanh keeps suggestions in the box: so before a projection, not before the other two maps."""
        return self.mapping == "project"

    @property
    def stores_centers(self) -> bool:
        """Whether the map needs a centre other than the origin: it is then computed once and replayed."""
        return stores_centers(self.mapping, self.constraint)

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
    def optimizers(self) -> dict[str, Optimizer]:
        """The optimisers, under the names that `descend` takes."""

    @abstractmethod
    def explore(self, obs: Tensor, only: Sequence[int]) -> Tensor:
        """Suggestions (seeds, d) with exploration noise, for obs (seeds, n). Only the rows `only` count."""

    @abstractmethod
    def policy(self, which: Sequence[int]) -> Callable[[Tensor], Tensor]:
        """The present deterministic policy of the seeds `which`: obs (len(which), m, n) -> executed actions."""

    @abstractmethod
    def update(self, batch: Batch) -> None:
        """One gradient step of every seed."""

    def memory(self) -> dict[str, Tensor]:
        """What else the future depends on: tensors (seeds, ...), beyond networks, optimisers and random streams."""
        return {}

    def statistics(self) -> dict[str, Tensor]:
        """What the last gradient step tells about the state of training: name -> (seeds,)."""
        return {}

    @property
    def cycle(self) -> int:
        """After how many gradient steps the same kind of step comes again."""
        return 1

    def descend(self, name: str, losses: Tensor) -> None:
        """One step of the optimiser `name` on the sum of `losses` (..., seeds), which `diverged` looks at."""
        self.losses[name] = losses.detach()
        descend(self.optimizers()[name], losses.sum())

    def diverged(self) -> dict[int, str]:
        """The positions of the seeds with a loss that is not finite, and which. It waits for the device."""
        found: dict[int, str] = {}
        for name, losses in self.losses.items():
            if not math.isfinite(losses.sum().item()):  # the common case costs little
                finite = losses.isfinite().reshape(-1, len(self.seeds)).all(0)
                for i in (~finite).nonzero().flatten().tolist():
                    found.setdefault(i, f"{name} loss")
        return found

    @torch.no_grad()
    def state(self, i: int) -> dict[str, Tensor]:
        """A copy of the parameters of the seed in position i, on the CPU."""
        return {name: _copy(self._rows(parameter)[:, i]) for name, parameter in self._parameters()}

    @torch.no_grad()
    def load_state(self, i: int, state: dict[str, Tensor]) -> None:
        """Put what `state` returned back into position i."""
        for name, parameter in self._parameters():
            self._rows(parameter)[:, i] = state[name]

    @torch.no_grad()
    def training_state(self, i: int) -> dict[str, Any]:
        """A copy of all that the seed in position i needs to train on exactly as it would have, on the CPU."""
        optimizers = {}
        for name, optimizer in self.optimizers().items():
            for number, parameter in enumerate(_parameters_of(optimizer)):
                for key, value in optimizer.state[parameter].items():
                    # Adam's moments have a row a seed, its step count is one for all.
                    rows = self._rows(value)[:, i] if value.dim() else value
                    optimizers[f"{name}.{number}.{key}"] = _copy(rows)
        return {
            "parameters": self.state(i),
            "optimizers": optimizers,
            "memory": {name: _copy(tensor[i]) for name, tensor in self.memory().items()},
            "streams": {name: streams.generators[i].get_state() for name, streams in self._streams().items()},
            "updates": self.updates,
        }

    @torch.no_grad()
    def load_training_state(self, i: int, state: dict[str, Any]) -> None:
        """Put what `training_state` returned back into position i. All seeds must have taken as many updates."""
        self.load_state(i, state["parameters"])
        for key, saved in state["optimizers"].items():
            name, number, quantity = key.split(".")
            optimizer = self.optimizers()[name]
            parameter = _parameters_of(optimizer)[int(number)]
            if quantity not in optimizer.state[parameter]:  # PyTorch's own optimisers make them in their first step
                optimizer.state[parameter][quantity] = torch.zeros_like(parameter if saved.dim() else saved)
            value = optimizer.state[parameter][quantity]
            (self._rows(value)[:, i] if saved.dim() else value).copy_(saved)
        for name, tensor in self.memory().items():
            tensor[i] = state["memory"][name]
        for name, streams in self._streams().items():
            streams.generators[i].set_state(state["streams"][name])
        self.updates = state["updates"]

    @torch.no_grad()
    def clear(self, i: int) -> None:
        """Set the parameters of position i and its optimisers' moments to zero: a diverged seed, out of harm's way."""
        for _, parameter in self._parameters():
            self._rows(parameter)[:, i] = 0.0
        for optimizer in self.optimizers().values():
            for parameter in _parameters_of(optimizer):
                for value in optimizer.state[parameter].values():
                    if value.dim():
                        self._rows(value)[:, i] = 0.0

    @torch.no_grad()
    def infinite_parameter(self, i: int) -> str | None:
        """The name of a parameter of position i that is not finite, None where all are."""
        for name, parameter in self._parameters():
            if not self._rows(parameter)[:, i].isfinite().all():
                return name
        return None

    def _parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        for module_name, module in self.networks().items():
            for name, parameter in module.named_parameters():
                yield f"{module_name}.{name}", parameter

    def _rows(self, tensor: Tensor) -> Tensor:
        """View (1 or 2, seeds, ...) of a parameter, or of a tensor of its shape."""
        return tensor.view(-1, len(self.seeds), *tensor.shape[1:])

    def _streams(self) -> dict[str, Streams]:
        return {"exploration": self.exploration, "update_noise": self.update_noise}


def _parameters_of(optimizer: Optimizer) -> list[nn.Parameter]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _copy(tensor: Tensor) -> Tensor:
    """A copy on the CPU."""
    return torch.empty_like(tensor, device="cpu", memory_format=torch.contiguous_format).copy_(tensor)
