"""The definition of a task, and the table that checks tasks and registers them with Gymnasium."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import cloudpickle
import gymnasium
from gymnasium.envs.registration import WrapperSpec

from constraints import Constraint
from core.words import NameTable
from envs.check import check_class
from envs.robot import Robot

_NOT_NAMES = {"all", "figures", "tables"}  # a word of the command line, and folders beside those of the tasks


@dataclass(frozen=True)
class Task:
    """A robot under an action constraint, with the length of a training run.

    `robot` is a class. `constraint` is the feasible set, the action box included; `description` in words and `formula`
    in LaTeX give it without the box. `steps` are the environment steps of a training run. TypeError or ValueError if a
    part has the wrong type or does not fit the others.
    """

    robot: type[Robot]
    constraint: Constraint
    description: str
    formula: str
    steps: int

    def __post_init__(self) -> None:
        robot, constraint, steps = self.robot, self.constraint, self.steps
        check_class(robot)
        if not isinstance(constraint, Constraint):
            raise TypeError(f"a task's constraint must be an instance of constraints.Constraint, got {constraint!r}")
        if constraint.dim != robot.action_dim:
            raise ValueError(
                f"the constraint is for {constraint.dim} action coordinates,"
                f" but the robot {robot.__name__} has {robot.action_dim}"
            )
        for name in ("description", "formula"):
            if not isinstance(getattr(self, name), str):
                raise TypeError(f"a task's {name} must be text, got {getattr(self, name)!r}")
        if not isinstance(steps, int) or isinstance(steps, bool) or steps < 1:
            raise ValueError(f"a task's steps must be a whole number of at least 1, got {steps!r}")

    def __copy__(self) -> Task:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Task:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a task of the table as its name, with its definition for a process that does not know the name."""
        name = next((name for name, task in TASKS.items() if task is self), None)
        parts = self.robot, self.constraint, self.description, self.formula, self.steps
        return _find_or_make, (name, cloudpickle.dumps(parts))


def _find_or_make(name: str | None, parts: bytes) -> Task:
    return TASKS[name] if name in TASKS else Task(*cloudpickle.loads(parts))


def gymnasium_id(name: str) -> str:
    """The identifier of the task `name` for `gymnasium.make`; it cannot hold a "+"."""
    return f"acrl/{name.replace('+', '-')}-v0"


class Tasks(NameTable[Task]):
    """The table of tasks, name -> `Task`. A new row is checked and registered with Gymnasium.

    A name consists of letters, digits and the signs + - _ . and begins with a letter or a digit. Raises ValueError for
    any other name and if the name or its Gymnasium identifier is taken, and TypeError if the value is not a `Task`.
    `del TASKS[name]` frees the name.
    """

    def __init__(self) -> None:
        super().__init__("task")

    def __setitem__(self, name: str, task: Task) -> None:
        if not isinstance(name, str) or not re.fullmatch(r"[^\W_][\w+.-]*", name) or name.lower() in _NOT_NAMES:
            raise ValueError(
                f"bad name {name!r} for a task: expected letters, digits and + - _ . with a letter or a digit first,"
                f" and not one of the words {', '.join(map(repr, sorted(_NOT_NAMES)))}"
            )
        if not isinstance(task, Task):
            raise TypeError(f"the row {name} of envs.TASKS must be an envs.Task, got {task!r}")
        self.check_free(name)
        identifier = gymnasium_id(name)
        before = gymnasium.registry.get(identifier)
        if before is not None and before.kwargs.get("task") != name:
            other = next((other for other in self if gymnasium_id(other) == identifier), "another package")
            raise ValueError(f"the task {name} needs the identifier {identifier}, which {other} has already")
        gymnasium.registry.pop(identifier, None)  # the same row, if its module is loaded a second time
        gymnasium.register(
            identifier,
            entry_point="envs.constrained:ActionConstrainedEnv",
            max_episode_steps=int(task.robot.max_episode_steps),
            additional_wrappers=(WrapperSpec("GivenTimeLimit", "envs.constrained:GivenTimeLimit", {}),),
            kwargs={"task": name},
        )
        super().__setitem__(name, task)

    def __delitem__(self, name: str) -> None:
        super().__delitem__(name)
        del gymnasium.registry[gymnasium_id(name)]


TASKS = Tasks()
"""All tasks; `envs.tasks` adds the paper's."""
