"""Random streams: every seed owns one generator for each purpose, so that no seed depends on its neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from core.graph import Tape

PURPOSES = ("init", "explore", "replay", "update", "environment", "evaluation")


def stream_seed(seed: int, purpose: str, index: int = 0) -> int:
    """The 31-bit seed of one stream: a hash of the run's seed, the purpose and an index within the purpose."""
    sequence = np.random.SeedSequence((seed, PURPOSES.index(purpose), index))
    return int(sequence.generate_state(1)[0] >> 1)


class Streams:
    """One generator a seed for one purpose. A draw stacks what each seed alone would have drawn.

    All numbers are drawn on the CPU, whatever the `device` that they are wanted on.
    """

    def __init__(self, seeds: Sequence[int], purpose: str, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        self.tape: Tape | None = None  # of the gradient step that is recorded or captured
        self.generators = [torch.Generator().manual_seed(stream_seed(seed, purpose)) for seed in seeds]

    def normal(self, *shape: int, only: Iterable[int] | None = None) -> Tensor:
        """Standard normal numbers (seeds, *shape). Rows outside `only` are zero and their streams stay untouched."""
        return self.deliver(lambda: self._fill(shape, only, lambda row, generator: row.normal_(generator=generator)))

    def uniform(self, *shape: int, only: Iterable[int] | None = None) -> Tensor:
        """Uniform numbers in [-1, 1), otherwise as `normal`."""
        return self.deliver(
            lambda: self._fill(shape, only, lambda row, generator: row.uniform_(-1.0, 1.0, generator=generator))
        )

    def indices(self, sizes: Sequence[int], count: int) -> Tensor:
        """(seeds, count) integers on the CPU, row i uniform in [0, sizes[i])."""
        draws = [torch.randint(n, (count,), generator=g) for n, g in zip(sizes, self.generators, strict=True)]
        return torch.stack(draws)

    def deliver(self, draw: Callable[[], Tensor]) -> Tensor:
        """The numbers that `draw` makes, on the device."""
        return self.tape.deliver(draw, self.device) if self.tape else draw().to(self.device)

    def _fill(self, shape: tuple[int, ...], only: Iterable[int] | None, draw) -> Tensor:
        everyone = only is None
        out = (torch.empty if everyone else torch.zeros)(len(self.generators), *shape)
        for i in range(len(self.generators)) if everyone else only:
            draw(out[i], self.generators[i])
        return out
