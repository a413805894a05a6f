"""Calls that run in parallel threads: simulators in C release Python's lock while they compute."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

FEWEST = 2
"""The fewest calls for which it pays to wake another thread."""


def call_each(calls: Sequence[Callable[[], None]], threads: int) -> None:
    """Make all `calls`, in up to `threads` threads, this one included. Raises what a call raises."""
    parts = max(min(threads, len(calls) // FEWEST), 1)
    bounds = [part * len(calls) // parts for part in range(parts + 1)]
    mine, *others = (calls[start:stop] for start, stop in zip(bounds, bounds[1:], strict=False))
    running = [_pool(os.getpid()).submit(_call, part) for part in others]
    _call(mine)
    for part in running:
        part.result()


def _call(calls: Sequence[Callable[[], None]]) -> None:
    for call in calls:
        call()


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """The threads of this `process`. A forked process needs its own, because threads do not survive a fork."""
    return ThreadPoolExecutor(os.cpu_count())
