"""Describes a run's task and algorithm, and tells whether their definitions have changed since its training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.registration import load_env_creator

from constraints import Constraint
from store.definition import Description, describe, differences
from store.folder import read_definition


def define(robot: Any, constraint: Constraint, algorithm: Any) -> dict[str, Description]:
    """Describe a task (the class of its robot, and its constraint) and a row of `algos.ALGORITHMS`, as definition.json
    stores them."""
    public = {name: getattr(robot, name) for name in dir(robot) if not name.startswith("_")}
    numbers = {name: value for name, value in public.items() if isinstance(value, (int, float, str))}
    parts: dict[str, Any] = {f"robot.{name}": value for name, value in numbers.items()}
    if isinstance(identifier := public.get("identifier"), str):  # a Gymnasium environment, maybe the user's own
        spec = gymnasium.spec(identifier)
        parts |= {"robot.environment": spec.entry_point, "robot.settings": spec.kwargs}
        if isinstance(spec.entry_point, str):
            parts["robot.environment"] = load_env_creator(spec.entry_point)
    how = {"agent": algorithm.agent, "map": algorithm.map, "placement": algorithm.placement}
    return {
        "task": describe({"constraint": constraint, "robot": robot, **parts}),
        "algorithm": describe({**how, "penalty": algorithm.penalty}),
    }


def changes(folder: Path, now: Mapping[str, Description]) -> str:
    """What has changed since the run in `folder` was trained, in one line; empty if nothing has, or if it is unknown.

    It reads like "another definition of its task: the constraint's bound: 0.05 then, 0.9 now".
    """
    before = read_definition(folder) or {}
    for part, description in now.items():
        if part in before and (changed := differences(before[part], description)):
            return f"another definition of its {part}: {changed}"
    return ""
