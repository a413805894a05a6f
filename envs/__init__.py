"""The paper's 13 tasks as Gymnasium environments: `make("W+M")`, or `gymnasium.make("acrl/W-M-v0")`.

Importing this package registers the tasks with Gymnasium; a new row of `TASKS` is registered at once. Gymnasium's
identifiers cannot contain a "+" and have a "-" instead.
"""

import copy
from typing import Any

import gymnasium
import numpy as np

from constraints import Constraint
from envs.check import check_robot
from envs.constrained import TOLERANCE, ActionConstrainedEnv, InfeasibleActionError, find_task, step_together
from envs.gymnasium_robot import GymnasiumRobot
from envs.registry import Task, gymnasium_id
from envs.robot import Robot, RobotError, UnavailableError
from envs.tasks import TASKS
from envs.wrapper import Constrained

__all__ = [
    "TASKS",
    "TOLERANCE",
    "ActionConstrainedEnv",
    "Constrained",
    "GymnasiumRobot",
    "InfeasibleActionError",
    "Robot",
    "RobotError",
    "Task",
    "UnavailableError",
    "check_robot",
    "constraint",
    "make",
    "step_together",
]


def make(
    task: str,
    project: bool = False,
    render_mode: str | None = None,
    simulator: str | None = None,
    show_set: bool = False,
    dtype: Any = np.float64,
) -> ActionConstrainedEnv:
    """The environment of `task` (a key of `TASKS`, such as "W+M"); see `ActionConstrainedEnv`.

    An infeasible action raises `InfeasibleActionError`. With `project` it is projected instead, so that any Gymnasium
    agent can train as the paper's DPre does. `simulator="pybullet"` runs Reacher on PyBullet, if that is installed.
    `show_set` draws the feasible set of a two-dimensional action into pictures. `dtype=np.float32` returns observations
    in that precision; actions are still checked at the exact observations.

    Raises ValueError for an unknown task, and its subclass UnavailableError for a simulator that the robot does not
    have or that is not installed.
    """
    settings: dict[str, Any] = {"project": project, "render_mode": render_mode, "simulator": simulator}
    settings |= {"show_set": show_set, "dtype": np.dtype(dtype).name}
    env = ActionConstrainedEnv(task, **settings)
    env.spec = copy.deepcopy(gymnasium.spec(gymnasium_id(task)))
    env.spec.kwargs.update(settings)
    return env


def constraint(task: str) -> Constraint:
    """The `constraints.Constraint` of `task` (a key of `TASKS`); ValueError for an unknown task."""
    return find_task(task).constraint


# Any task by its name: gymnasium.make("acrl/Task-v0", task="R+CBF").
gymnasium.register("acrl/Task-v0", entry_point="envs.constrained:ActionConstrainedEnv")
