"""What a cell trains on, and the refusal to take a run of another definition for one of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from algos import ALGORITHMS, definition
from algos.definition import changes
from core.words import ConfigError
from envs import TASKS
from store.checkpoint import saved_step
from store.definition import Description, is_own
from store.folder import has_ended, read_definition
from sweep.cells import Cell


def define(task: str, algo: str) -> dict[str, Description]:
    """The descriptions of the task and of the algorithm, as definition.json has them."""
    return definition.define(TASKS[task].robot, TASKS[task].constraint, ALGORITHMS[algo])


def check_definitions(cells: Sequence[Cell]) -> None:
    """Raise ConfigError if a run of `cells` that has ended, or can resume, was trained on another definition."""
    defined = cache(define)
    for cell in cells:
        if not cell.config.overwrite:
            for folder in cell.folders:
                if has_ended(folder) or saved_step(folder):
                    check_definition(folder, defined(cell.config.env, cell.config.algo))


def check_definition(folder: Path, now: Mapping[str, Description]) -> None:
    """Raise ConfigError if the run in `folder` was trained on another definition than `now`.

    Runs of the project's own tasks and algorithms may be older than definitions.
    """
    way_out = "overwrite=true starts it again and keeps the old one"
    if read_definition(folder) is None:
        if not all(map(is_own, now.values())):
            raise ConfigError(
                f"{folder} does not tell on which definition of its task and algorithm it was trained; {way_out}"
            )
        return
    if changed := changes(folder, now):
        raise ConfigError(f"{folder} was trained on {changed}; {way_out}")
