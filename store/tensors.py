"""Files of tensors with a checksum, so that damage is noticed: a line with the SHA-256, then a `torch.save`."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from store.files import replace_file


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Replace the file `path` by `content`, as `replace_file` does. Raises OSError."""
    body = io.BytesIO()
    torch.save(dict(content), body)
    digest = hashlib.sha256(body.getbuffer()).hexdigest().encode() + b"\n"
    replace_file(path, lambda file: file.writelines([digest, body.getbuffer()]))


def load_tensors(path: Path) -> dict[str, Any]:
    """Read what `save_tensors` wrote. Raises ValueError for a wrong checksum, OSError for an unreadable file."""
    with open(path, "rb") as file:
        digest = file.readline(100).rstrip(b"\n").decode("ascii", "replace")
        body = io.BytesIO(file.read())
    if hashlib.sha256(body.getbuffer()).hexdigest() != digest:
        raise ValueError("wrong checksum")
    return torch.load(body, weights_only=True)
