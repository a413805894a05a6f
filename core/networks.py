"""Networks whose weights carry a leading axis of rows: one forward pass serves all seeds (and both critics)."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import TypeVar, cast

import torch
from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)


class Linear(nn.Module):
    """Parameters of one affine map per row: weight (rows, inputs, outputs) and bias (rows, 1, outputs)."""

    def __init__(self, inputs: int, outputs: int, generators: Sequence[torch.Generator]):
        super().__init__()
        # PyTorch's own initialisation of nn.Linear, as in the paper's code base. (Without inputs, only a bias is left.)
        bound = 1 / math.sqrt(max(inputs, 1))
        weight = torch.empty(len(generators), inputs, outputs)
        bias = torch.empty(len(generators), 1, outputs)
        for i, generator in enumerate(generators):
            weight[i].uniform_(-bound, bound, generator=generator)
            bias[i].uniform_(-bound, bound, generator=generator)
        self.weight, self.bias = nn.Parameter(weight), nn.Parameter(bias)


class Network(nn.Module):
    """A module that can have a target network: its parameter tensors are never replaced by others."""

    @cached_property
    def parameter_list(self) -> list[Tensor]:
        """The parameters as a list. Collecting them anew takes longer than updating a target network."""
        return [*self.parameters()]


class MLP(Network):
    """Fully connected network with ReLU between the layers: (rows, batch, sizes[0]) -> (rows, batch, sizes[-1])."""

    def __init__(self, sizes: Sequence[int], generators: Sequence[torch.Generator]):
        super().__init__()
        self.layers = nn.ModuleList(
            Linear(inputs, outputs, generators) for inputs, outputs in zip(sizes, sizes[1:], strict=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        """If `x` has fewer rows than the network, only the first rows of the weights are used."""
        # On small networks, Python and PyTorch's dispatch take as long as the arithmetic, so modules are not called.
        rows, last = x.shape[0], len(self.layers) - 1
        for number, layer in enumerate(cast("Iterable[Linear]", self.layers)):
            weight: Tensor = layer.weight
            bias: Tensor = layer.bias
            if rows < weight.shape[0]:
                weight, bias = weight[:rows], bias[:rows]
            x = torch.baddbmm(bias, x, weight)
            if number < last:
                x = x.relu_()
        return x


class TwinCritic(Network):
    """Two Q-functions per seed as one network of 2 * seeds rows: the first critics of all seeds, then the second."""

    def __init__(self, obs_dim: int, action_dim: int, hidden: Sequence[int], generators: Sequence[torch.Generator]):
        super().__init__()
        self.net = MLP([obs_dim + action_dim, *hidden, 1], [*generators, *generators])

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q-values (2, seeds, batch) of obs (seeds, batch, n) and action (seeds, batch, d)."""
        x = torch.cat([obs, action], dim=-1)
        return self.net(x.expand(2, *x.shape).flatten(0, 1)).view(2, *x.shape[:2])

    def first(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q-values (seeds, batch) of the first critic alone."""
        return self.net(torch.cat([obs, action], dim=-1)).squeeze(-1)


def rows_of(module: Module, which: Sequence[int]) -> Module:
    """A frozen copy of `module` that has only the rows `which` of each parameter."""
    memo = {id(p): nn.Parameter(p.detach()[list(which)], requires_grad=False) for p in module.parameters()}
    return copy.deepcopy(module, memo)


def frozen_copy(module: Module) -> Module:
    """A copy that no optimiser trains, for target networks."""
    return copy.deepcopy(module).requires_grad_(False)


@torch.no_grad()
def soft_update(target: Network, source: Network, tau: float) -> None:
    """target <- (1 - tau) target + tau source, for all parameters at once."""
    torch._foreach_lerp_(target.parameter_list, source.parameter_list, tau)


class Adam(torch.optim.Adam):
    """Adam with PyTorch's defaults. A step is little more than one call of the fused kernel.

    The checks and hooks around PyTorch's own `step` take longer than the kernel on networks of this size.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], learning_rate: float):
        super().__init__(parameters, lr=learning_rate, fused=True)
        for parameter in self.param_groups[0]["params"]:
            moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
            self.state[parameter] = {"step": torch.zeros((), device=parameter.device), **moments}

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Take one step with the parameters' `grad`."""
        (group,) = self.param_groups
        parameters = group["params"]
        states = [self.state[parameter] for parameter in parameters]
        counts = [state["step"] for state in states]
        torch._foreach_add_(counts, 1)
        beta1, beta2 = group["betas"]
        torch._fused_adam_(
            parameters,
            [parameter.grad for parameter in parameters],
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            counts,
            lr=group["lr"],
            beta1=beta1,
            beta2=beta2,
            weight_decay=0.0,
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )

    step.hooked = True  # type: ignore[attr-defined]  # tells PyTorch not to wrap it for its profiler
