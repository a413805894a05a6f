"""Gradient steps as CUDA graphs: the hundreds of kernels of a step are launched at once, without Python in between.

A graph repeats its operations on the same memory. Only the random numbers differ from step to step. As without a GPU,
they are drawn on the CPU from each seed's own streams, but for many steps at a time (`core.ahead`).
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from core.agent import Agent
from core.ahead import Ahead, Draw
from core.replay import Replay

EAGER_STEPS = 3
"""Steps of each kind that run before one is captured: libraries allocate memory when they are first called."""


class CapturedStep:
    """A gradient step of `agent` as a CUDA graph. Capturing it does not take the step; each `repeat` does."""

    def __init__(self, agent: Agent, step: Callable[[], None]):
        self.agent = agent
        self.graph = torch.cuda.CUDAGraph()
        updates, losses = agent.updates, agent.losses
        agent.losses = {}
        with torch.cuda.graph(self.graph):
            step()
        self.counted, agent.updates = agent.updates - updates, updates
        self.losses, agent.losses = agent.losses, losses  # in the graph's memory: each repetition fills them

    def repeat(self) -> None:
        self.graph.replay()
        self.agent.updates += self.counted
        self.agent.losses |= self.losses


class GradientSteps:
    """Each call takes one gradient step of every seed of `agent`, on a batch from `replay`.

    On a GPU, the first steps of each kind (see `Agent.cycle`) run eagerly and later ones as graphs. No call waits for
    the GPU. Sets that are solved on the CPU cannot be part of a graph: with them, every step runs eagerly.
    """

    def __init__(self, agent: Agent, replay: Replay, batch_size: int):
        self.agent, self.replay, self.batch_size = agent, replay, batch_size
        self.streams = agent.update_noise, replay.streams
        self.eager = [0] * agent.cycle  # steps of each kind
        self.draws: list[list[list[Draw]]] = [[[]] * agent.cycle for _ in self.streams]  # of each kind of step
        self.captured: dict[int, CapturedStep] = {}

    def __call__(self) -> None:
        self.replay.flush()
        if self.agent.device.type != "cuda" or self.agent.constraint.solved_on_cpu:
            self._step()
            return
        kind = self.agent.updates % self.agent.cycle
        if self.eager[kind] < EAGER_STEPS:
            self._step_aside(kind)
            self.eager[kind] += 1
            return
        if not self.captured:
            for streams, draws in zip(self.streams, self.draws, strict=True):
                streams.ahead = Ahead(streams.generators, draws, streams.device) if any(draws) else None
        if kind not in self.captured:
            self.captured[kind] = CapturedStep(self.agent, self._step)
        for streams in self.streams:
            if streams.ahead:
                streams.ahead.begin(kind)
        self.captured[kind].repeat()

    def _step(self) -> None:
        for streams in self.streams:
            if streams.ahead:
                streams.ahead.read(self.agent.updates % self.agent.cycle)
        self.agent.update(self.replay.sample(self.batch_size))

    def _step_aside(self, kind: int) -> None:
        """Take an eager step on a separate CUDA stream, as capturing demands, and record its draws."""
        for streams in self.streams:
            streams.recorded = []
        stream = torch.cuda.Stream(self.agent.device)
        stream.wait_stream(torch.cuda.current_stream(self.agent.device))
        with torch.cuda.stream(stream):
            self._step()
        torch.cuda.current_stream(self.agent.device).wait_stream(stream)
        for draws, streams in zip(self.draws, self.streams, strict=True):
            draws[kind], streams.recorded = streams.recorded or [], None
        if self.agent.updates % self.agent.cycle != (kind + 1) % self.agent.cycle:
            raise RuntimeError(f"{type(self.agent).__name__}.update must add 1 to `updates` in every call")
