"""Writing files safely, and errors as one line."""

from __future__ import annotations

import errno
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
            _sync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)  # so that the new name survives a crash
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()  # it would take space on a full disk
        raise OSError(error.errno, error.strerror, str(path)) from error


def user_path(text: str | Path) -> Path:
    """The path that a user means: a leading ~ is their home, ~name the home of another user, if there is one."""
    return Path(os.path.expanduser(text))  # Path.expanduser raises RuntimeError for an unknown name


def _sync_folder(path: Path) -> None:
    try:
        folder = os.open(path, os.O_RDONLY)
    except PermissionError:  # a folder can be writable but not readable
        return
    try:
        _sync(folder)
    finally:
        os.close(folder)


def _sync(descriptor: int) -> None:
    """Wait until the content is on disk. Some file systems cannot do that, for folders or at all: then do not wait."""
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOSYS, errno.EOPNOTSUPP, errno.EACCES, errno.EPERM):
            raise


def one_line(error: Exception) -> str:
    """The message of `error` for the user, in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return " ".join(str(error).split())
