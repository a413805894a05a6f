"""The part of `core.agent.Agent` that copies, restores, clears and checks the rows of one seed in its tensors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from core.random import Streams


class Snapshots(ABC):
    """Networks, optimisers and streams whose rows belong to seeds; i is a seed's position among `seeds`."""

    seeds: Sequence[int]
    updates: int

    @abstractmethod
    def networks(self) -> dict[str, nn.Module]:
        """The learned modules by name.

        Each parameter's leading axis has k rows per seed: the first row of every seed in order, then the second row of
        every seed, and so on. k is 1 for most modules and 2 for `core.networks.TwinCritic`; any k works.
        """

    @abstractmethod
    def optimizers(self) -> dict[str, Optimizer]:
        """The optimisers by name."""

    @abstractmethod
    def streams(self) -> dict[str, Streams]:
        """The random streams by name."""

    def memory(self) -> dict[str, Tensor]:
        """Tensors (seeds, ...) that later steps depend on, besides networks, optimisers and random streams.

        Return the tensors themselves, not copies: resuming writes into them.
        """
        return {}

    @torch.no_grad()
    def state(self, i: int) -> dict[str, Tensor]:
        """A copy of seed i's parameters, on the CPU."""
        return {name: _copy(self._rows(parameter)[:, i]) for name, parameter in self._parameters()}

    @torch.no_grad()
    def load_state(self, i: int, state: dict[str, Tensor]) -> None:
        """Put what `state` returned back into position i."""
        for name, parameter in self._parameters():
            self._rows(parameter)[:, i] = state[name]

    @torch.no_grad()
    def training_state(self, i: int) -> dict[str, Any]:
        """A CPU copy of everything that seed i needs to continue with the same bits."""
        optimizers = {}
        for name, optimizer in self.optimizers().items():
            for number, parameter in enumerate(parameters_of(optimizer)):
                for key, value in optimizer.state[parameter].items():
                    # Adam's moments have rows for each seed. All seeds share its step count.
                    rows = self._rows(value)[:, i] if value.dim() else value
                    optimizers[f"{name}.{number}.{key}"] = _copy(rows)
        return {
            "parameters": self.state(i),
            "optimizers": optimizers,
            "memory": {name: _copy(tensor[i]) for name, tensor in self.memory().items()},
            "streams": {name: streams.state(i) for name, streams in self.streams().items()},
            "updates": self.updates,
        }

    @torch.no_grad()
    def load_training_state(self, i: int, state: dict[str, Any]) -> None:
        """Put what `training_state` returned back into position i. All seeds must have taken equally many updates."""
        self.load_state(i, state["parameters"])
        for key, saved in state["optimizers"].items():
            name, number, quantity = key.split(".")
            optimizer = self.optimizers()[name]
            parameter = parameters_of(optimizer)[int(number)]
            if quantity not in optimizer.state[parameter]:  # PyTorch's own optimisers make them in their first step
                optimizer.state[parameter][quantity] = torch.zeros_like(parameter if saved.dim() else saved)
            value = optimizer.state[parameter][quantity]
            (self._rows(value)[:, i] if saved.dim() else value).copy_(saved)
        for name, tensor in self.memory().items():
            tensor[i] = state["memory"][name]
        for name, streams in self.streams().items():
            streams.load_state(i, state["streams"][name])
        self.updates = state["updates"]

    @torch.no_grad()
    def clear(self, i: int) -> None:
        """Set seed i's parameters and its optimisers' moments to zero, so that a diverged seed computes no NaN."""
        for _, parameter in self._parameters():
            self._rows(parameter)[:, i] = 0.0
        for optimizer in self.optimizers().values():
            for parameter in parameters_of(optimizer):
                for value in optimizer.state[parameter].values():
                    if value.dim():
                        self._rows(value)[:, i] = 0.0

    @torch.no_grad()
    def infinite_parameter(self, i: int) -> str | None:
        """The name of a parameter of seed i that is not finite; None if all are finite."""
        for name, parameter in self._parameters():
            if not self._rows(parameter)[:, i].isfinite().all():
                return name
        return None

    def _parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        for module_name, module in self.networks().items():
            for name, parameter in module.named_parameters():
                yield f"{module_name}.{name}", parameter

    def _rows(self, tensor: Tensor) -> Tensor:
        """View (k, seeds, ...) of a parameter with k rows per seed, or of a tensor of the same shape."""
        return tensor.view(-1, len(self.seeds), *tensor.shape[1:])


def parameters_of(optimizer: Optimizer) -> list[nn.Parameter]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _copy(tensor: Tensor) -> Tensor:
    """A copy on the CPU."""
    return torch.empty_like(tensor, device="cpu", memory_format=torch.contiguous_format).copy_(tensor)
