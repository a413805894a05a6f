"""Writing files safely, and errors as one line."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any


def replace_file(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Replace the file `path`: after a crash at any point, it holds the old content or all of the new.

    `write` receives the open file. Raises an OSError that names `path` if it cannot be written.
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
            os.fsync(folder)  # so that the new name survives a crash
        finally:
            os.close(folder)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()  # it would take space on a full disk
        raise OSError(error.errno, error.strerror, str(path)) from error


def one_line(error: Exception) -> str:
    """The message of `error` for the user, in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return " ".join(str(error).split())
