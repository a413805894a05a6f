"""`envs.check_robot`: it names each mistake in a robot, passes all robots of the project, and runs before a training.
Also robots made from Gymnasium environments."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from helpers import run_command, train

import envs
from constraints import Ball
from envs.locomotion import HalfCheetah, Hopper, Walker2d
from envs.reacher import Reacher

ROOT = Path(__file__).resolve().parent.parent


class Good(envs.Robot):
    """A mass on a line. Each class with a mistake below changes it in one way."""

    obs_dim, action_dim, max_episode_steps, fps = 2, 1, 60, 10

    def reset(self, rng):
        self.x, self.v = float(rng.uniform(-1, 1)), 0.0
        return self.obs()

    def step(self, action):
        self.v += 0.1 * float(action[0])
        self.x += 0.1 * self.v
        return self.obs(), -abs(self.x), abs(self.x) > 1.5, {}

    def obs(self):
        return np.array((self.x, self.v))

    def get_state(self):
        return self.obs()

    def set_state(self, state):
        self.x, self.v = state.tolist()
        return self.obs()

    def render(self):
        return np.zeros((480, 480, 3), np.uint8)

    def close(self):
        pass


class Stateless(Good):
    get_state, set_state = envs.Robot.get_state, envs.Robot.set_state


@pytest.mark.parametrize("robot", [Reacher, HalfCheetah, Hopper, Walker2d, Good, Stateless, "pybullet"])
@pytest.mark.parametrize("steps", [200, 10])
def test_robots_that_keep_the_protocol(robot, steps):
    if robot == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
        from envs.pybullet_reacher import PyBulletReacher as robot
    envs.check_robot(robot, steps)


def with_step(change):
    """`Good` with a step that returns `change` of its normal answer."""
    return type("Bad", (Good,), {"step": lambda self, action: change(*Good.step(self, action))})


def with_obs(change):
    return type("Bad", (Good,), {"obs": lambda self: change(Good.obs(self))})


class SharedObs(Stateless):
    def __init__(self):
        self.memory = np.zeros(2)

    def obs(self):
        self.memory[:] = self.x, self.v
        return self.memory


class KeepsObs(Stateless):
    def obs(self):
        self.last = super().obs()
        return self.last

    def step(self, action):
        self.x, self.v = self.last
        return super().step(action)


class KeepsAction(Stateless):
    def reset(self, rng):
        self.last = np.zeros(1)
        return super().reset(rng)

    def step(self, action):
        answer = super().step(action + self.last)
        self.last = action
        return answer


class ChangesAction(Good):
    def step(self, action):
        action *= 0.5
        return super().step(action)


class SharedInfo(Good):
    info: dict = {}

    def step(self, action):
        return *super().step(action)[:3], self.info


class Noise(Stateless):
    def step(self, action):
        self.v += 1e-9 * np.random.default_rng().normal()
        return super().step(action)


class GlobalNoise(Stateless):
    def reset(self, rng):
        self.x, self.v = np.random.uniform(-1, 1), 0.0
        return self.obs()


class Remembers(Stateless):
    def reset(self, rng):
        old = getattr(self, "v", 0.0)
        obs = super().reset(rng)
        self.v = 1e-6 * old
        return obs


class DrawsMoreAtFirst(Stateless):
    """Draws more random numbers at the first reset than at later ones, which its observations do not show."""

    def reset(self, rng):
        obs = super().reset(rng)
        if not hasattr(self, "noise"):
            self.noise = rng.uniform(size=3)
        return obs


class OnTheClass(Good):
    speed = [0.0]

    def reset(self, rng):
        self.speed[0] = 0.0
        return super().reset(rng)

    def step(self, action):
        self.v = self.speed[0]
        answer = super().step(action)
        self.speed[0] = self.v
        return answer


class Incomplete(Good):
    def reset(self, rng):
        self.count = 0
        return super().reset(rng)

    def step(self, action):
        self.count += 1
        self.v += 1e-6 * (self.count % 3)
        return super().step(action)

    def set_state(self, state):
        self.count = 0
        return super().set_state(state)


class WrongObsFromState(Good):
    def set_state(self, state):
        return super().set_state(state) + 1e-9


class SharedState(Good):
    memory = np.zeros(2)

    def get_state(self):
        self.memory[:] = self.obs()
        return self.memory


class KeepsState(Good):
    """Keeps the array given to set_state, and reads it at the next step."""

    given = None

    def reset(self, rng):
        self.given = None
        return super().reset(rng)

    def set_state(self, state):
        self.given = state
        return super().set_state(state)

    def step(self, action):
        if self.given is not None:
            self.x, self.v = self.given.tolist()
            self.given = None
        return super().step(action)


class OnlyGetState(Stateless):
    get_state = Good.get_state


class OnlySetState(Stateless):
    set_state = Good.set_state


class Together(Good):
    @classmethod
    def step_together(cls, robots, actions):
        steps = super().step_together(robots, actions)
        return [(obs, reward + 1e-12 * (len(robots) > 10), *rest) for obs, reward, *rest in steps]


class TogetherOrder(Good):
    @classmethod
    def step_together(cls, robots, actions):
        return super().step_together(robots, actions)[::-1]


class CloseOnce(Good):
    closed = False

    def close(self):
        assert not self.closed, "closed already"
        self.closed = True


class NeedsArguments(Good):
    def __init__(self, mass):
        self.mass = mass


class Fails(Good):
    def step(self, action):
        return self.nothing


class NoFps(Good):
    fps = None


MISTAKES = {
    "an info from reset": (
        type("Bad", (Good,), {"reset": lambda self, rng: (Good.reset(self, rng), {})}),
        "Bad.reset() returns a tuple; it must return only the observation, without an info",
    ),
    "a list": (with_obs(list), "Bad.reset() returns a list as the observation"),
    "single precision": (with_obs(np.float32), "Bad.reset() returns an observation of float32"),
    "a wrong shape": (with_obs(lambda o: np.append(o, 0.0)), "of shape (3,), but obs_dim is 2"),
    "a column": (with_obs(lambda o: o[:, None]), "of shape (2, 1), but obs_dim is 2"),
    "NaN": (with_obs(lambda o: o * np.nan), "Bad.reset() returns an observation that is not finite"),
    "five values": (
        with_step(lambda o, r, t, i: (o, r, t, False, i)),
        "returns 5 values; it must return four, (obs, reward",
    ),
    "three values": (with_step(lambda o, r, t, i: (o, r, t)), "Bad.step() returns 3 values; it must return four"),
    "a list of four": (with_step(lambda *four: list(four)), "Bad.step() returns a list; it must return four"),
    "single precision in step": (
        with_step(lambda o, r, t, i: (o.astype(np.float32), r, t, i)),
        "Bad.step() returns an observation of float32",
    ),
    "reward an array": (with_step(lambda o, r, t, i: (o, np.array([r]), t, i)), "it must be one finite number"),
    "reward NaN": (with_step(lambda o, r, t, i: (o, float("nan"), t, i)), "reward nan; it must be one finite number"),
    "terminated a number": (with_step(lambda o, r, t, i: (o, r, 0, i)), "terminated as 0; it must be True or False"),
    "info None": (with_step(lambda o, r, t, i: (o, r, t, None)), "info as None; it must be a dict"),
    "obs shared": (SharedObs, "an observation changes at a later step; return a new array"),
    "obs kept": (KeepsObs, "KeepsObs: it keeps arrays that it returned or was given"),
    "action kept": (KeepsAction, "KeepsAction: it keeps arrays that it returned or was given"),
    "action changed": (ChangesAction, "ChangesAction.step() changes the action that it is given"),
    "info shared": (SharedInfo, "SharedInfo.step() returns the same info dict twice"),
    "noise": (Noise, "Noise: two robots given the same random numbers and actions differ"),
    "global random numbers": (GlobalNoise, "draw all random numbers from reset's rng (they differ at step 0)"),
    "earlier episodes": (Remembers, "Remembers: an episode depends on earlier ones"),
    "number of draws": (DrawsMoreAtFirst, "DrawsMoreAtFirst: an episode depends on earlier ones"),
    "state on the class": (OnTheClass, "OnTheClass: a robot changes when another one steps"),
    "state incomplete": (
        Incomplete,
        "get_state() omits something",
    ),
    "obs of set_state": (WrongObsFromState, "an episode continues differently"),
    "state shared": (SharedState, "the state that get_state() returned changes at a later step"),
    "state kept": (KeepsState, "continues differently"),
    "state not float64": (
        type("Bad", (Good,), {"get_state": lambda self: [self.x, self.v]}),
        "it must always return a NumPy array (k,) of float64",
    ),
    "state sometimes None": (
        type("Bad", (Good,), {"get_state": lambda self: self.obs() if self.v == 0 else None}),
        "it must always return a NumPy array (k,) of float64",
    ),
    "get_state alone": (OnlyGetState, "defines only get_state(); get_state() and set_state() belong together"),
    "set_state alone": (OnlySetState, "defines only set_state(); get_state() and set_state() belong together"),
    "together": (Together, "Together.step_together() of 50 robots differs from step()"),
    "together, order": (TogetherOrder, "TogetherOrder.step_together() of 2 robots differs from step()"),
    "close once": (CloseOnce, "CloseOnce.close() fails with AssertionError: closed already"),
    "arguments": (NeedsArguments, "NeedsArguments.__init__() fails with TypeError"),
    "code that fails": (Fails, "Fails.step() fails with AttributeError: 'Fails' object has no attribute 'nothing'"),
    "no fps": (NoFps, "NoFps.fps is None; it must be a class attribute, a whole number of at least 1"),
    "fps with a fraction": (type("Bad", (Good,), {"fps": 62.5}), "Bad.fps is 62.5"),
    "an object": (Good(), "a robot must be a class that derives from envs.Robot"),
    "a Gymnasium class": (gymnasium.Env, "a robot must be a class that derives from envs.Robot"),
    "hyperparameters": (type("Bad", (Good,), {"hyperparameters": None}), "Bad.hyperparameters is None"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(mistake):
    robot, said = MISTAKES[mistake]
    with pytest.raises(envs.RobotError) as error:
        envs.check_robot(robot)
    assert said in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("attribute", ["obs_dim", "action_dim", "max_episode_steps", "fps"])
def test_a_missing_attribute_is_named(attribute):
    names = {name: getattr(Good, name) for name in ("obs_dim", "action_dim", "max_episode_steps", "fps")}
    del names[attribute]
    methods = {name: getattr(Good, name) for name in ("reset", "step", "obs", "render", "close")}
    with pytest.raises(envs.RobotError, match=rf"Bad.{attribute} is missing"):
        envs.check_robot(type("Bad", (envs.Robot,), methods | names))


@pytest.mark.parametrize("mistake", ["single precision", "five values", "noise", "obs shared", "code that fails"])
def test_training_names_the_mistake_before_it_starts(mistake, tmp_path, capsys, monkeypatch):
    robot, said = MISTAKES[mistake]
    monkeypatch.setitem(envs.TASKS, "bad", envs.Task(robot, Ball(0.1, 1), "", "", 100))
    assert run_command(f"algo=DPre env=bad results={tmp_path}".split()) == 2
    line = capsys.readouterr().err
    assert line.startswith("run.py: the robot of bad does not work: ") and said in line and line.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_group_of_hyperparameters_that_no_algorithm_has(tmp_path, capsys, monkeypatch):
    robot = type("Misspelt", (Good,), {"hyperparameters": "Hoper"})
    monkeypatch.setitem(envs.TASKS, "misspelt", envs.Task(robot, Ball(0.1, 1), "", "", 100))
    assert run_command(f"algo=DPre env=misspelt results={tmp_path}".split()) == 2
    line = capsys.readouterr().err
    assert "unknown hyperparameters of Misspelt 'Hoper'; did you mean Hopper?" in line and line.count("\n") == 1


# ---------------------------------------------------------------- robots from Gymnasium


@pytest.mark.parametrize("name", ["Pendulum-v1", "MountainCarContinuous-v0", "Ant-v5", "Hopper-v5"])
def test_a_gymnasium_robot_is_the_environment(name):
    robot_class = envs.GymnasiumRobot(name)
    assert robot_class is envs.GymnasiumRobot(name)
    envs.check_robot(robot_class, 60)
    robot, reference = robot_class(), gymnasium.make(name)
    rng = np.random.default_rng(5)
    obs = robot.reset(rng)
    wanted, _ = reference.reset(seed=int(np.random.default_rng(5).integers(2**31)))
    box = reference.action_space
    for _ in range(robot_class.max_episode_steps):
        np.testing.assert_array_equal(obs, wanted)
        action = rng.uniform(-1, 1, robot.action_dim)
        scaled = (box.low + box.high) / 2.0 + (box.high - box.low) / 2.0 * action
        obs, reward, terminated, _ = robot.step(action)
        wanted, wanted_reward, wanted_terminated, truncated, _ = reference.step(scaled.astype(box.dtype))
        assert (reward, terminated) == (wanted_reward, wanted_terminated)
        if terminated or truncated:
            break
    assert terminated or truncated


def test_the_ends_of_the_box():
    robot, seen = envs.GymnasiumRobot("Pendulum-v1")(), []
    robot.reset(np.random.default_rng(0))
    inner = robot.env.unwrapped
    inner.step = lambda action: seen.append(action.tolist()) or (np.zeros(3), 0.0, False, False, {})
    for action in (-1.0, 0.0, 0.25, 1.0, 1.0 + 9e-7):
        robot.step(np.array([action], np.float32))
    assert seen == [[-2.0], [0.0], [0.5], [2.0], [2.0]]


def test_a_gymnasium_robot_in_a_task_is_trained_and_resumed(tmp_path, monkeypatch):
    class Ant(envs.GymnasiumRobot("Ant-v5")):
        hyperparameters = "Hopper"

    monkeypatch.setitem(envs.TASKS, "Ant+L2", envs.Task(Ant, Ball(0.5, 8), "short", "x", 100))
    words = "algo=DRad env=Ant+L2 steps=40 learning_starts=20 batch_size=4 hidden=[8] eval_every=20 eval_episodes=1"
    assert train(tmp_path, f"{words} final_episodes=1")
    env = envs.make("Ant+L2", project=True)
    assert env.max_episode_steps == 1000 and env.observation_space.shape == (105,)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.ones(8, np.float32))
    other = envs.make("Ant+L2", project=True)
    other.set_state(env.get_state())
    np.testing.assert_array_equal(other.step(np.ones(8))[0], env.step(np.ones(8))[0])


@pytest.mark.parametrize(
    "name, said",
    [
        ("CartPole-v1", "has the action space Discrete(2); a robot needs a Box"),
        ("FrozenLake-v1", "has the observation space Discrete(16); a robot needs a Box"),
    ],
)
def test_environments_that_make_no_robot(name, said):
    with pytest.raises(ValueError) as error:
        envs.GymnasiumRobot(name)
    assert said in str(error.value)
    with pytest.raises(gymnasium.error.NameNotFound):
        envs.GymnasiumRobot("Anton-v5")


class Strange(gymnasium.Env):
    """Ends its own episodes, and has no pictures."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2, 2))

    def __init__(self, render_mode=None, bound=1.0):
        self.action_space = gymnasium.spaces.Box(-bound, bound, (2, 1))

    def reset(self, *, seed=None, options=None):
        self.left = 3
        return np.zeros((2, 2), np.float32), {}

    def step(self, action):
        assert action.shape == (2, 1)
        self.left -= 1
        return np.full((2, 2), self.left, np.float32), 0.0, False, self.left == 0, {}


@pytest.fixture
def strange():
    names = []

    def register(**settings):
        names.append(f"strange/Strange{len(names)}-v0")
        gymnasium.register(names[-1], entry_point=Strange, **settings)
        return names[-1]

    yield register
    for name in names:
        del gymnasium.registry[name]


def test_limits_and_boxes_that_do_not_fit(strange):
    with pytest.raises(ValueError, match="has no time limit"):
        envs.GymnasiumRobot(strange())
    with pytest.raises(ValueError, match="a robot needs a bounded Box of floats"):
        envs.GymnasiumRobot(strange(max_episode_steps=10, kwargs={"bound": np.inf}))
    robot = envs.GymnasiumRobot(strange(max_episode_steps=3))()
    assert robot.reset(np.random.default_rng(0)).shape == (4,)
    assert [robot.step(np.zeros(2))[2] for _ in range(3)] == [False] * 3  # the outer environment truncates
    with pytest.raises(RuntimeError, match="cannot be rendered"):
        robot.render()
    robot = envs.GymnasiumRobot(strange(max_episode_steps=10))()
    robot.reset(np.random.default_rng(0))
    with pytest.raises(RuntimeError, match="truncates an episode after 3 steps, before its time limit of 10"):
        [robot.step(np.zeros(2)) for _ in range(3)]


# ---------------------------------------------------------------- without OpenGL


@pytest.mark.parametrize("backend", ["osmesa", "nonsense"])
def test_a_missing_opengl_library_matters_to_pictures_only(backend, tmp_path):
    code = """
import ctypes.util, sys
sys.modules["OpenGL.osmesa"] = None  # importing it fails, as without the library
import envs, numpy as np
env = envs.make("HC+O", render_mode="rgb_array")
env.reset(seed=0)
env.step(np.zeros(6))
envs.GymnasiumRobot("Ant-v5")
try:
    env.render()
except RuntimeError as error:
    print(error)
"""
    run = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MUJOCO_GL": backend},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (run.returncode, run.stderr) == (0, "")
    assert f"the OpenGL backend '{backend}' does not work on this machine" in run.stdout
    assert run.stdout.count("\n") == 1 and "libosmesa6" in run.stdout
