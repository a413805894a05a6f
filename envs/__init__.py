"""The paper's 13 tasks as Gymnasium environments: `make("W+M")`, or `gymnasium.make("acrl/W-M-v0")`.

Importing this package registers the tasks with Gymnasium. Its identifiers cannot hold a "+", so there it is
written "-".
"""

import gymnasium

from envs.constrained import TOLERANCE, ActionConstrainedEnv, InfeasibleActionError, find_task, step_together
from envs.tasks import TASKS, Task

__all__ = [
    "TASKS",
    "TOLERANCE",
    "ActionConstrainedEnv",
    "InfeasibleActionError",
    "Task",
    "constraint",
    "make",
    "step_together",
]


def make(task, project=False, render_mode=None):
    """The environment of `task` (a key of `TASKS`, as "W+M"); see `ActionConstrainedEnv`.

    An infeasible action is refused with `InfeasibleActionError`; with `project` it is projected instead, so
    that any agent for Gymnasium trains on it as the paper's DPre does. ValueError for an unknown task.
    """
    return ActionConstrainedEnv(task, project, render_mode)


def constraint(task):
    """The `constraints.Constraint` of `task` (a key of `TASKS`); ValueError for an unknown task."""
    return find_task(task).constraint


for _name in TASKS:
    gymnasium.register(
        f"acrl/{_name.replace('+', '-')}-v0",
        entry_point="envs.constrained:ActionConstrainedEnv",
        kwargs={"task": _name},
    )
