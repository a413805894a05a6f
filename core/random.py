"""Random streams: every seed owns one generator for each purpose, so that no seed depends on its neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

PURPOSES = ("init", "explore", "replay", "update", "environment", "evaluation")


def stream_seed(seed: int, purpose: str, index: int = 0) -> int:
    """The 31-bit seed of one stream: a hash of the run's seed, the purpose and an index within the purpose."""
    sequence = np.random.SeedSequence((seed, PURPOSES.index(purpose), index))
    return int(sequence.generate_state(1)[0] >> 1)


class Tape:
    """The draws of one gradient step in their order, each with the tensor on the device that holds its numbers.

    It records first. After `rewind` it returns the same tensors again, in the same order, and draws nothing.
    """

    def __init__(self) -> None:
        self.entries: list[tuple[Callable[[], Tensor], Tensor]] = []
        self.position: int | None = None

    def deliver(self, draw: Callable[[], Tensor], device: torch.device) -> Tensor:
        """The numbers of `draw()` on the `device`."""
        if self.position is None:
            self.entries.append((draw, draw().to(device)))
            return self.entries[-1][1]
        self.position += 1
        return self.entries[self.position - 1][1]

    def rewind(self) -> None:
        self.position = 0

    def draw_again(self) -> None:
        """Put new numbers from the streams into the same tensors, without waiting for the device."""
        for draw, numbers in self.entries:
            drawn = draw()
            numbers.copy_(drawn.pin_memory() if numbers.is_cuda else drawn, non_blocking=True)


class Streams:
    """One generator a seed for one purpose. A draw stacks what each seed alone would have drawn.

    Numbers are drawn on the CPU and then moved to the `device`. An algorithm uses `normal` and `uniform`; `indices` is
    for the replay buffer.
    """

    def __init__(self, seeds: Sequence[int], purpose: str, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        self.tape: Tape | None = None  # of the gradient step that is recorded or captured
        self.generators = [torch.Generator().manual_seed(stream_seed(seed, purpose)) for seed in seeds]

    def normal(self, *shape: int, which: Iterable[int] | None = None) -> Tensor:
        """Standard normal numbers (seeds, *shape). Rows outside `which` are zero and their streams stay untouched."""
        return self.deliver(lambda: self._fill(shape, which, lambda row, generator: row.normal_(generator=generator)))

    def uniform(self, *shape: int, which: Iterable[int] | None = None) -> Tensor:
        """Uniform numbers in [-1, 1), otherwise as `normal`."""
        return self.deliver(
            lambda: self._fill(shape, which, lambda row, generator: row.uniform_(-1.0, 1.0, generator=generator))
        )

    def indices(self, sizes: Sequence[int], count: int) -> Tensor:
        """(seeds, count) integers on the CPU, row i uniform in [0, sizes[i])."""
        draws = [torch.randint(n, (count,), generator=g) for n, g in zip(sizes, self.generators, strict=True)]
        return torch.stack(draws)

    def deliver(self, draw: Callable[[], Tensor]) -> Tensor:
        """The numbers that `draw` makes, on the device."""
        return self.tape.deliver(draw, self.device) if self.tape else draw().to(self.device)

    def _fill(self, shape: tuple[int, ...], which: Iterable[int] | None, draw) -> Tensor:
        everyone = which is None
        out = (torch.empty if everyone else torch.zeros)(len(self.generators), *shape)
        for i in range(len(self.generators)) if everyone else which:
            draw(out[i], self.generators[i])
        return out
