"""The protocol that every robot of a task follows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Step = tuple[np.ndarray, float, bool, dict[str, Any]]
"""What a step returns: observation (n,), reward, whether the episode terminated, info."""


class UnavailableError(ValueError):
    """A simulator is not installed on this machine, or the robot does not have it; the message is one line."""


class RobotError(ValueError):
    """A robot does not keep the protocol of `Robot`; the message is one line that names the mistake."""


class Robot(ABC):
    """One simulated robot. A robot of your own derives from this class and appears in a row of `envs.TASKS`.

    An episode must depend on its reset and its actions alone, not on earlier episodes. Observations are new float64
    arrays, which the caller may keep and change. The environment around a robot checks actions, counts steps and ends
    an episode after `max_episode_steps`; a robot does none of that. `envs.check_robot` tests all this.

    The constructor takes no arguments. A copied or pickled environment makes a new robot and gives it the state of the
    old one, or repeats the actions of the episode.
    """

    obs_dim: int
    action_dim: int
    max_episode_steps: int
    fps: int
    """Steps per second of simulated time: the frame rate of a video in real time."""
    hyperparameters: str = "Others"
    """The group of robots in the paper's table of hyperparameters. Algorithms use the values of this group."""
    simulators: Mapping[str, str] = {}
    """The simulators among which a user can choose: name -> "module:class", imported when chosen. The first is this
    class itself; a robot without a choice has no entries. Subclasses do not inherit the entries."""

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "simulators" not in vars(cls):
            cls.simulators = {}  # the base class's entries would run the base class
        if "step" in vars(cls) and "step_together" not in vars(cls):
            # The inherited step_together would take the base class's step.
            cls.step_together = classmethod(Robot.step_together.__func__)  # type: ignore[assignment, attr-defined]

    @abstractmethod
    def reset(self, rng: np.random.Generator) -> np.ndarray:
        """Start an episode, with all random numbers from `rng`; return the observation (obs_dim,)."""

    @abstractmethod
    def step(self, action: np.ndarray) -> Step:
        """Execute `action` (action_dim,), float32 or float64, in [-1, 1]; return a `Step`."""

    @classmethod
    def step_together(cls, robots: Sequence[Robot], actions: Sequence[np.ndarray]) -> list[Step]:
        """Step each of `robots`, all of this class, with its action; return bit for bit what `step` of each would.

        Override this if one call for all is faster than a loop.
        """
        return [robot.step(action) for robot, action in zip(robots, actions, strict=True)]

    def get_state(self) -> np.ndarray | None:
        """The robot's state in an episode as float64 numbers (k,), from which `set_state` continues bit for bit.

        None, the default, means that there is no such state. A checkpoint then keeps the actions of the episode, and a
        resumed run repeats them.
        """
        return None

    def set_state(self, state: np.ndarray) -> np.ndarray:
        """Continue from `state` (k,) of `get_state`, maybe of another process; return its observation (obs_dim,)."""
        raise TypeError(f"{type(self).__name__} does not define set_state()")

    @abstractmethod
    def render(self) -> np.ndarray:
        """Picture (h, w, 3), uint8, of the present state."""

    @abstractmethod
    def close(self) -> None:
        """Free the simulator; closing twice must be harmless. A closed robot is not used again."""


class SimulatedRobot(Robot):
    """A robot whose simulator cannot be pickled. A copy is a new robot of its class in the same state.

    A subclass calls `_built` at the end of its constructor. A copy runs the constructor, which sets the early
    attributes anew; attributes added later are copied.
    """

    def _built(self) -> None:
        self._set_up = frozenset(vars(self)) | {"_set_up"}

    def __reduce__(self) -> tuple[Any, ...]:
        later = {name: value for name, value in vars(self).items() if name not in self._set_up}
        return type(self), (), (later, self.get_state())

    def __setstate__(self, content: tuple[dict[str, Any], np.ndarray]) -> None:
        later, state = content
        vars(self).update(later)
        self.set_state(state)
