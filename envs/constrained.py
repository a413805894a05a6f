"""The Gymnasium environment of a task: a robot that executes feasible actions only."""

from __future__ import annotations

import copy
import importlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch

from constraints import Constraint
from core.words import known_name
from envs.drawing import draw_set
from envs.registry import TASKS, Task
from envs.robot import Robot, Step, UnavailableError

TOLERANCE = 1e-6  # largest violation an executed action may have, in the units of `Constraint.violation`

Outcome = tuple[np.ndarray, float, bool, bool, dict[str, Any]]
"""What `step` of an environment returns: observation (n,), reward, terminated, truncated, info."""


class InfeasibleActionError(ValueError):
    """An action lies outside the task's feasible set at the current observation, or is no action at all."""


def allowed_violation(constraint: Constraint, obs: torch.Tensor, violation: float) -> torch.Tensor:
    """The largest violation (...) that an executed action may have at obs (..., n).

    `violation` is the largest violation among the actions to check. If it is at most 1e-6, the least possible violation
    is not computed.
    """
    if violation > TOLERANCE and constraint.on_empty == "least":
        return TOLERANCE + constraint.least_violation(obs).double()
    return torch.full(obs.shape[:-1], TOLERANCE, dtype=torch.float64, device=obs.device)


def find_task(name: str) -> Task:
    """The `Task` called `name`; ValueError with the choices and the closest name if there is none."""
    return TASKS[known_name("task", name, TASKS)]


def make_robot(name: str, task: Task, simulator: str | None = None) -> Robot:
    """A new robot of `task`, called `name`, on `simulator`, a key of the robot's `simulators`; None means the first.

    Raises UnavailableError for a simulator that the robot does not have or that is not installed.
    """
    robot = task.robot
    if simulator is None:
        return robot()
    if simulator not in robot.simulators:
        choices = f"choices: {', '.join(robot.simulators)}" if robot.simulators else "its robot has only one simulator"
        raise UnavailableError(f"unknown simulator {simulator!r} for {name} ({choices})")
    module, _, name = robot.simulators[simulator].partition(":")
    return getattr(importlib.import_module(module), name)()


def step_together(envs: Sequence[ActionConstrainedEnv], actions: Sequence[np.ndarray] | np.ndarray) -> list[Any]:
    """Step each `ActionConstrainedEnv` of `envs` with its action (d,) of `actions`, all under one violation check.

    Returns a list. An item is what `step` returns or, for a refused action, the InfeasibleActionError that `step`
    raises; the other actions are executed all the same. Each environment behaves bit for bit as it would alone. Robots
    of one class take the step in one call.

    Raises gymnasium.error.ResetNeeded if an environment needs a reset, and ValueError for environments of different
    constraints and for an environment given twice, whose second action would be checked at a past observation. No
    environment has been stepped then.
    """
    if len(set(map(id, envs))) < len(envs) or any(env.constraint is not envs[0].constraint for env in envs):
        raise ValueError("step_together() needs different environments with the same constraint")
    if _all_well_formed(envs, actions):
        outcomes: list[Any] = [*actions]
    else:
        outcomes = [env._well_formed(action) for env, action in zip(envs, actions, strict=True)]
    checked = [k for k, outcome in enumerate(outcomes) if not isinstance(outcome, InfeasibleActionError)]
    if not checked:
        return outcomes
    obs = torch.from_numpy(np.array([envs[k]._obs for k in checked]))
    exact = torch.from_numpy(np.array([outcomes[k] for k in checked], np.float64))
    violations = envs[0].constraint.violation(obs, exact).tolist()
    by_robot: dict[type[Robot], list[int]] = {}
    for k, violation in zip(checked, violations, strict=True):
        outcomes[k] = envs[k]._admit(outcomes[k], violation)
        if not isinstance(outcomes[k], InfeasibleActionError):
            by_robot.setdefault(type(envs[k].robot), []).append(k)
    for robot_class, admitted in by_robot.items():
        steps = robot_class.step_together([envs[k].robot for k in admitted], [outcomes[k] for k in admitted])
        for k, step in zip(admitted, steps, strict=True):
            outcomes[k] = envs[k]._record(outcomes[k], step)
    return outcomes


def _all_well_formed(envs: Sequence[ActionConstrainedEnv], actions: Any) -> bool:
    """Fast test whether all actions are well-formed and all environments ready.

    True is always right; False may be wrong.
    """
    if not envs or not isinstance(actions, np.ndarray) or actions.shape != (len(envs), envs[0].constraint.dim):
        return False
    return all(env._obs is not None for env in envs) and bool(np.isfinite(actions).all())


class ActionConstrainedEnv(gymnasium.Env):
    """A robot under the action constraint of one of the paper's tasks.

    Observations (n,) are of `dtype`, float64 or float32, and actions (d,) lie in [-1, 1]. Before an action is executed,
    its violation is computed in float64 at the robot's own observation, which is float64 for every `dtype`. An action
    whose violation is above 1e-6 is refused. With `project`, an action outside the set is replaced by its projection
    instead, and `info["executed_action"]` holds the executed action (float64, (d,)). The robot's time limit truncates
    episodes. `simulator` chooses among the robot's simulators. With `show_set`, which needs a two-dimensional action
    space, pictures show the last action in the set that was feasible for it.

    An environment can be copied and pickled (also by cloudpickle) at any moment; the copy continues bit for bit as the
    original does. After the end of an episode, step() raises gymnasium.error.ResetNeeded. After close(), reset(),
    step() and render() raise gymnasium.error.ClosedEnvironmentError.

    Attributes: `constraint`; `largest_violation` (float) over all executed actions since construction, -inf before the
    first; `executed_actions` (int), their number; `elapsed_steps` (int) of the current episode; `max_episode_steps`
    (int, None for no limit), the robot's or the one given to `gymnasium.make`.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        task: str,
        project: bool = False,
        render_mode: str | None = None,
        simulator: str | None = None,
        show_set: bool = False,
        dtype: Any = np.float64,
    ):
        self._definition = find_task(task)
        self.constraint = self._definition.constraint
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r} (choices: None, 'rgb_array')")
        if show_set and self.constraint.dim != 2:
            raise ValueError(
                f"show_set=True needs a two-dimensional action; {task} has {self.constraint.dim} dimensions"
            )
        self._dtype = np.dtype(dtype)
        if self._dtype not in (np.float64, np.float32):
            raise ValueError(f"unknown dtype {dtype!r} of observations (choices: float64, float32)")
        self.task, self.project, self.render_mode, self.show_set = task, project, render_mode, show_set
        self._simulator = simulator
        self.robot = make_robot(task, self._definition, simulator)
        self.max_episode_steps: int | None = self.robot.max_episode_steps
        self.metadata = {**self.metadata, "render_fps": self.robot.fps}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.robot.obs_dim,), self._dtype)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.robot.action_dim,), np.float32)
        self.largest_violation, self.executed_actions, self.elapsed_steps = -np.inf, 0, 0
        # A copy of the observation, because callers may write into theirs; None when no step can follow.
        self._obs: np.ndarray | None = None
        self._closed = False
        # The last episode: the state of the random numbers before its reset, and its actions so far. Actions are kept
        # only if the robot has no state of its own.
        self._start: Mapping[str, Any] | None = None
        self._actions: list[np.ndarray] = []
        self._keeps_actions = False
        self._shown: tuple[np.ndarray, np.ndarray] | None = None  # the last action and the observation it belongs to

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode; return observation (n,) and info. `seed` as Gymnasium defines it."""
        self._refuse_closed("reset")
        super().reset(seed=seed)
        self._start, self._actions, self.elapsed_steps = self.np_random.bit_generator.state, [], 0
        self._obs, self._shown = None, None
        obs = self.robot.reset(self.np_random)
        self._keeps_actions = self.robot.get_state() is None
        self._obs = obs.copy()
        return obs.astype(self._dtype, copy=False), {}

    def step(self, action: np.ndarray) -> Outcome:
        """Execute `action` (d,); return observation, reward, terminated, truncated, info.

        Raises InfeasibleActionError for a wrong shape, a value that is not finite or, without `project`, a
        violation above 1e-6; gymnasium.error.ResetNeeded before the first reset and after the end of an episode.
        """
        (outcome,) = step_together([self], [action])
        if isinstance(outcome, InfeasibleActionError):
            raise outcome
        return outcome

    def get_state(self) -> dict[str, Any]:
        """The state from which `set_state` continues bit for bit, in any process: a dict of numbers, text and tensors.

        An episode in progress is kept as the robot's own state. If the robot has none, the random numbers before its
        reset and the actions since are kept. Between episodes, the random numbers are enough.
        """
        self._refuse_closed("get_state")
        in_episode = self._obs is not None
        robot = self.robot.get_state() if in_episode else None
        repeats = in_episode and robot is None
        actions = self._actions if repeats else []
        return {
            "random_numbers": json.dumps(self._start if repeats else self.np_random.bit_generator.state),
            "in_episode": in_episode,
            "simulator": type(self.robot).__name__,
            "robot": None if robot is None else torch.from_numpy(robot),
            "actions": torch.from_numpy(np.array(actions)) if actions else None,
            "single": torch.tensor([action.dtype == np.float32 for action in actions]) if actions else None,
            "elapsed_steps": self.elapsed_steps,
            "executed_actions": self.executed_actions,
            "largest_violation": self.largest_violation,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `get_state`; if its episode had ended, call reset() next.

        A robot without a state of its own repeats an episode in progress. Raises ValueError for the state of another
        robot or simulator.
        """
        self._refuse_closed("set_state")
        if state.get("simulator") != type(self.robot).__name__:
            raise ValueError(f"the state of {state.get('simulator')} does not fit {type(self.robot).__name__}")
        self.np_random.bit_generator.state = json.loads(state["random_numbers"])
        self._start, self._actions, self._obs, self._shown = None, [], None, None
        if state["robot"] is not None:
            self._start, self._keeps_actions = self.np_random.bit_generator.state, False
            self._obs = self.robot.set_state(state["robot"].numpy()).copy()
        elif state["in_episode"]:
            self._start, self._keeps_actions = self.np_random.bit_generator.state, True
            self._actions = [] if state["actions"] is None else list(state["actions"].numpy())
            if state.get("single") is not None:  # the array has the wider precision
                precisions = [np.float32 if single else np.float64 for single in state["single"]]
                self._actions = [a.astype(p) for a, p in zip(self._actions, precisions, strict=True)]
            self._obs = self._repeat()
        self.elapsed_steps = state["elapsed_steps"]
        self.executed_actions, self.largest_violation = state["executed_actions"], state["largest_violation"]

    def render(self) -> np.ndarray | None:
        """Picture (h, w, 3), uint8, of the current state; None without `render_mode="rgb_array"`."""
        self._refuse_closed("render")
        if self.render_mode != "rgb_array":
            return None
        picture = self.robot.render()
        if self.show_set and (self._shown or self._obs is not None):
            obs, action = self._shown or (self._obs, None)
            picture = draw_set(picture, self._boundary(obs), action)
        return picture

    def close(self) -> None:
        """Free simulator and renderer; closing twice is harmless."""
        self.robot.close()
        self._obs, self._closed = None, True

    def __copy__(self) -> ActionConstrainedEnv:
        return copy.deepcopy(self)  # two environments never share a simulator or random numbers

    def __getstate__(self) -> dict[str, Any]:
        for owner in (self, self.action_space, self.observation_space):
            _ = owner.np_random  # created now if need be, so that the copy has the same one
        content = {name: value for name, value in vars(self).items() if name not in ("robot", "constraint")}
        in_simulator = self._start is not None and not self._closed
        return content | {"robot": self.robot.get_state() if in_simulator else None}

    def __setstate__(self, content: dict[str, Any]) -> None:
        content = dict(content)
        robot = content.pop("robot")
        vars(self).update(content)
        self.constraint = self._definition.constraint
        self.robot = make_robot(self.task, self._definition, self._simulator)
        if self._closed:
            self.robot.close()
        elif robot is not None:
            self.robot.set_state(robot)
        elif self._start is not None:
            now = self.np_random.bit_generator.state
            self._repeat()
            self.np_random.bit_generator.state = now

    def _repeat(self) -> np.ndarray:
        """Repeat the last episode from its start with its actions; return the observation."""
        self.np_random.bit_generator.state = self._start
        obs = self.robot.reset(self.np_random)
        for action in self._actions:
            obs = self.robot.step(action.copy())[0]
        return obs.copy()

    def _refuse_closed(self, method: str) -> None:
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError(f"{self.task}: {method}() after close(); make a new one")

    @torch.no_grad()
    def _boundary(self, obs: np.ndarray) -> np.ndarray:
        """Points (k, 2) around the feasible set at `obs`, in order."""
        angle = torch.linspace(0, 2 * math.pi, 361, dtype=torch.float64)[:-1]
        direction = torch.stack((angle.cos(), angle.sin()), -1)
        repeated = torch.from_numpy(obs).expand(len(angle), -1)
        center = self.constraint.center(repeated)
        return (center + direction / self.constraint.gauge(repeated, direction, center).unsqueeze(-1)).numpy()

    def _well_formed(self, action: np.ndarray) -> np.ndarray | InfeasibleActionError:
        """`action` as an array (d,) of finite numbers, or the InfeasibleActionError that says what is wrong."""
        if self._obs is None:
            self._refuse_closed("step")
            over = "the episode is over; " if self._start is not None else ""
            raise gymnasium.error.ResetNeeded(f"{self.task}: {over}call reset() before step()")
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            expected = self.action_space.shape
            return InfeasibleActionError(f"{self._where()}: action has shape {action.shape}, expected {expected}")
        if not all(map(math.isfinite, action.tolist())):
            return InfeasibleActionError(f"{self._where()}: action {action} is not finite")
        return action

    @torch.no_grad()  # coefficients may be learned
    def _admit(self, action: np.ndarray, violation: float) -> np.ndarray | InfeasibleActionError:
        """The action to execute for a well-formed `action`, or the InfeasibleActionError that refuses it.

        It is `action` itself (in its own precision) or its projection. `violation` is the violation of `action` at the
        current observation.
        """
        if self.project and violation > 0:
            obs, exact = torch.from_numpy(self._obs), torch.from_numpy(action.astype(np.float64))
            exact = self.constraint.project(obs, exact)
            action, violation = exact.numpy(), self.constraint.violation(obs, exact).item()
        if not violation <= TOLERANCE:  # a NaN is refused as well
            allowed = allowed_violation(self.constraint, torch.from_numpy(self._obs), violation).item()
            if not violation <= allowed:
                return InfeasibleActionError(
                    f"{self._where()}: action {action} violates the constraint by {violation:.3g} "
                    f"(at most {allowed:g} is allowed)"
                )
        self.largest_violation = max(self.largest_violation, violation)
        return action

    def _record(self, action: np.ndarray, step: Step) -> Outcome:
        """Count the step that the robot took with `action`, and return what the environment's `step` returns."""
        obs, reward, terminated, info = step
        if self.show_set:
            self._shown = self._obs, np.array(action)
        self._obs = obs.copy()
        self.executed_actions += 1
        self.elapsed_steps += 1
        if self._keeps_actions:
            self._actions.append(np.array(action))
        if self.project:
            info["executed_action"] = np.array(action, np.float64)
        truncated = self.max_episode_steps is not None and self.elapsed_steps >= self.max_episode_steps
        if terminated or truncated:
            self._obs = None
        return obs.astype(self._dtype, copy=False), reward, terminated, truncated, info

    def _where(self) -> str:
        return f"{self.task}, step {self.elapsed_steps + 1} of the episode"


class GivenTimeLimit(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Sets the time limit of an `ActionConstrainedEnv` to that given to `gymnasium.make`, which may be longer."""

    def __init__(self, env: Any):
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        env.unwrapped.max_episode_steps = env.spec.max_episode_steps
