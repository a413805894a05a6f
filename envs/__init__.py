"""The paper's 13 tasks as Gymnasium environments: `make("W+M")`, or `gymnasium.make("acrl/W-M-v0")`.

Importing this package registers the tasks with Gymnasium. Its identifiers cannot hold a "+", so there it is
written "-".
"""

import gymnasium

from constraints import Constraint
from envs.constrained import TOLERANCE, ActionConstrainedEnv, InfeasibleActionError, find_task, step_together
from envs.robot import Robot, UnavailableError
from envs.tasks import TASKS, Task
from envs.wrapper import Constrained

__all__ = [
    "TASKS",
    "TOLERANCE",
    "ActionConstrainedEnv",
    "Constrained",
    "InfeasibleActionError",
    "Robot",
    "Task",
    "UnavailableError",
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
) -> ActionConstrainedEnv:
    """The environment of `task` (a key of `TASKS`, as "W+M"); see `ActionConstrainedEnv`.

    An infeasible action is refused with `InfeasibleActionError`; with `project` it is projected instead, so
    that any agent for Gymnasium trains on it as the paper's DPre does. `simulator="pybullet"` runs Reacher on PyBullet,
    where that is installed. `show_set` draws the feasible set of a two-dimensional action into pictures.

    Raises ValueError for an unknown task, and UnavailableError, a ValueError too, for a simulator that the robot does
    not have or that is not installed.
    """
    return ActionConstrainedEnv(task, project, render_mode, simulator, show_set)


def constraint(task: str) -> Constraint:
    """The `constraints.Constraint` of `task` (a key of `TASKS`); ValueError for an unknown task."""
    return find_task(task).constraint


# Any task, those added to `TASKS` as well: gymnasium.make("acrl/Task-v0", task="R+CBF").
gymnasium.register("acrl/Task-v0", entry_point="envs.constrained:ActionConstrainedEnv")
for _name in TASKS:
    gymnasium.register(
        f"acrl/{_name.replace('+', '-')}-v0",
        entry_point="envs.constrained:ActionConstrainedEnv",
        kwargs={"task": _name},
    )
