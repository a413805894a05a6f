"""Calls that run beside each other: simulators in C release Python's lock while they compute."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

FEWEST = 2
"""Calls for which another thread is worth the time that waking it takes."""


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
    """The threads of this process; those of a process do not live on in one that it forks."""
    return ThreadPoolExecutor(os.cpu_count())
