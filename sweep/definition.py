"""The definition of a cell's task and algorithm, and the search for runs that were trained on another definition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NoReturn

from algos import ALGORITHMS, definition
from algos.definition import changes
from core.words import ConfigError
from envs import TASKS
from store.checkpoint import CheckpointFolder
from store.definition import Description, is_own
from store.folder import has_ended, read_definition
from sweep.cells import Cell


def define(task: str, algo: str) -> dict[str, Description]:
    """The descriptions of the task and of the algorithm, as in definition.json."""
    return definition.define(TASKS[task].robot, TASKS[task].constraint, ALGORITHMS[algo])


def find_changed(cells: Sequence[Cell]) -> dict[Path, str]:
    """The runs of `cells` that were trained on another definition, as `changed_runs` finds them."""
    defined = cache(define)
    found: dict[Path, str] = {}
    for cell in cells:
        found |= changed_runs(cell.folders, defined(cell.config.env, cell.config.algo))
    return found


def changed_runs(folders: Iterable[Path], now: Mapping[str, Description]) -> dict[Path, str]:
    """The runs in `folders` that were trained on another definition than `now`, each with a text for messages.

    Only runs that have ended or have a checkpoint count: others start again anyway. A run without definition.json is
    accepted for the project's own tasks and algorithms, because older runs have none.
    """
    found = {}
    for folder in folders:
        if not has_ended(folder) and not CheckpointFolder(folder).folder.exists():
            continue
        if read_definition(folder) is None:
            if not all(map(is_own, now.values())):
                found[folder] = "has no readable definition.json, so its task or algorithm may have changed"
        elif changed := changes(folder, now):
            found[folder] = f"was trained with {changed}"
    return found


def refuse(changed: Mapping[Path, str]) -> NoReturn:
    """Raise ConfigError for runs of another definition, `changed`, as the command does not say what to do with them."""
    (folder, said), *others = changed.items()
    more = f" (the same holds for {len(others)} more)" if others else ""
    raise ConfigError(f"{folder} {said}{more}; overwrite=changed starts such runs again and keeps the old ones")
