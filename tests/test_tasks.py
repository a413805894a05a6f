"""Rows of `envs.TASKS`: bad rows, and how Gymnasium finds them; edge cases of Gymnasium's interface."""

import inspect
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec

import envs
from constraints import Ball, Box
from envs import tasks
from envs.locomotion import HalfCheetah, Hopper, Walker2d
from envs.reacher import Reacher
from envs.registry import Task

ROOT = Path(__file__).resolve().parent.parent
ROW = {"robot": Reacher, "constraint": Ball(0.1, 2), "description": "a task", "formula": "x", "steps": 1000}


@pytest.fixture
def table():
    """`envs.TASKS`. Entries that a test adds are removed afterwards."""
    before = set(envs.TASKS)
    yield envs.TASKS
    for name in set(envs.TASKS) - before:
        del envs.TASKS[name]


class NoStep(envs.Robot):
    obs_dim, action_dim, max_episode_steps, fps = 2, 2, 10, 10

    def reset(self, rng): ...

    def render(self): ...

    def close(self): ...


class NoLimit(Reacher):
    max_episode_steps = 0


@pytest.mark.parametrize(
    "part, said",
    [
        ({"robot": Reacher()}, "a robot must be a class that derives from envs.Robot"),
        ({"robot": dict}, "a robot must be a class that derives from envs.Robot, got <class 'dict'>"),
        ({"robot": NoStep}, "NoStep lacks methods: step"),
        ({"robot": NoLimit}, "NoLimit.max_episode_steps is 0"),
        ({"constraint": None}, "constraint must be an instance of constraints.Constraint, got None"),
        ({"constraint": Box}, "constraint must be an instance of constraints.Constraint, got <class"),
        ({"constraint": Box(3)}, "the constraint is for 3 action coordinates, but the robot Reacher has 2"),
        ({"description": None}, "description must be text, got None"),
        ({"formula": 3}, "formula must be text, got 3"),
        ({"steps": 0}, "steps must be a whole number of at least 1, got 0"),
        ({"steps": 3e5}, "steps must be a whole number of at least 1, got 300000.0"),
        ({"steps": True}, "steps must be a whole number of at least 1, got True"),
    ],
)
def test_parts_of_a_task_that_do_not_fit(part, said):
    with pytest.raises((TypeError, ValueError)) as error:
        Task(**(ROW | part))
    assert said in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "all",
        "All",
        "figures",
        "a/b",
        "a,b",
        "a b",
        " a",
        "a=b",
        ".a",
        "..",
        "-a",
        "+a",
        "a\n",
        "a\\b",
        "a:b",
        3,
        None,
    ],
)
def test_names_that_are_refused(name, table):
    with pytest.raises(ValueError, match="bad name .* for a task"):
        table[name] = Task(**ROW)
    assert name not in table


def test_every_way_into_the_table_is_checked(table):
    row = Task(**ROW)
    ways = [
        lambda: table.update({"a b": row}),
        lambda: table.setdefault("a b", row),
        lambda: table.__setitem__("a b", row),
    ]
    for way in ways:
        with pytest.raises(ValueError, match="bad name"):
            way()
    with pytest.raises(TypeError, match="must be an envs.Task, got 3"):
        table["three"] = 3
    assert "three" not in table


def test_a_taken_name_is_not_replaced(table):
    before = table["R+L2"]
    with pytest.raises(ValueError, match=r"the task 'R\+L2' exists already: choose another name"):
        table["R+L2"] = Task(**ROW)
    with pytest.raises(ValueError, match=r"identifier acrl/R-L2-v0, which R\+L2 has already"):
        table["R-L2"] = Task(**ROW)
    assert table["R+L2"] is before and "R-L2" not in table
    table["mine"] = Task(**ROW)
    del table["mine"]
    assert "acrl/mine-v0" not in gymnasium.registry
    table["mine"] = Task(**ROW)


def test_gymnasium_finds_a_task_that_is_entered_later(table):
    table["P+O.3_x-é"] = Task(**ROW)
    env = gymnasium.make("acrl/P-O.3_x-é-v0", project=True)
    assert env.unwrapped.task == "P+O.3_x-é" and env.spec.max_episode_steps == 150
    env.reset(seed=0)
    assert np.isfinite(env.step(np.ones(2, np.float32))[1])
    vector = gymnasium.make_vec("acrl/P-O.3_x-é-v0", num_envs=2, project=True)
    assert vector.reset(seed=0)[0].shape == (2, 9)


def test_the_modules_can_be_loaded_again():
    code = "import importlib, envs, envs.registry\nfor module in (envs.registry, envs.tasks):\n"
    code += "    importlib.reload(module)\nimport gymnasium; gymnasium.make('acrl/W-M-v0').reset(seed=0)"
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_a_registered_task_is_copied_as_itself():
    task = envs.TASKS["H+O+S"]
    assert pickle.loads(pickle.dumps(task)) is task


# ---------------------------------------------------------------- Gymnasium's edges


def test_spec_makes_the_same_environment():
    env = envs.make("R+T", project=True, render_mode="rgb_array", show_set=True, dtype=np.float32)
    assert (env.spec.id, env.spec.max_episode_steps) == ("acrl/R-T-v0", 150)
    assert envs.make("W+M").spec.max_episode_steps == 1000
    again = gymnasium.make(EnvSpec.from_json(json.dumps(json.loads(env.spec.to_json())))).unwrapped
    for name in ("task", "project", "render_mode", "show_set", "observation_space", "max_episode_steps"):
        assert getattr(again, name) == getattr(env, name)
    np.testing.assert_array_equal(again.reset(seed=1)[0], env.reset(seed=1)[0])


@pytest.mark.parametrize("limit, expected", [(None, 150), (20, 20), (400, 400), (-1, None)])
def test_the_time_limit_given_to_gymnasium(limit, expected):
    env = gymnasium.make("acrl/R-N-v0", max_episode_steps=limit)
    assert env.unwrapped.max_episode_steps == env.spec.max_episode_steps == expected
    env.reset(seed=0)
    for step in range(1, 500):
        truncated = env.step(np.zeros(2, np.float32))[3]
        assert truncated == (step == expected)
        if truncated:
            break
    assert step == (expected or 499)
    if expected:
        with pytest.raises(gymnasium.error.ResetNeeded, match="the episode is over"):
            env.step(np.zeros(2, np.float32))
        env.reset()
        env.step(np.zeros(2, np.float32))


@pytest.mark.parametrize("task", ["R+N", "H+M", "W+M", "pybullet"])
def test_after_the_end_of_an_episode_a_reset_is_needed(task):
    if task == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
        env = envs.make("R+N", project=True, simulator="pybullet")
    else:
        env = envs.make(task, project=True)
    env.reset(seed=0)
    action = np.ones(env.action_space.shape)
    while not any(env.step(action)[2:4]):
        pass
    steps = env.executed_actions
    for use in (lambda: env.step(action), lambda: envs.step_together([env], action[None])):
        with pytest.raises(gymnasium.error.ResetNeeded, match="the episode is over; call reset"):
            use()
    assert env.executed_actions == steps
    env.reset()
    env.step(action)


@pytest.mark.parametrize("dtype", [np.float32, "float32"])
def test_observations_in_single_precision(dtype):
    """The environment itself does not change: the same rewards and the same exact observations."""
    env, exact = envs.make("W+O+S", project=True, dtype=dtype), envs.make("W+O+S", project=True)
    assert env.observation_space.dtype == np.float32
    rng = np.random.default_rng(0)
    obs, wanted = env.reset(seed=0)[0], exact.reset(seed=0)[0]
    for _ in range(300):
        assert obs.dtype == np.float32 and env.observation_space.contains(obs)
        np.testing.assert_array_equal(obs, wanted.astype(np.float32))
        assert env._obs is None or env._obs.dtype == np.float64
        action = rng.uniform(-1, 1, 6)
        (obs, reward, *ends, info), (wanted, wanted_reward, *wanted_ends, wanted_info) = (
            env.step(action),
            exact.step(action),
        )
        assert (reward, ends) == (wanted_reward, wanted_ends)
        np.testing.assert_array_equal(info["executed_action"], wanted_info["executed_action"])
        if any(ends):
            obs, wanted = env.reset()[0], exact.reset()[0]
    assert env.largest_violation == exact.largest_violation <= envs.TOLERANCE
    for bad in (np.int64, "float16"):
        with pytest.raises(ValueError, match="of observations .choices: float64, float32"):
            envs.make("R+N", dtype=bad)


# ---------------------------------------------------------------- the entries of an observation


def rows_of(robot):
    """The table in a robot's docstring: the indices of each row, and its words."""
    text = re.sub(r"\n {6,}(?=[a-z])", " ", inspect.getdoc(robot))  # a row may have a second line
    rows = re.findall(r"^ *(\d+)(?:-(\d+))? +(.*)$", text, re.MULTILINE)
    return [(range(int(first), int(last or first) + 1), words) for first, last, words in rows]


@pytest.mark.parametrize("task", ["HC+O", "H+M", "W+M"])
def test_the_table_of_an_observation_names_mujocos_joints(task):
    """Each joint is moved alone in the simulator, by its name, and changes only the entry at its index."""
    robot = envs.TASKS[task].robot()
    robot.reset(np.random.default_rng(0))
    joints = {
        robot._mujoco.mj_id2name(robot.model, robot._mujoco.mjtObj.mjOBJ_JOINT, k): k for k in range(robot.model.njnt)
    }
    seen = []
    for indices, words in rows_of(type(robot)):
        quantity, _, names = words.partition(": ")
        names = names.split(", ")
        assert len(names) == len(indices)
        memory = robot.data.qvel if "velocit" in quantity else robot.data.qpos
        for index, name in zip(indices, names, strict=True):
            before, address = robot._observe(), joints[name]
            memory[address] += 0.01
            assert np.flatnonzero(robot._observe() != before).tolist() == [index]
            seen.append(index)
    assert seen == list(range(robot.obs_dim))
    assert list(joints)[3:] == [
        robot._mujoco.mj_id2name(robot.model, robot._mujoco.mjtObj.mjOBJ_JOINT, k)
        for k in robot.model.actuator_trnid[:, 0]
    ]  # actions are in the order of these joints


def test_the_table_of_reachers_observation():
    arm = Reacher()
    arm.reset(np.random.default_rng(0))
    obs = arm.step(np.array([0.3, -0.2]))[0]
    state = arm.state
    assert rows_of(Reacher) == [
        (range(0, 2), "target, x and y in m"),
        (range(2, 4), "fingertip minus target, x and y in m; the fingertip is that of a step ago"),
        (range(4, 6), "cos and sin of the angle of joint 0"),
        (range(6, 7), "0.1 times the velocity of joint 0 in rad/s"),
        (range(7, 8), "the angle of joint 1 in rad divided by 3, its limit"),
        (range(8, 9), "0.1 times the velocity of joint 1 in rad/s"),
    ]
    target, seen = np.array(state[4:6]), np.array(state[6:8])
    values = [target, seen - target, (np.cos(state.q1), np.sin(state.q1)), (0.1 * state.w1,), (state.q2 / 3,)]
    np.testing.assert_array_equal(obs, np.concatenate([*values, (0.1 * state.w2,)]))


@pytest.mark.parametrize("robot", [HalfCheetah, Hopper, Walker2d])
def test_the_tasks_look_at_the_angles_and_velocities_of_the_tables(robot):
    angles, velocities = (
        next([*indices] for indices, words in rows_of(robot) if words.startswith(f"{quantity} of the driven"))
        for quantity in ("angles", "velocities")
    )
    obs = torch.rand(robot.obs_dim, dtype=torch.float64)
    kind = "hopper" if robot is Hopper else "six_joint"
    assert torch.equal(getattr(tasks, f"_{kind}_velocities")(obs), obs[velocities])
    assert torch.equal(getattr(tasks, f"_{kind}_sin2")(obs), obs[angles].sin().square())
