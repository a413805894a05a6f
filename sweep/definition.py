"""What a cell trains on, and the refusal to take a run of another definition for one of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator

from algos import ALGORITHMS
from core.words import ConfigError
from envs import TASKS
from store.checkpoint import saved_step
from store.definition import Description, describe, differences, is_own
from store.folder import has_ended, read_definition
from sweep.cells import Cell


def define(task: str, algo: str) -> dict[str, Description]:
    """The descriptions of the task and of the algorithm, as definition.json has them."""
    robot, algorithm = TASKS[task].robot, ALGORITHMS[algo]
    public = {name: getattr(robot, name) for name in dir(robot) if not name.startswith("_")}
    numbers = {name: value for name, value in public.items() if isinstance(value, (int, float, str))}
    parts: dict[str, Any] = {f"robot.{name}": value for name, value in numbers.items()}
    if isinstance(identifier := public.get("identifier"), str):  # of a Gymnasium environment, which may be one's own
        spec = gymnasium.spec(identifier)
        parts |= {"robot.environment": spec.entry_point, "robot.settings": spec.kwargs}
        if isinstance(spec.entry_point, str):
            parts["robot.environment"] = load_env_creator(spec.entry_point)
    how = {"agent": algorithm.agent, "map": algorithm.map, "placement": algorithm.placement}
    return {
        "task": describe({"constraint": TASKS[task].constraint, "robot": robot, **parts}),
        "algorithm": describe({**how, "penalty": algorithm.penalty}),
    }


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
    before = read_definition(folder)
    way_out = "overwrite=true starts it again and keeps the old one"
    if before is None:
        if not all(map(is_own, now.values())):
            raise ConfigError(
                f"{folder} does not tell on which definition of its task and algorithm it was trained; {way_out}"
            )
        return
    for part, description in now.items():
        if changed := differences(before[part], description):
            raise ConfigError(f"{folder} was trained on another definition of its {part}: {changed}; {way_out}")
