"""A robot for any Gymnasium environment whose actions and observations are boxes of numbers."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import weakref
from typing import Any, cast

import gymnasium
import numpy as np

from envs.locomotion import silent_mujoco
from envs.robot import Robot, Step


class _Wrapped(Robot):
    """The base class of all classes that `GymnasiumRobot` makes."""

    identifier: str
    """The environment's identifier for `gymnasium.make`."""
    render_mode: str | None
    """"rgb_array", or None for an environment without pictures."""

    def __init__(self) -> None:
        self.env = _make(self.identifier, self.render_mode)
        self._free = weakref.finalize(self, self.env.close)
        self._seed: int | None = None
        self._actions: list[np.ndarray] = []
        self._box = cast(gymnasium.spaces.Box, self.env.action_space)
        low, high = (np.asarray(bound, np.float64).ravel() for bound in (self._box.low, self._box.high))
        self._middle, self._half = (low + high) / 2, (high - low) / 2

    def reset(self, rng: np.random.Generator) -> np.ndarray:
        """Start an episode with a seed drawn from `rng`; return the observation (obs_dim,)."""
        return self._start(int(rng.integers(2**31)))

    def step(self, action: np.ndarray) -> Step:
        """Execute `action` (action_dim,), scaled from [-1, 1] to the environment's box."""
        exact = np.array(action, np.float64)
        self._actions.append(exact)
        box, scaled = self._box, self._middle + self._half * exact
        obs, reward, terminated, truncated, info = self.env.step(
            scaled.reshape(box.shape).astype(box.dtype).clip(box.low, box.high)
        )
        if truncated and not terminated and len(self._actions) < self.max_episode_steps:
            raise RuntimeError(
                f"{self.identifier} truncates an episode after {len(self._actions)} steps, before its time limit of"
                f" {self.max_episode_steps}; only the time limit may truncate a robot's episode"
            )
        return np.array(obs, np.float64).ravel(), float(reward), bool(terminated), dict(info)

    def get_state(self) -> np.ndarray:
        """The seed of the episode and its actions (1 + steps * action_dim,).

        A simulator's state may be incomplete. MuJoCo's, for example, lacks the contact forces that Ant observes and the
        body positions from which Ant's next reward is computed.
        """
        return np.concatenate(([float(self._seed)], *self._actions))  # the seed is below 2^31, so the float is exact

    def set_state(self, state: np.ndarray) -> np.ndarray:
        """Repeat the episode of `state`, which `get_state` returned; return the observation (obs_dim,)."""
        obs = self._start(int(state[0]))
        for action in state[1:].reshape(-1, self.action_dim):
            obs = self.step(action)[0]
        return obs

    def render(self) -> np.ndarray:
        """The environment's own picture (h, w, 3), uint8. Raises RuntimeError for one without pictures."""
        if self.render_mode is None:
            raise RuntimeError(f"{self.identifier} cannot be rendered (it has no render mode 'rgb_array')")
        return cast(np.ndarray, self.env.render())

    def close(self) -> None:
        """Close the environment."""
        self._free()

    def __reduce__(self) -> tuple[Any, ...]:
        of_id = type(self) is GymnasiumRobot(self.identifier)
        state = () if self._seed is None else (self.get_state(),)
        return _new, (self.identifier if of_id else type(self), *state)

    def _start(self, seed: int) -> np.ndarray:
        self._seed, self._actions = seed, []
        return np.array(self.env.reset(seed=seed)[0], np.float64).ravel()


@functools.cache
def GymnasiumRobot(identifier: str) -> type[Robot]:  # noqa: N802
    """A robot class, for a row of `TASKS`, that runs the Gymnasium environment `identifier`, such as "Ant-v5".

    Its actions in [-1, 1] are scaled to the environment's box, and its observations are flattened to (obs_dim,). The
    environment decides when an episode terminates, and its time limit is `max_episode_steps`. A saved episode consists
    of its seed and its actions, so the environment must be deterministic given both; `envs.check_robot` tests this.
    Derive from the class to change an attribute, such as `hyperparameters`.

    Raises ValueError if observations or actions are not a Box, if actions are not bounded floats, or if there is no
    time limit. Gymnasium raises its own errors for an environment that does not exist or is not installed.
    """
    env = _make(identifier)
    try:
        actions, observations = env.action_space, env.observation_space
        for kind, space in (("observation", observations), ("action", actions)):
            if not isinstance(space, gymnasium.spaces.Box):
                raise ValueError(f"{identifier} has the {kind} space {space}; a robot needs a Box")
        assert isinstance(actions, gymnasium.spaces.Box)
        if not np.issubdtype(actions.dtype, np.floating) or not actions.is_bounded():
            raise ValueError(f"{identifier} has the action space {actions}; a robot needs a bounded Box of floats")
        if not env.spec.max_episode_steps:
            raise ValueError(f"{identifier} has no time limit (max_episode_steps), which a robot needs")
        attributes = {
            "identifier": identifier,
            "obs_dim": int(np.prod(observations.shape)),
            "action_dim": int(np.prod(actions.shape)),
            "max_episode_steps": env.spec.max_episode_steps,
            "render_mode": "rgb_array" if "rgb_array" in env.metadata.get("render_modes", ()) else None,
            "fps": int(env.metadata.get("render_fps") or 30),
            "__module__": __name__,
            "__doc__": f"The Gymnasium environment {identifier}.",
        }
    finally:
        env.close()
    return type(f"GymnasiumRobot({identifier!r})", (_Wrapped,), attributes)


def _make(identifier: str, render_mode: str | None = None) -> gymnasium.Env:
    # Entering `silent_mujoco` imports MuJoCo. Gymnasium's own import fails if MUJOCO_GL names an absent library.
    quiet = silent_mujoco() if importlib.util.find_spec("mujoco") else contextlib.nullcontext()
    with quiet:
        return gymnasium.make(identifier, render_mode=render_mode, disable_env_checker=True)


def _new(robot: str | type[Robot], state: np.ndarray | None = None) -> Robot:
    """A robot in `state`, of a class or of `GymnasiumRobot(robot)`."""
    new = (GymnasiumRobot(robot) if isinstance(robot, str) else robot)()
    if state is not None:
        new.set_state(state)
    return new
