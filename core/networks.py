"""Networks whose weights carry a leading axis of rows: one forward pass serves all seeds (and both critics)."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

Network = TypeVar("Network", bound=nn.Module)


class Linear(nn.Module):
    """Affine maps side by side, one a row: (rows, batch, inputs) -> (rows, batch, outputs).

    An input of fewer rows goes through the first of them.
    """

    def __init__(self, inputs: int, outputs: int, generators: Sequence[torch.Generator]):
        super().__init__()
        bound = 1 / math.sqrt(inputs)  # PyTorch's own initialisation of nn.Linear, which the paper's code base uses
        weight = torch.empty(len(generators), inputs, outputs)
        bias = torch.empty(len(generators), 1, outputs)
        for i, generator in enumerate(generators):
            weight[i].uniform_(-bound, bound, generator=generator)
            bias[i].uniform_(-bound, bound, generator=generator)
        self.weight, self.bias = nn.Parameter(weight), nn.Parameter(bias)

    def forward(self, x: Tensor) -> Tensor:
        rows = x.shape[0]
        if rows == self.weight.shape[0]:  # slicing would cost a copy of the gradient
            return torch.baddbmm(self.bias, x, self.weight)
        return torch.baddbmm(self.bias[:rows], x, self.weight[:rows])


class MLP(nn.Module):
    """Fully connected network with ReLU between the layers: (rows, batch, sizes[0]) -> (rows, batch, sizes[-1])."""

    def __init__(self, sizes: Sequence[int], generators: Sequence[torch.Generator]):
        super().__init__()
        self.layers = nn.ModuleList(
            Linear(inputs, outputs, generators) for inputs, outputs in zip(sizes, sizes[1:], strict=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            x = layer(x).relu_()
        return self.layers[-1](x)


class TwinCritic(nn.Module):
    """Two Q-functions a seed as one network of 2 * seeds rows: the first critics of all seeds, then the second."""

    def __init__(self, obs_dim: int, action_dim: int, hidden: Sequence[int], generators: Sequence[torch.Generator]):
        super().__init__()
        self.net = MLP([obs_dim + action_dim, *hidden, 1], [*generators, *generators])

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q-values (2, seeds, batch) of obs (seeds, batch, n) and action (seeds, batch, d)."""
        x = torch.cat([obs, action], dim=-1)
        return self.net(x.repeat(2, 1, 1)).view(2, *x.shape[:2])

    def first(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q-values (seeds, batch) of the first critic alone."""
        return self.net(torch.cat([obs, action], dim=-1)).squeeze(-1)


def rows_of(module: Network, which: Sequence[int]) -> Network:
    """A frozen copy of `module` that has only the rows `which` of each parameter."""
    memo = {id(p): nn.Parameter(p.detach()[list(which)], requires_grad=False) for p in module.parameters()}
    return copy.deepcopy(module, memo)


def frozen_copy(module: Network) -> Network:
    """A copy that no optimiser trains, for target networks."""
    return copy.deepcopy(module).requires_grad_(False)


@torch.no_grad()
def soft_update(target: nn.Module, source: nn.Module, tau: float) -> None:
    """target <- (1 - tau) target + tau source, for all parameters at once."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), tau)


def adam(parameters, learning_rate: float) -> torch.optim.Adam:
    """Adam with PyTorch's defaults; the fused kernel makes one pass over the memory."""
    return torch.optim.Adam(parameters, lr=learning_rate, fused=True)


def descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    """One step on `loss`, with gradients for the optimiser's own parameters alone."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    optimizer.step()
