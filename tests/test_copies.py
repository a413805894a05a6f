"""Copies of environments and robots continue like the originals, and a simulator's memory is freed with its object."""

import copy
import gc
import multiprocessing
import os
import pickle
import subprocess
import sys
from pathlib import Path

import cloudpickle
import gymnasium
import numpy as np
import pytest

import envs
from constraints import WeightedL1
from envs.locomotion import HalfCheetah, Hopper, Walker2d
from envs.reacher import Reacher

ROOT = Path(__file__).resolve().parent.parent
WAYS = {
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "cloudpickle": lambda x: cloudpickle.loads(cloudpickle.dumps(x)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}
every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)


class Mass(envs.Robot):
    """A point on a line with a generator and views of its own memory, as in simulators; neither can be pickled."""

    obs_dim, action_dim, max_episode_steps, fps = 3, 2, 30, 10

    def __init__(self):
        self.memory = np.zeros(3)
        self.view = self.memory[:2]
        self.handle = (x for x in ())

    def reset(self, rng):
        self.memory[:] = rng.uniform(-1, 1, 3)
        return self.memory.copy()

    def step(self, action):
        self.view += 0.1 * np.asarray(action)
        return self.memory.copy(), float(self.memory[0]), bool(self.memory[0] > 1.5), {}

    def render(self):
        return np.full((480, 480, 3), int(100 * self.memory[0]) % 256, np.uint8)

    def close(self):
        pass


class MassWithState(Mass):
    def get_state(self):
        return self.memory.copy()

    def set_state(self, state):
        self.memory[:] = state
        return self.memory.copy()


OWN = {
    name: envs.Task(robot, WeightedL1(lambda obs: obs[..., :2], 0.2, 2), "own", "x", 100)
    for name, robot in (("own", Mass), ("own+state", MassWithState))
}


@pytest.fixture
def own_tasks(monkeypatch):
    for name, task in OWN.items():
        monkeypatch.setitem(envs.TASKS, name, task)


def answers(env, rng, steps):
    """The answers of `env` to random actions, with resets at the ends of episodes, and its counters."""
    numbers = []
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32 if rng.random() < 0.5 else np.float64)
        obs, reward, terminated, truncated, info = env.step(action)
        numbers.append([*obs, reward, terminated, truncated, *info["executed_action"]])
        if terminated or truncated:
            obs, _ = env.reset()
            numbers.append([*obs, *[0] * (len(numbers[-1]) - len(obs))])
    inner = env.unwrapped
    return np.array(numbers), inner.largest_violation, inner.executed_actions, inner.elapsed_steps


def same(first, second):
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1:] == second[1:]


def go_to(env, state):
    """Bring `env` into a state: "new", "start", "middle" or "end" of an episode."""
    if state == "new":
        return
    env.reset(seed=4)
    rng = np.random.default_rng(1)
    if state == "middle":
        for _ in range(7):
            env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
    elif state == "end":
        while not any(env.step(rng.uniform(-1, 1, env.action_space.shape))[2:4]):
            pass


TASKS = ["R+L2", "HC+O", "H+O+S", "W+M", "own", "own+state", "pybullet"]


def make(task, **settings):
    if task == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
        return envs.make("R+T", project=True, simulator="pybullet", **settings)
    return envs.make(task, project=True, **settings)


@every_way
@pytest.mark.parametrize("state", ["new", "start", "middle", "end"])
@pytest.mark.parametrize("task", TASKS)
def test_a_copied_environment_goes_on_bit_for_bit(task, state, way, own_tasks):
    env = make(task)
    go_to(env, state)
    twin = way(env)
    assert twin.constraint is env.constraint  # so that both can be stepped together
    assert twin.get_state()["random_numbers"] == env.get_state()["random_numbers"]
    np.testing.assert_array_equal(twin.action_space.sample(), env.action_space.sample())
    if state in ("new", "end"):
        for each in (env, twin):
            with pytest.raises(gymnasium.error.ResetNeeded):
                each.step(np.zeros(each.action_space.shape))
        np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])
    middle = way(twin)  # a copy of a copy
    expected = answers(env, np.random.default_rng(0), 60)
    assert len(np.unique(expected[0], axis=0)) > 40  # it moves
    same(answers(twin, np.random.default_rng(0), 60), expected)
    same(answers(middle, np.random.default_rng(0), 60), expected)  # the copies did not disturb each other


@pytest.mark.parametrize("way", [*WAYS.values()][:3], ids=[*WAYS][:3])  # a shallow copy would wrap the same env
@pytest.mark.parametrize("options", [{}, {"max_episode_steps": 20}])
@pytest.mark.parametrize("task", ["R-T", "W-M"])
def test_through_gymnasiums_wrappers(task, options, way):
    env = gymnasium.make(f"acrl/{task}-v0", project=True, **options)
    env = gymnasium.wrappers.RecordEpisodeStatistics(env)
    go_to(env, "middle")
    twin = way(env)
    assert twin.spec == env.spec
    same(answers(twin, np.random.default_rng(0), 50), answers(env, np.random.default_rng(0), 50))


@every_way
@pytest.mark.parametrize("settings", [{}, {"show_set": True, "dtype": np.float32}])
@pytest.mark.parametrize("task", ["R+T", "pybullet", "own", "own+state"])
@pytest.mark.parametrize("state", ["middle", "end"])
def test_copies_draw_the_same_pictures(task, state, settings, way, own_tasks):
    env = make(task, render_mode="rgb_array", **settings)
    go_to(env, state)
    twin = way(env)
    np.testing.assert_array_equal(twin.render(), env.render())
    assert (twin.render_mode, twin.show_set, twin.observation_space) == (
        "rgb_array",
        env.show_set,
        env.observation_space,
    )


@pytest.mark.parametrize("task", ["HC+O", "W+M"])
def test_copies_draw_the_same_pictures_on_mujoco(task):
    env = envs.make(task, project=True, render_mode="rgb_array")
    go_to(env, "middle")
    try:
        picture = env.render()
    except RuntimeError as error:
        assert "libegl1 or libosmesa6" in str(error)
        return
    twin = copy.deepcopy(env)  # with a renderer of its own
    np.testing.assert_array_equal(twin.render(), picture)
    same(answers(twin, np.random.default_rng(0), 20), answers(env, np.random.default_rng(0), 20))
    np.testing.assert_array_equal(twin.render(), env.render())


def test_a_picture_changes_nothing():
    env, twin = (envs.make("W+M", project=True, render_mode="rgb_array") for _ in range(2))
    for each in (env, twin):
        go_to(each, "middle")
    env.robot._place_bodies()  # as a picture does
    same(answers(env, np.random.default_rng(0), 50), answers(twin, np.random.default_rng(0), 50))


def test_attributes_of_ones_own_are_copied():
    env = envs.make("H+M")
    env.label = ["mine"]
    twin = copy.deepcopy(env)
    assert twin.label == ["mine"] and twin.label is not env.label
    robot = HalfCheetah()
    robot.ctrl_cost_weight = 0.5
    assert pickle.loads(pickle.dumps(robot)).ctrl_cost_weight == 0.5


@every_way
def test_a_copy_of_a_closed_environment_is_closed(way):
    env = make("pybullet")
    go_to(env, "middle")
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        way(env).reset()


class Precise(Mass):
    """A mass that computes in the precision of its actions."""

    def step(self, action):
        self.view += np.square(action) / 3
        return self.memory.copy(), float(np.square(action).sum()), False, {}


def test_repeated_actions_keep_their_precision(monkeypatch):
    """With `project`, an episode mixes float32 actions with float64 projections."""
    monkeypatch.setitem(envs.TASKS, "precise", envs.Task(Precise, WeightedL1(lambda o: o[..., :2], 0.2, 2), "", "", 9))
    env, other = envs.make("precise", project=True), envs.make("precise", project=True)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(12):
        env.step(rng.uniform(-0.5, 0.5, 2).astype(np.float32))
    assert {action.dtype for action in env._actions} == {np.dtype(np.float32), np.dtype(np.float64)}
    other.set_state(env.get_state())
    np.testing.assert_array_equal(other._obs, env._obs)


# ---------------------------------------------------------------- robots alone


@every_way
@pytest.mark.parametrize("robot", ["Reacher", "PyBulletReacher", "HalfCheetah", "Hopper", "Walker2d", "Pendulum-v1"])
@pytest.mark.parametrize("steps", [None, 0, 9])
def test_a_copied_robot_goes_on_bit_for_bit(robot, steps, way):
    if robot == "PyBulletReacher":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
        from envs.pybullet_reacher import PyBulletReacher as robot_class
    elif robot == "Pendulum-v1":
        robot_class = envs.GymnasiumRobot(robot)
    else:
        robot_class = {cls.__name__: cls for cls in (Reacher, HalfCheetah, Hopper, Walker2d)}[robot]
    actions = np.random.default_rng(0).uniform(-1, 1, (40, robot_class.action_dim))
    machine = robot_class()
    if steps is not None:
        machine.reset(np.random.default_rng(3))
        for action in actions[:steps]:
            machine.step(action)
    twin = way(machine)
    assert type(twin) is robot_class
    if steps is None:
        np.testing.assert_array_equal(*(each.reset(np.random.default_rng(3)) for each in (machine, twin)))
    for action in actions:
        (obs, reward, *_), (other_obs, other_reward, *_) = machine.step(action), twin.step(action)
        np.testing.assert_array_equal(obs, other_obs)
        assert reward == other_reward


# ---------------------------------------------------------------- other processes


def _answers_elsewhere(content):
    return answers(pickle.loads(content), np.random.default_rng(0), 40)


@pytest.mark.parametrize("task", ["R+T", "W+M", "pybullet"])
def test_in_another_process(task):
    env = make(task)
    go_to(env, "middle")
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(_answers_elsewhere, (pickle.dumps(env),))
    same(elsewhere, answers(env, np.random.default_rng(0), 40))


SCRIPT = """
import sys, cloudpickle, numpy as np, envs
from constraints import WeightedL1
class Mine(envs.Robot):
    obs_dim, action_dim, max_episode_steps, fps = 2, 2, 50, 10
    def reset(self, rng):
        self.x = rng.uniform(-1, 1, 2)
        return self.x.copy()
    def step(self, action):
        self.x = self.x + 0.1 * action
        return self.x.copy(), float(self.x[0]), False, {}
    def render(self): ...
    def close(self): ...
envs.TASKS["mine"] = envs.Task(Mine, WeightedL1(lambda obs: obs, 0.3, 2), "mine", "x", 10)
env = envs.make("mine", project=True)
env.reset(seed=0)
env.step(np.ones(2))
sys.stdout.buffer.write(cloudpickle.dumps(env))
"""


def test_a_task_that_the_other_process_does_not_know_comes_along():
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True
    )
    assert run.returncode == 0, run.stderr
    assert "mine" not in envs.TASKS
    env = cloudpickle.loads(run.stdout)
    assert env.elapsed_steps == 1 and env.constraint.dim == 2
    rewards = [env.step(np.ones(2))[1] for _ in range(5)]
    assert len(set(rewards)) == 5


# ---------------------------------------------------------------- handles, and use after close


def test_pybullets_clients_go_with_their_robots():
    pybullet = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    from envs.pybullet_reacher import PyBulletReacher

    robot = PyBulletReacher()
    client = robot._client
    del robot
    gc.collect()
    assert not pybullet.getConnectionInfo(client)["isConnected"]
    env = envs.make("R+T", simulator="pybullet")
    env.reset(seed=0)
    client = env.robot._client
    del env
    gc.collect()
    assert not pybullet.getConnectionInfo(client)["isConnected"]


def test_renderers_go_with_their_robots(monkeypatch):
    freed = []

    class Context:
        def __init__(self, *arguments):
            pass

        def make_current(self):
            pass

        def free(self):
            freed.append(type(self).__name__)

    import mujoco

    from envs import locomotion

    class Module:
        GLContext = Context

    monkeypatch.setattr(locomotion.importlib, "import_module", lambda name: Module if name != "mujoco" else mujoco)
    monkeypatch.setattr(locomotion, "_gl_backend", lambda: "egl")
    monkeypatch.setattr(mujoco, "MjrContext", Context)
    monkeypatch.setattr(mujoco, "mjr_setBuffer", lambda *arguments: None)
    monkeypatch.setattr(mujoco, "mjr_render", lambda *arguments: None)
    monkeypatch.setattr(mujoco, "mjr_readPixels", lambda *arguments: None)
    for end in ("close", "go"):
        robot = Hopper()
        robot.render()
        assert not freed
        if end == "close":
            robot.close(), robot.close()
        del robot
        gc.collect()
        assert freed == ["Context", "Context"]  # of MuJoCo and of OpenGL, each once
        freed.clear()


def test_a_process_that_ends_without_close_is_silent():
    code = "import envs\nfor task in ('W+M', 'R+N'):\n"
    code += "    env = envs.make(task, render_mode='rgb_array')\n    env.reset(seed=0)\n"
    code += (
        "    try:\n        env.render()\n    except RuntimeError as error:\n        assert 'libegl1' in str(error)\n"
    )
    code += "try:\n    other = envs.make('R+N', simulator='pybullet')\nexcept envs.UnavailableError:\n    pass"
    run = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_a_closed_robot_of_pybullet_says_so():
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    from envs.pybullet_reacher import PyBulletReacher

    robot = PyBulletReacher()
    robot.reset(np.random.default_rng(0))
    robot.close(), robot.close()
    for use in (lambda: robot.step(np.zeros(2)), lambda: robot.reset(np.random.default_rng(0)), robot.render):
        with pytest.raises(RuntimeError, match="this PyBulletReacher is closed"):
            use()


@pytest.mark.parametrize("task", TASKS)
def test_use_after_close_is_a_clear_error_alike_for_all_robots(task, own_tasks):
    env = make(task, render_mode="rgb_array")
    go_to(env, "middle")
    state = env.get_state()
    for _ in range(2):
        env.close()
    uses = {"step": lambda: env.step(np.zeros(env.action_space.shape)), "reset": env.reset, "render": env.render}
    uses |= {"get_state": env.get_state, "set_state": lambda: env.set_state(state)}
    for method, use in uses.items():
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match=rf"{method}\(\) after close\(\)"):
            use()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        envs.step_together([env], np.zeros((1, *env.action_space.shape)))
