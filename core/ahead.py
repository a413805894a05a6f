"""Random numbers of future gradient steps, drawn for many steps at a time and copied to the device together.

A step that is captured in a CUDA graph finds its numbers by a counter on the device. The numbers are the same as if the
streams had drawn them step by step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Literal, NamedTuple

import torch
from torch import Tensor

BLOCK = 64
"""Steps whose numbers are drawn at once. It is even, so that a block has an even number of words."""


class Draw(NamedTuple):
    """One draw of a stream: the kind of its numbers, and their shape for one seed."""

    kind: Literal["normal", "uniform", "words"]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def joins(self) -> bool:
        """Whether one draw for many steps gives the same numbers as one draw for each step.

        PyTorch generates normal numbers in groups of 16 and begins a new group with each draw.
        """
        return self.kind != "normal" or self.size % 16 == 0

    def fill(self, out: Tensor, generator: torch.Generator) -> None:
        """Draw numbers into the contiguous tensor `out`."""
        if self.kind == "normal":
            out.normal_(generator=generator)
        elif self.kind == "uniform":
            out.uniform_(-1.0, 1.0, generator=generator)
        else:
            pairs = torch.empty(out.numel() // 2, dtype=torch.int64)
            pairs.random_(-(2**63), None, generator=generator)  # all 64 bits, the first word in the upper half
            out.copy_((torch.stack((pairs >> 32, pairs), -1) & 0xFFFFFFFF).view(out.shape))

    def skip(self, generator: torch.Generator) -> None:
        """Advance `generator` as the draw of one step does."""
        if self.kind == "words":
            torch.randint(2, self.shape, generator=generator)  # one word for each number
        else:
            self.fill(torch.empty(self.shape), generator)


class _Block(NamedTuple):
    first: int  # the kind of its first step
    start: list[Tensor]  # the states of the generators before it
    numbers: Tensor  # (seeds, BLOCK, width) on the CPU


class Ahead:
    """The random numbers of one purpose for future steps. While one block is in use, a thread draws the next one.

    `kinds` lists the draws of each kind of step in order. The kinds of steps follow each other in a cycle.
    """

    def __init__(self, generators: Sequence[torch.Generator], kinds: Sequence[Sequence[Draw]], device: torch.device):
        self.generators, self.kinds = generators, kinds
        self.pinned = device.type == "cuda"
        words = {draw.kind == "words" for draws in kinds for draw in draws}
        assert len(words) == 1, "a stream has only words, or none: a block holds numbers of one dtype"
        self.words = words == {True}
        width = max(sum(draw.size for draw in draws) for draws in kinds)
        self.block = torch.zeros(len(generators), BLOCK, width, dtype=self._dtype, device=device)
        self.row = torch.zeros(1, dtype=torch.int64, device=device)  # the row of the block that the next step reads
        self.step: Tensor | None = None  # (seeds, width): the numbers of the step that is computed or captured
        self.position, self.offset = 0, 0  # of its next draw
        self.worker = ThreadPoolExecutor(1)
        self.coming: Future[_Block] | None = None
        self.start = [generator.get_state() for generator in generators]  # before the first of `drawn` steps
        self.first, self.taken, self.drawn = 0, 0, 0

    @property
    def _dtype(self) -> torch.dtype:
        return torch.int64 if self.words else torch.float32

    # ---------------------------------------------------------------- before each step

    def begin(self, kind: int) -> None:
        """Make sure that the numbers of the next step are on the device. `kind` is the step's kind."""
        if self.taken == self.drawn:
            coming = self.coming or self._draw_later(kind)
            self.first, self.start, numbers = coming.result()
            self.block.copy_(numbers, non_blocking=True)
            self.row.zero_()
            self.taken, self.drawn = 0, BLOCK
            self.coming = self._draw_later((self.first + BLOCK) % len(self.kinds))
        if (self.first + self.taken) % len(self.kinds) != kind:
            raise RuntimeError(
                "the kinds of gradient steps do not alternate: `update` must add 1 to `updates` in every call"
            )
        self.taken += 1

    # ---------------------------------------------------------------- within a step, on the device

    def read(self, kind: int) -> None:
        """Read the numbers of the next step. `take` then returns them draw by draw."""
        self.step = self.block.index_select(1, self.row)[:, 0]
        self.row += 1
        self.draws, self.position, self.offset = self.kinds[kind], 0, 0

    def take(self, draw: Draw) -> Tensor:
        """The numbers (seeds, *shape) of the step's next draw. Raises RuntimeError if that is not `draw`."""
        if self.step is None or self.position == len(self.draws) or self.draws[self.position] != draw:
            raise RuntimeError(
                f"a gradient step draws {draw}, unlike the step before it; every step must make the same draws"
            )
        numbers = self.step[:, self.offset : self.offset + draw.size].reshape(-1, *draw.shape)
        self.position, self.offset = self.position + 1, self.offset + draw.size
        return numbers

    # ---------------------------------------------------------------- the streams

    def state(self, i: int) -> Tensor:
        """The state that generator i would have if every step had drawn its own numbers."""
        generator = torch.Generator()
        generator.set_state(self.start[i])
        for step in range(self.taken):
            for draw in self.kinds[(self.first + step) % len(self.kinds)]:
                draw.skip(generator)
        return generator.get_state()

    def rewind(self) -> None:
        """Discard the numbers that no step has taken, and put the generators back to the state before them."""
        states = [self.state(i) for i in range(len(self.generators))]
        if self.coming:
            self.coming.result()
        for generator, state in zip(self.generators, states, strict=True):
            generator.set_state(state)
        self.start, self.coming, self.taken, self.drawn = states, None, 0, 0

    def _draw_later(self, first: int) -> Future[_Block]:
        # In pinned memory, the CPU need not wait for the copy to the GPU. PyTorch reuses it only after that copy.
        numbers = torch.empty(self.block.shape, dtype=self._dtype, pin_memory=self.pinned)
        return self.worker.submit(self._draw, first, numbers)

    def _draw(self, first: int, numbers: Tensor) -> _Block:
        start = [generator.get_state() for generator in self.generators]
        draws = self.kinds[0]
        joined = len(draws) == 1 and draws[0].joins and all(other == draws for other in self.kinds)
        for rows, generator in zip(numbers, self.generators, strict=True):
            if joined:
                draws[0].fill(rows, generator)
            else:
                self._draw_steps(first, rows, generator)
        return _Block(first, start, numbers)

    def _draw_steps(self, first: int, rows: Tensor, generator: torch.Generator) -> None:
        for step, row in enumerate(rows.unbind()):
            draws = self.kinds[(first + step) % len(self.kinds)]
            offset = 0
            for draw in draws:
                draw.fill(row[offset : offset + draw.size], generator)
                offset += draw.size
