"""Turns SIGINT, SIGTERM, SIGHUP, SIGUSR1 and SIGUSR2 into an exception at the next safe point of the training loop."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
"""Ctrl-C, `kill`, a terminal that closes, and the signals that batch systems can send before a job's time limit."""
SAME_EVENT = 1.0
"""Signals within this many seconds of the first one belong to it: `timeout` and shells send theirs twice."""


class Interrupted(Exception):
    """A signal asked the process to stop. `signum` is its number."""

    def __init__(self, signum: int):
        super().__init__(f"interrupted by {signal.Signals(signum).name}")
        self.signum = signum


class Interrupts:
    """While this context is open, the first of SIGNALS is only recorded; `stop_if_asked` then raises Interrupted.

    A second signal ends the process at once, as usual. Signals within SAME_EVENT seconds of the first are ignored, and
    so is every later SIGHUP, which a closing terminal repeats. In a thread other than the main one, where Python allows
    no handlers, signals keep their usual effect.
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self._noted = 0.0  # time.monotonic() of the first signal
        self._previous: dict[int, object] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for signum in SIGNALS:
                # A script may start a process in the background with SIGINT ignored, and it stays ignored.
                if signal.getsignal(signum) is not signal.SIG_IGN:
                    self._previous[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._previous.items():
            signal.signal(signum, handler)  # type: ignore[arg-type]
        self._previous = {}

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is None:
            self.signum, self._noted = signum, time.monotonic()
        elif signum != signal.SIGHUP and time.monotonic() - self._noted > SAME_EVENT:
            self.__exit__()
            signal.raise_signal(signum)

    def stop_if_asked(self) -> None:
        """Raise Interrupted if a signal came."""
        if self.signum is not None:
            raise Interrupted(self.signum)
