"""Exit codes of a command, and the errors behind them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from enum import IntEnum

from constraints import ConstraintError
from core.words import ConfigError
from store.checkpoint import FormatError
from store.files import one_line
from store.interrupt import Interrupted, Interrupts
from store.lock import LockedError


class Exit(IntEnum):
    """Exit codes; 128 + n means that signal n ended the command."""

    DONE = 0
    BAD_INPUT = 2
    DIVERGED = 3  # trained to the end, but a seed diverged
    FAILED = 4  # a cell of a sweep failed


def stoppable(command: Callable[[Callable[[], None]], Exit]) -> Exit:
    """Run `command` with a function that raises Interrupted after a signal to stop."""
    with Interrupts() as interrupts:
        return command(interrupts.stop_if_asked)


def exit_code(command: Callable[[], Exit]) -> int:
    """Run `command` and return its exit code. An error that the user can correct becomes one line on stderr."""
    try:
        return command()
    except (ConfigError, ConstraintError, FormatError, LockedError) as error:
        print(f"run.py: {one_line(error)}", file=sys.stderr)
        return Exit.BAD_INPUT
    except OSError as error:
        print(f"run.py: {error.filename or 'system'}: {one_line(error)}", file=sys.stderr)
        return Exit.BAD_INPUT
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except Interrupted as interrupted:
        return 128 + interrupted.signum
