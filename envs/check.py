"""Checks that a robot keeps the protocol of `envs.Robot`; the errors name the mistake."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from inspect import isabstract
from numbers import Integral, Real
from typing import Any

import numpy as np

from envs.robot import Robot, RobotError, Step

_LARGE_GROUP = 50  # `step_together` may take another path for many robots than for a few


def check_class(robot: type[Robot]) -> None:
    """Raise RobotError if `robot` is not a robot class, or lacks methods or attributes."""
    if not (isinstance(robot, type) and issubclass(robot, Robot)):
        raise RobotError(f"a robot must be a class that derives from envs.Robot, got {robot!r}")
    name = robot.__name__
    if isabstract(robot):
        raise RobotError(f"{name} lacks methods: {', '.join(sorted(robot.__abstractmethods__))}")
    for attribute in ("obs_dim", "action_dim", "max_episode_steps", "fps"):
        value = getattr(robot, attribute, None)
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            found = f"is {value!r}" if hasattr(robot, attribute) else "is missing"
            raise RobotError(f"{name}.{attribute} {found}; it must be a class attribute, a whole number of at least 1")
    if not isinstance(robot.hyperparameters, str):
        raise RobotError(
            f"{name}.hyperparameters is {robot.hyperparameters!r}; it must be the name of a group of robots"
        )
    own = [method for method in ("get_state", "set_state") if getattr(robot, method) is not getattr(Robot, method)]
    if len(own) == 1:
        raise RobotError(f"{name} defines only {own[0]}(); get_state() and set_state() belong together")


def check_robot(robot: type[Robot], steps: int = 200) -> None:
    """Raise RobotError, whose message names the mistake, if `robot` does not keep the protocol of `Robot`.

    The check plays several episodes of at most `steps` steps with random actions in [-1, 1], many of them at -1 or 1.
    It tests the attributes, shapes and types of the protocol. Equal random numbers and actions must give equal bits: in
    two robots side by side, after other episodes, from a saved state, and in `step_together`. The robot must not change
    an array that it is given, and must not keep one that it is given or returns; it must copy it first.
    """
    check_class(robot)
    steps = min(steps, robot.max_episode_steps)
    check = _Check(robot, np.random.default_rng(0).uniform(-1.5, 1.5, (steps, robot.action_dim)).clip(-1, 1))
    first = check.formats()
    check.equal_robots(first)
    check.earlier_episodes(first)
    check.states(first)
    check.together()
    for _ in range(2):
        check.call("close", check.new().close)  # before the first episode
    machine = check.new()
    check.call("reset", machine.reset, _random_numbers())
    for _ in range(2):
        check.call("close", machine.close)


def _random_numbers(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


class _Check:
    """The parts of `check_robot`, for one class and one sequence of actions (steps, action_dim)."""

    def __init__(self, robot: type[Robot], actions: np.ndarray):
        self.robot, self.name = robot, robot.__name__
        # Agents send float32, and projections are float64.
        self.actions = [action.astype((np.float32, np.float64)[k % 2]) for k, action in enumerate(actions)]

    def call(self, method: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a method of the robot and return the result. An error in its code becomes a RobotError."""
        try:
            return function(*arguments)
        except Exception as error:  # the robot is the user's own code
            text = str(error).splitlines()[0] if str(error) else "no message"
            raise RobotError(f"{self.name}.{method}() fails with {type(error).__name__}: {text}") from error

    def new(self) -> Robot:
        return self.call("__init__", self.robot)

    def fail(self, message: str) -> None:
        raise RobotError(f"{self.name}{message}")

    def formats(self) -> list[Step]:
        """Check what reset and step return in a first episode. Return its steps, of which the reset is the first."""
        machine = self.new()
        rng = _random_numbers()
        obs = self.call("reset", machine.reset, rng)
        if isinstance(obs, tuple):
            self.fail(".reset() returns a tuple; it must return only the observation, without an info")
        self.observation("reset", obs)
        steps: list[Step] = [(obs.copy(), rng.random(), False, {})]
        seen, infos = [(obs, obs.copy())], list[dict[str, Any]]()
        for action in self.actions:
            given = action.copy()
            answer = self.call("step", machine.step, given)
            if not isinstance(answer, tuple) or len(answer) != 4:
                found = f"{len(answer)} values" if isinstance(answer, tuple) else f"a {type(answer).__name__}"
                hint = "; leave out `truncated`, which the environment sets" if found == "5 values" else ""
                self.fail(f".step() returns {found}; it must return four, (obs, reward, terminated, info){hint}")
            obs, reward, terminated, info = answer
            self.observation("step", obs)
            if not isinstance(reward, Real) or isinstance(reward, bool) or not math.isfinite(reward):
                self.fail(f".step() returns the reward {reward!r}; it must be one finite number")
            if not isinstance(terminated, bool | np.bool_):
                self.fail(f".step() returns terminated as {terminated!r}; it must be True or False")
            if not isinstance(info, dict):
                self.fail(f".step() returns info as {info!r}; it must be a dict")
            if any(info is other for other in infos):
                self.fail(".step() returns the same info dict twice; return a new one each time")
            if not np.array_equal(given, action):
                self.fail(".step() changes the action that it is given; copy it first")
            if any(not np.array_equal(*pair) for pair in seen):
                self.fail(": an observation changes at a later step; return a new array each time")
            steps.append((obs.copy(), reward, terminated, {}))
            seen.append((obs, obs.copy()))
            infos.append(info)
            if terminated:
                break
        machine.close()
        return steps

    def observation(self, method: str, obs: Any) -> None:
        """Check an observation that `method` returned."""
        wanted = f"an observation must be a NumPy array of float64 and shape ({self.robot.obs_dim},)"
        if not isinstance(obs, np.ndarray):
            self.fail(f".{method}() returns a {type(obs).__name__} as the observation; {wanted}")
        if obs.shape != (self.robot.obs_dim,):
            self.fail(f".{method}() returns an observation of shape {obs.shape}, but obs_dim is {self.robot.obs_dim}")
        if obs.dtype != np.float64:
            self.fail(f".{method}() returns an observation of {obs.dtype}; {wanted}")
        if not np.isfinite(obs).all():
            self.fail(f".{method}() returns an observation that is not finite: {obs}")

    def play(self, machine: Robot, actions: Sequence[np.ndarray], spoil: bool = False) -> list[Step]:
        """Step `machine` until the episode terminates; with `spoil`, overwrite the arrays given and returned."""
        steps: list[Step] = []
        for action in actions:
            given = action.copy()
            obs, reward, terminated, _ = self.call("step", machine.step, given)
            steps.append((obs.copy(), reward, terminated, {}))
            if spoil:
                obs[:], given[:] = np.nan, np.nan
            if terminated:
                break
        return steps

    def compare(self, first: Sequence[Step], second: Sequence[Step], why: str) -> None:
        """Fail with `why` if two episodes differ in a bit, or in their length."""
        for k, (one, other) in enumerate(zip(first, second, strict=False)):
            if not np.array_equal(one[0], other[0]) or one[1:3] != other[1:3]:
                self.fail(f": {why} (they differ at step {k})")
        if len(first) != len(second):
            self.fail(f": {why} (one ends after {len(first)} steps, the other after {len(second)})")

    def begin(self, machine: Robot, seed: int = 0, spoil: bool = False) -> Step:
        rng = _random_numbers(seed)
        obs = self.call("reset", machine.reset, rng)
        step: Step = (obs.copy(), rng.random(), False, {})  # this number shows how many were drawn before
        if spoil:
            obs[:] = np.nan
        return step

    def equal_robots(self, first: list[Step]) -> None:
        """Check that an episode depends on its random numbers and actions alone."""
        plain, spoilt, beside, other = (self.new() for _ in range(4))
        again = [self.begin(plain), *self.play(plain, self.actions)]
        why = "two robots given the same random numbers and actions differ; draw all random numbers from reset's rng"
        self.compare(first, again, why)
        again = [self.begin(spoilt, spoil=True), *self.play(spoilt, self.actions, spoil=True)]
        why = "it keeps arrays that it returned or was given, but callers may write into them; copy them"
        self.compare(first, again, why)
        again = [self.begin(beside)]
        self.begin(other, seed=1)
        for action in self.actions[: len(first) - 1]:
            again += self.play(beside, [action])
            if self.play(other, [-action])[0][2]:
                self.begin(other, seed=2)
        why = "a robot changes when another one steps; keep its state in the object, not the class"
        self.compare(first, again, why)
        for machine in (plain, spoilt, beside, other):
            machine.close()

    def earlier_episodes(self, first: list[Step]) -> None:
        """Check that an episode does not depend on those before it."""
        machine = self.new()
        for seed in (1, 2):
            self.begin(machine, seed)
            self.play(machine, [np.sign(action) for action in self.actions])
        again = [self.begin(machine), *self.play(machine, self.actions)]
        self.compare(first, again, "an episode depends on earlier ones; reset() must reset the whole state")
        machine.close()

    def states(self, first: list[Step]) -> None:
        """Check that an episode continues bit for bit from a saved state, in a new robot and in a used one."""
        machine, used = self.new(), self.new()
        self.begin(machine)
        kept = self.call("get_state", machine.get_state)
        if kept is None and self.robot.get_state is Robot.get_state:
            return
        self.begin(used, seed=1)
        self.play(used, self.actions)
        ends = len(first) - 1
        for at in sorted({0, ends // 2, ends - 1}):
            self.begin(machine)
            self.play(machine, self.actions[:at])
            state = self.call("get_state", machine.get_state)
            if not isinstance(state, np.ndarray) or state.ndim != 1 or state.dtype != np.float64:
                self.fail(f".get_state() returns {state!r}; it must always return a NumPy array (k,) of float64")
            copy = state.copy()
            self.play(machine, self.actions[at:])
            machine.get_state()
            if not np.array_equal(state, copy, equal_nan=True):
                self.fail(": the state that get_state() returned changes at a later step; return a new array")
            fresh = self.new()
            for target in (fresh, used):
                given = copy.copy()
                obs = self.call("set_state", target.set_state, given)
                self.observation("set_state", obs)
                given[:] = np.nan
                self.compare(
                    first[at:],
                    [(obs, *first[at][1:]), *self.play(target, self.actions[at:])],
                    f"an episode continues differently from the saved state of step {at}; get_state() omits something",
                )
            fresh.close()
        machine.close(), used.close()

    def together(self) -> None:
        """Check that `step_together` returns the same bits as `step`."""
        if self.robot.step_together.__func__ is Robot.step_together.__func__:  # type: ignore[attr-defined]
            return
        for size in (1, 2, 3, _LARGE_GROUP):
            group, alone = [self.new() for _ in range(size)], [self.new() for _ in range(size)]
            for machines in (group, alone):
                for seed, machine in enumerate(machines):
                    self.begin(machine, seed)
            for k in range(min(len(self.actions), 40)):
                actions = [self.actions[(k + j) % len(self.actions)] for j in range(len(group))]
                steps = self.call("step_together", self.robot.step_together, group, actions)
                wanted = [machine.step(action) for machine, action in zip(alone, actions, strict=True)]
                if len(steps) != len(wanted):
                    self.fail(f".step_together() returns {len(steps)} steps for {len(wanted)} robots")
                for step, one in zip(steps, wanted, strict=True):
                    if len(step) != 4 or not np.array_equal(step[0], one[0]) or step[1:3] != one[1:3]:
                        self.fail(f".step_together() of {size} robots differs from step() at step {k + 1}")
                running = [j for j, one in enumerate(wanted) if not one[2]]
                group, alone = [group[j] for j in running], [alone[j] for j in running]
                if not group:
                    break
            for machine in (*group, *alone):
                machine.close()
