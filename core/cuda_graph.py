"""Gradient steps as CUDA graphs: the hundreds of kernels of a step are launched at once, without Python in between.

A graph repeats its operations on the same memory. Only the random numbers differ from step to step. They are drawn on
the CPU, from each seed's own streams, as without a GPU, and copied to where the graph reads them (`core.random.Tape`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from core.agent import Agent
from core.random import Tape
from core.replay import Replay

EAGER_STEPS = 3
"""Steps of each kind before one is captured: libraries allocate memory when they are first called."""


class CapturedStep:
    """A gradient step of `agent`, captured but not taken, that can be repeated. `tape` is from an earlier step."""

    def __init__(self, agent: Agent, step: Callable[[], None], tape: Tape):
        self.agent, self.tape = agent, tape
        self.graph = torch.cuda.CUDAGraph()
        updates, losses = agent.updates, agent.losses
        agent.losses = {}
        tape.rewind()
        with torch.cuda.graph(self.graph):
            step()
        self.counted, agent.updates = agent.updates - updates, updates
        self.losses, agent.losses = agent.losses, losses  # in the graph's memory: each repetition fills them

    def repeat(self) -> None:
        self.tape.draw_again()
        self.graph.replay()
        self.agent.updates += self.counted
        self.agent.losses |= self.losses


class GradientSteps:
    """Calling it takes one gradient step of every seed of `agent`, on a batch from `replay`.

    On a GPU it takes the first steps of each of the agent's kinds operation by operation and repeats later ones as
    graphs. No call waits for the GPU. Sets that are solved on the CPU cannot be part of a graph.
    """

    def __init__(self, agent: Agent, replay: Replay, batch_size: int):
        self.agent, self.replay, self.batch_size = agent, replay, batch_size
        self.eager = [0] * agent.cycle  # steps of each kind
        self.tapes: dict[int, Tape] = {}
        self.captured: dict[int, CapturedStep] = {}

    def __call__(self) -> None:
        if self.agent.device.type != "cuda" or self.agent.constraint.solved_on_cpu:
            self._step()
            return
        kind = self.agent.updates % self.agent.cycle
        if self.eager[kind] < EAGER_STEPS:
            self._step_aside(kind)
            self.eager[kind] += 1
            return
        if kind not in self.captured:
            with self._using(self.tapes[kind]):
                self.captured[kind] = CapturedStep(self.agent, self._step, self.tapes[kind])
        self.captured[kind].repeat()

    def _step(self) -> None:
        self.agent.update(self.replay.sample(self.batch_size))

    def _step_aside(self, kind: int) -> None:
        """An eager step on a stream of its own, as capturing demands, that records its draws."""
        self.tapes[kind] = Tape()
        stream = torch.cuda.Stream(self.agent.device)
        stream.wait_stream(torch.cuda.current_stream(self.agent.device))
        with torch.cuda.stream(stream), self._using(self.tapes[kind]):
            self._step()
        torch.cuda.current_stream(self.agent.device).wait_stream(stream)

    @contextmanager
    def _using(self, tape: Tape) -> Iterator[None]:
        streams = (self.agent.update_noise, self.replay.streams)
        for each in streams:
            each.tape = tape
        try:
            yield
        finally:
            for each in streams:
                each.tape = None
