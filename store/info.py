"""Reads a run's info.json, which also lists the user's files that may define its algorithm or task."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from store.origin import is_project


def read_info(folder: str | Path) -> dict[str, Any]:
    """The content of info.json in the folder of a run; empty if it cannot be read."""
    try:
        content = json.loads(Path(folder, "info.json").read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def missing_plugin(folder: str | Path) -> str:
    """The end of an error message for an unknown algorithm or task of a run: the user's files that may define it.

    Empty if the run used no file of the user.
    """
    try:
        files = [source["file"] for source in read_info(folder).get("sources", [])]
        names = ",".join(file for file in files if not is_project(Path(file).parts[0]))
    except (KeyError, TypeError):
        return ""
    return f"; its run used {names}: add plugin={names}" if names else ""
