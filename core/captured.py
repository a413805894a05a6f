"""A function of tensors as a CUDA graph: launching the kernels of a small network takes longer than running them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

EAGER_CALLS = 3
"""Calls before the function is captured: libraries allocate memory when they are first called."""


class Captured:
    """`function`, called as it is on a CPU, and on a GPU, after its first calls, repeated as a graph without gradients.

    The inputs of all calls have the same shapes. The function makes one tensor of them and of memory that keeps its
    place, such as the parameters of networks. It draws no random numbers. A call overwrites what the last one returned.
    """

    def __init__(self, function: Callable[..., Tensor]):
        self.function = function
        self.calls = 0
        self.graph: torch.cuda.CUDAGraph | None = None
        self.inputs: list[Tensor] = []
        self.output: Tensor

    @torch.no_grad()
    def __call__(self, *inputs: Tensor) -> Tensor:
        if inputs[0].device.type != "cuda":
            return self.function(*inputs)
        if self.graph is None:
            if self.calls < EAGER_CALLS:
                self.calls += 1
                return self.function(*inputs)
            self.inputs = [given.clone() for given in inputs]
            self.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph):
                self.output = self.function(*self.inputs)
        for place, given in zip(self.inputs, inputs, strict=True):
            place.copy_(given)
        self.graph.replay()
        return self.output
