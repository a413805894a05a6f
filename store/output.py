"""Lets a command continue its work when it cannot print.

A pipe may have lost its reader (`| head`, Ctrl-C under `| tee`), a terminal may be gone, the disk of a log may be full,
a stream may be closed from the start, and an encoding may lack a character.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


@contextmanager
def forgiving_output() -> Iterator[None]:
    """While this context is open, no failure to print raises an exception. At its end, all output is flushed."""
    _fill_descriptors()
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _Forgiving(sys.stdout), _Forgiving(sys.stderr)  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


def _fill_descriptors() -> None:
    """Open the descriptors that the shell has closed (`>&-`). Otherwise the next opened file would get the output."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


class _Forgiving:
    """A stream that ignores failures to write. After the first failure, it discards everything."""

    def __init__(self, stream: Any):
        if stream is None or getattr(stream, "closed", False):
            stream = open(os.devnull, "w")  # noqa: SIM115
        self._stream = stream
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except (OSError, ValueError):
            self._give_up()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._give_up()

    def _give_up(self) -> None:
        # The text in the buffer goes to the null device too. Otherwise Python would fail at its exit.
        with suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
        with suppress(OSError, ValueError):
            self._stream.flush()
