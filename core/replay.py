"""Replay buffer: the last transitions of every seed, one row each, sampled with one gather."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from core.random import Streams

MOST_WAITING = 1000
"""The most environment steps whose transitions wait before they go into the buffer together."""


class Batch(NamedTuple):
    """Transitions (seeds, batch, features). The replay buffer has the columns in the same order.

    The centres are None if the algorithm stores none.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor  # (seeds, batch)
    terminated: Tensor  # (seeds, batch): 1 if the episode terminated, 0 otherwise, also at a time limit
    next_obs: Tensor
    center: Tensor | None = None
    next_center: Tensor | None = None


class Replay:
    """A ring of `capacity` transitions for each seed."""

    def __init__(
        self,
        seeds: Sequence[int],
        capacity: int,
        obs_dim: int,
        action_dim: int,
        centers: bool,
        device: torch.device | str = "cpu",
    ):
        self.capacity = capacity
        # Most observations are stored twice: as next_obs, and as obs of the next row. Each transition is therefore one
        # stretch of memory, and sampling is bound by memory latency.
        center_dim = action_dim if centers else 0
        widths = {"obs": obs_dim, "action": action_dim, "reward": 1, "terminated": 1, "next_obs": obs_dim}
        widths |= {"center": center_dim, "next_center": center_dim}
        self.widths = [widths[column] for column in Batch._fields if widths[column]]
        self.device = torch.device(device)
        self._rows = torch.empty(len(seeds) * capacity, sum(self.widths), device=device)
        self.offsets = torch.arange(len(seeds), device=device).unsqueeze(1) * capacity
        self._rows[self.offsets] = 0.0  # a seed that fails at its first step has no transitions and samples this row
        self.everyone = [*range(len(seeds))]
        self.added = [0] * len(seeds)
        # Transitions that each seed can sample, as they were when `sizes_of` transitions had been added.
        self.sizes, self.sizes_of = torch.ones(len(seeds), 1, dtype=torch.int64, device=device), [0] * len(seeds)
        # New transitions. They go to the device and into the buffer together, before the buffer is read.
        self.waiting: list[Tensor] = []
        self.places: list[int] = []
        self.most_waiting = min(capacity, MOST_WAITING)  # so that no place occurs twice
        self.streams = Streams(seeds, "replay", device)

    @property
    def rows(self) -> Tensor:
        """All transitions (seeds * capacity, features)."""
        self.flush()
        return self._rows

    def add(self, which: Sequence[int], transitions: Batch) -> None:
        """Append a transition to each seed in the positions `which`.

        All columns are (seeds, features); `reward` and `terminated` are (seeds, 1).
        """
        which = list(which)
        rows = torch.cat([column for column in transitions if column is not None], dim=-1)
        self.waiting.append(rows if which == self.everyone else rows[which])
        for i in which:
            self.places.append(i * self.capacity + self.added[i] % self.capacity)
            self.added[i] += 1
        if len(self.waiting) == self.most_waiting:
            self._put()

    def flush(self) -> None:
        """Put the waiting transitions into the buffer, without waiting for the device."""
        if self.waiting:
            self._put()
        if self.sizes_of != self.added:
            self.sizes.copy_(self._there(torch.tensor(self._sizes()).unsqueeze(1)), non_blocking=True)
            self.sizes_of = list(self.added)

    def _put(self) -> None:
        places, rows = self._there(torch.tensor(self.places)), self._there(torch.cat(self.waiting))
        self._rows.index_copy_(0, places, rows)
        self.waiting, self.places = [], []

    def stretch(self, i: int, start: int, stop: int) -> list[Tensor]:
        """Views of the rows of transitions `start` to `stop` - 1 of the seed in position i, counted from its first
        one; two views where the ring wraps. Only the last `capacity` transitions are there."""
        ring = self.rows[i * self.capacity : (i + 1) * self.capacity]
        first, last = start % self.capacity, stop % self.capacity
        if first < last or start == stop:
            return [ring[first:last]]
        return [ring[first:], ring[:last]] if last else [ring[first:]]

    def sample(self, batch_size: int) -> Batch:
        """Draw `batch_size` transitions of every seed, uniformly with replacement."""
        indices = self.streams.indices(self._sizes(), batch_size, self.sizes) + self.offsets
        rows = self.rows.index_select(0, indices.flatten()).view(*indices.shape, -1)
        obs, action, reward, terminated, next_obs, *centers = rows.split(self.widths, dim=-1)
        return Batch(obs, action, reward[..., 0], terminated[..., 0], next_obs, *(centers or (None, None)))

    def _sizes(self) -> list[int]:
        """Transitions that each seed can sample."""
        return [min(max(n, 1), self.capacity) for n in self.added]

    def _there(self, tensor: Tensor) -> Tensor:
        """Move a CPU tensor to the device."""
        return tensor.pin_memory().to(self.device, non_blocking=True) if self.device.type == "cuda" else tensor
