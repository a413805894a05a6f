"""A function of tensors as a CUDA graph: launching the kernels of a small network takes longer than running them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

EAGER_CALLS = 3
"""Calls before the function is captured: libraries allocate memory when they are first called."""


class Captured:
    """Calls `function`. On a GPU, after the first calls, it replays the function as a CUDA graph without gradients.

    The inputs of all calls must be on `device` and have the same shapes. The function computes one tensor from them and
    from memory at fixed addresses, such as the parameters of networks. It must not draw random numbers. Python values
    that it reads are fixed when the graph is captured. A replay overwrites the previous result.
    """

    def __init__(self, function: Callable[..., Tensor], device: torch.device):
        self.function, self.device = function, device
        self.calls = 0
        self.graph: torch.cuda.CUDAGraph | None = None
        self.inputs: list[Tensor] = []
        self.output: Tensor

    @torch.no_grad()
    def __call__(self, *inputs: Tensor) -> Tensor:
        if self.device.type != "cuda":
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
