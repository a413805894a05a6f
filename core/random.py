"""Random streams: every seed owns one generator for each purpose, so that no seed depends on its neighbours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from core.ahead import Ahead, Draw

PURPOSES = ("init", "explore", "replay", "update", "environment", "evaluation")


def stream_seed(seed: int, purpose: str, index: int = 0) -> int:
    """The 31-bit seed of one stream: a hash of the run's seed, the purpose and an index within the purpose."""
    sequence = np.random.SeedSequence((seed, PURPOSES.index(purpose), index))
    return int(sequence.generate_state(1)[0] >> 1)


class Streams:
    """One generator per seed for one purpose. A draw stacks the numbers that each seed would draw alone.

    Numbers are drawn on the CPU and then moved to `device`. Algorithms use `normal` and `uniform`; `indices` is for the
    replay buffer.
    """

    def __init__(self, seeds: Sequence[int], purpose: str, device: torch.device | str = "cpu"):
        self.device = torch.device(device)
        self.generators = [torch.Generator().manual_seed(stream_seed(seed, purpose)) for seed in seeds]
        self.recorded: list[Draw] | None = None  # the draws since it was set to an empty list
        self.ahead: Ahead | None = None  # the numbers of future gradient steps, if these are captured

    def normal(self, *shape: int, which: Iterable[int] | None = None) -> Tensor:
        """Standard normal numbers (seeds, *shape). Rows outside `which` are zero and their streams stay untouched."""
        return self._numbers(Draw("normal", shape), which)

    def uniform(self, *shape: int, which: Iterable[int] | None = None) -> Tensor:
        """Uniform numbers (seeds, *shape) in [-1, 1); `which` as in `normal`."""
        return self._numbers(Draw("uniform", shape), which)

    def indices(self, sizes: Sequence[int], count: int, sizes_there: Tensor | None = None) -> Tensor:
        """(seeds, count) integers on the device, row i uniform in [0, sizes[i]).

        `sizes_there` (seeds, 1) are the same sizes on the device, for steps that are captured.
        """
        draw = Draw("words", (count,))
        if self.ahead:
            return self.ahead.take(draw) % sizes_there  # as `randint` turns a word into a number
        self._record(draw)
        draws = [torch.randint(n, draw.shape, generator=g) for n, g in zip(sizes, self.generators, strict=True)]
        return torch.stack(draws).to(self.device)

    def state(self, i: int) -> Tensor:
        """The state of the generator of the seed in position i, as if no numbers had been drawn ahead."""
        return self.ahead.state(i) if self.ahead else self.generators[i].get_state()

    def load_state(self, i: int, state: Tensor) -> None:
        """Put what `state` returned back into position i."""
        if self.ahead:
            self.ahead.rewind()
            self.ahead.start[i] = state
        self.generators[i].set_state(state)

    def _record(self, draw: Draw) -> None:
        if self.recorded is not None:
            self.recorded.append(draw)

    def _numbers(self, draw: Draw, which: Iterable[int] | None) -> Tensor:
        if self.ahead or self.recorded is not None:
            if which is not None:
                raise ValueError("a gradient step draws for all seeds; `which` is only for exploration")
            if self.ahead:
                return self.ahead.take(draw)
            self._record(draw)
        everyone = which is None
        out = (torch.empty if everyone else torch.zeros)(len(self.generators), *draw.shape)
        rows = out.unbind()
        for i in range(len(rows)) if everyone else which:
            draw.fill(rows[i], self.generators[i])
        return out.to(self.device)
