"""The Gymnasium environment of a task: a robot that executes feasible actions only."""

import json
import math

import gymnasium
import numpy as np
import torch

from core.words import known_name
from envs.tasks import TASKS

TOLERANCE = 1e-6  # largest violation an executed action may have, in the units of `Constraint.violation`


class InfeasibleActionError(ValueError):
    """An action lies outside the task's feasible set at the current observation, or is no action at all."""


def find_task(name):
    """The `Task` called `name`; ValueError with the choices and the closest name where there is none."""
    return TASKS[known_name("task", name, TASKS)]


def step_together(envs, actions):
    """Step each `ActionConstrainedEnv` of `envs` with its action (d,) of `actions`, all under one violation check.

    Returns a list: what `step` returns or, for an action that it refuses, the InfeasibleActionError that it raises;
    the others are executed all the same. Each environment does what it would do alone.

    Raises gymnasium.error.ResetNeeded where an environment needs a reset, and ValueError for environments of different
    constraints and for one given twice, whose second action would be checked at a past observation. None has then been
    stepped.
    """
    if len(set(map(id, envs))) < len(envs) or any(env.constraint is not envs[0].constraint for env in envs):
        raise ValueError("step_together() takes different environments of one constraint")
    outcomes = [env._well_formed(action) for env, action in zip(envs, actions, strict=True)]
    checked = [k for k, outcome in enumerate(outcomes) if not isinstance(outcome, InfeasibleActionError)]
    if checked:
        obs = torch.from_numpy(np.array([envs[k]._obs for k in checked]))
        exact = torch.from_numpy(np.array([outcomes[k] for k in checked], np.float64))
        violations = envs[0].constraint.violation(obs, exact).tolist()
        for k, violation in zip(checked, violations, strict=True):
            outcomes[k] = envs[k]._execute(outcomes[k], violation)
    return outcomes


class ActionConstrainedEnv(gymnasium.Env):
    """A robot under the action constraint of one of the paper's tasks.

    Observations are float64 (n,), actions (d,) in [-1, 1]. The violation of every action at the current
    observation is computed in float64 before it is executed, and above 1e-6 the action is refused. With
    `project`, an action outside the set is replaced by its projection instead, and
    `info["executed_action"]` holds what was executed (float64, (d,)). The robot's time limit truncates.

    Attributes: `constraint`; `largest_violation` (float) over all executed actions since construction, -inf
    before the first; `executed_actions` (int), their number; `elapsed_steps` (int) of the current episode.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, task, project=False, render_mode=None):
        found = find_task(task)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r} (choices: None 'rgb_array')")
        self.task, self.constraint, self.project, self.render_mode = (
            task,
            found.constraint,
            project,
            render_mode,
        )
        self.robot = found.robot()
        self.metadata = {**self.metadata, "render_fps": self.robot.fps}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.robot.obs_dim,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.robot.action_dim,), np.float32)
        self.largest_violation, self.executed_actions, self.elapsed_steps = -np.inf, 0, 0
        self._obs = None  # current observation in an array of its own: callers may write into theirs
        self._start, self._actions = None, None  # of the episode: state of the random numbers before it; its actions

    def reset(self, *, seed=None, options=None):
        """Start an episode; return observation (n,) and info. `seed` as Gymnasium defines it."""
        super().reset(seed=seed)
        self._start, self._actions, self.elapsed_steps = self.np_random.bit_generator.state, [], 0
        obs = self.robot.reset(self.np_random)
        self._obs = obs.copy()
        return obs, {}

    def step(self, action):
        """Execute `action` (d,); return observation, reward, terminated, truncated, info.

        Raises InfeasibleActionError for a wrong shape, a value that is not finite or, without `project`, a
        violation above 1e-6; gymnasium.error.ResetNeeded before the first reset.
        """
        (outcome,) = step_together([self], [action])
        if isinstance(outcome, InfeasibleActionError):
            raise outcome
        return outcome

    def get_state(self):
        """Everything that `set_state`, also in another process, needs to go on bit for bit: a dict of numbers, text,
        lists and one tensor.

        It holds the actions of the episode and the state of the random numbers at its start, not the simulator's
        memory: simulators do not save all of that bit for bit (PyBullet), while the same actions after the same reset
        repeat the episode exactly. Of an episode that is over only the random numbers are left.
        """
        random_numbers = self._start or self.np_random.bit_generator.state
        return {
            "random_numbers": json.dumps(random_numbers),
            "in_episode": self._start is not None,
            "actions": torch.from_numpy(np.array(self._actions)) if self._actions else None,
            "executed_actions": self.executed_actions,
            "largest_violation": self.largest_violation,
        }

    def set_state(self, state):
        """Go back to what `get_state` described; after an episode that was over, the next call must be a reset.

        An episode in progress is repeated from its start: at most 1,000 simulation steps.
        """
        self.np_random.bit_generator.state = json.loads(state["random_numbers"])
        self._start, self._actions, self._obs = None, None, None
        if state["in_episode"]:
            self.reset()
            for action in () if state["actions"] is None else state["actions"].numpy():
                self._obs = self.robot.step(action)[0]
                self._actions.append(action)
            self.elapsed_steps = len(self._actions)
        self.executed_actions, self.largest_violation = state["executed_actions"], state["largest_violation"]

    def render(self):
        """Picture (480, 480, 3), uint8, of the current state; None without `render_mode="rgb_array"`."""
        return self.robot.render() if self.render_mode == "rgb_array" else None

    def close(self):
        """Free simulator and renderer; closing twice is harmless."""
        self.robot.close()
        self._obs = None

    def _well_formed(self, action):
        """`action` as an array (d,) of finite numbers, or the InfeasibleActionError that says why it is none."""
        if self._obs is None:
            raise gymnasium.error.ResetNeeded(f"{self.task}: call reset() before step()")
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            expected = self.action_space.shape
            return InfeasibleActionError(f"{self._where()}: action has shape {action.shape}, expected {expected}")
        if not all(map(math.isfinite, action.tolist())):
            return InfeasibleActionError(f"{self._where()}: action {action} is not finite")
        return action

    def _execute(self, action, violation):
        """What `step` returns for a well-formed `action`, or the InfeasibleActionError that refuses it.

        Executed is `action` itself (in its own precision) or its projection; `violation` (float) is that of `action` at
        the current observation.
        """
        if self.project and violation > 0:
            obs, exact = torch.from_numpy(self._obs), torch.from_numpy(action.astype(np.float64))
            exact = self.constraint.project(obs, exact)
            action, violation = exact.numpy(), self.constraint.violation(obs, exact).item()
        if not violation <= TOLERANCE:  # a NaN is refused as well
            return InfeasibleActionError(
                f"{self._where()}: action {action} violates the constraint by {violation:.3g} "
                f"(at most {TOLERANCE:g} is allowed)"
            )
        self.largest_violation = max(self.largest_violation, violation)
        obs, reward, terminated, info = self.robot.step(action)
        self._obs = obs.copy()
        self._actions.append(np.array(action))
        self.executed_actions += 1
        self.elapsed_steps += 1
        if self.project:
            info["executed_action"] = np.array(action, np.float64)
        truncated = self.elapsed_steps >= self.robot.max_episode_steps
        if terminated or truncated:  # only a reset can follow
            self._start, self._actions = None, []
        return obs, reward, terminated, truncated, info

    def _where(self):
        return f"{self.task}, step {self.elapsed_steps + 1} of the episode"
