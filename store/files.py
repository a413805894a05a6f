"""Files that are whole at any moment, and errors in one line."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any


def replace_file(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Write a file so that `path` holds the old content or all of the new, whenever the process or the machine dies.

    OSError that names the file where it cannot be written.
    """
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # makes the new name last
        finally:
            os.close(folder)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()  # on a full disk it would be in the way
        raise OSError(error.errno, error.strerror, str(path)) from error


def one_line(error: Exception) -> str:
    """What `error` says to the user."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return " ".join(str(error).split())
