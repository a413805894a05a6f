"""Environments: equality with the originals, the feasibility check, Gymnasium's interface, pictures."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import envs
from envs.locomotion import HalfCheetah, Hopper, Walker2d
from envs.reacher import Reacher

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "tests" / "data"
NAMES = ["R+N", "R+L2", "R+O03", "R+O10", "R+O30", "R+M", "R+T", "HC+O", "HC+MA", "H+M", "H+O+S", "W+M", "W+O+S"]
LOCOMOTION = [("HalfCheetah", HalfCheetah, "HC+O"), ("Hopper", Hopper, "H+M"), ("Walker2d", Walker2d, "W+M")]
SMALL = 0.05  # actions up to this size are feasible in every task at any state the tests reach


def gymnasium_v4(name, **kwargs):
    mujoco.set_mju_user_warning(lambda message: None)  # otherwise it writes a MUJOCO_LOG.TXT
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "v4 is out of date": v4 is wanted here
            return gymnasium.make(f"{name}-v4", **kwargs)
    finally:
        mujoco.set_mju_user_warning(None)


def draw(rng, env):
    return rng.uniform(-1, 1, env.action_space.shape)


# ---------------------------------------------------------------- the originals


def test_reacher_env_seeds_as_the_original():
    env = envs.make("R+N")
    for seed in (0, 1):
        first, second = np.load(DATA / f"golden_seed{seed}.npz")["obs"][:, 0]
        np.testing.assert_allclose(env.reset(seed=seed)[0], first, rtol=0, atol=1e-6)
        np.testing.assert_allclose(env.reset()[0], second, rtol=0, atol=1e-6)
    env.close()


@pytest.mark.parametrize("name, robot_class, task", LOCOMOTION)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_locomotion_equals_gymnasium_v4(name, robot_class, task, seed):
    """Long rollouts as in training, with falls and resets, in both precisions, equal to the last bit."""
    reference, robot = gymnasium_v4(name).unwrapped, robot_class()
    rng, noise = np.random.default_rng(seed), np.random.default_rng(seed + 10)
    np.testing.assert_array_equal(robot.reset(rng), reference.reset(seed=seed)[0])
    falls = 0
    for t in range(1200):
        action = noise.uniform(-1, 1, robot.action_dim).astype(np.float32 if t % 2 else np.float64)
        expected_obs, expected_reward, expected_terminated, _, expected_info = reference.step(action)
        obs, reward, terminated, info = robot.step(action)
        np.testing.assert_array_equal(obs, expected_obs)
        assert obs.dtype == expected_obs.dtype == np.float64
        assert reward == expected_reward
        assert terminated == expected_terminated
        assert info == {key: expected_info[key] for key in ("x_position", "x_velocity")}
        if terminated:
            falls += 1
            np.testing.assert_array_equal(robot.reset(rng), reference.reset()[0])
    assert falls == 0 if name == "HalfCheetah" else falls > 10


@pytest.mark.parametrize("name, robot_class, task", LOCOMOTION)
def test_locomotion_env_equals_gymnasium_v4_through_the_time_limit(name, robot_class, task):
    reference, env = gymnasium_v4(name, disable_env_checker=True), envs.make(task, project=True)
    noise = np.random.default_rng(3)
    for seed in (7, None):  # the second reset continues the first one's random stream
        obs = env.reset(seed=seed)[0]
        np.testing.assert_array_equal(obs, reference.reset(seed=seed)[0])
        for t in range(1000):
            env._obs = obs  # go on after a fall, as only the reference allows
            obs, reward, terminated, truncated, info = env.step(draw(noise, env))
            expected = reference.step(info["executed_action"])
            np.testing.assert_array_equal(obs, expected[0])
            assert (reward, terminated, truncated) == expected[1:4]
            assert truncated == (t == 999)


@pytest.mark.parametrize("name, robot_class", [("Hopper", Hopper), ("Walker2d", Walker2d)])
def test_falls_are_gymnasiums_on_both_sides_of_every_limit(name, robot_class):
    reference, robot = gymnasium_v4(name).unwrapped, robot_class()
    robot.reset(np.random.default_rng(0))
    limits = [("qpos", 1, z) for z in (0.7, 0.8, 2.0)]
    limits += [("qpos", 2, angle) for angle in (-1.0, -0.2, 0.2, 1.0)]
    limits += [(part, i, value) for part in ("qpos", "qvel") for i in (-1, -2, -3) for value in (-100, 100)]
    limits += [("qvel", 0, -100.0), ("qvel", 0, 100.0)]
    seen = set()
    for part, index, limit in limits:
        for value in (limit - 1e-6, limit, limit + 1e-6):
            for data in (reference.data, robot.data):
                data.qpos[:], data.qvel[:] = robot.model.qpos0, 0.0
                getattr(data, part)[index] = value
            assert robot._healthy() == reference.is_healthy
            seen.add(robot._healthy())
    assert seen == {True, False}


def test_reacher_env_truncates_after_150_steps():
    env = envs.make("R+N")
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(np.zeros(2))[2:4] for _ in range(150)]
        assert ends == [(False, False)] * 149 + [(False, True)]


@pytest.mark.parametrize("robot_class", [HalfCheetah, Hopper, Walker2d])
def test_frame_rate_is_real_time(robot_class):
    robot = robot_class()
    assert robot.model.opt.timestep * robot.frame_skip * robot.fps == pytest.approx(1)


# ---------------------------------------------------------------- the table of tasks


def joint_angles_and_velocities(env):
    """theta and w (d,) of the driven joints, read from the simulator by joint, not from obs by index."""
    robot = env.robot
    if isinstance(robot, Reacher):
        return np.array(robot.state[:2]) * (1, 1 / 3), 0.1 * np.array(robot.state[2:4])
    joints = robot.model.actuator_trnid[:, 0]
    angles = robot.data.qpos[robot.model.jnt_qposadr[joints]]
    velocities = robot.data.qvel[robot.model.jnt_dofadr[joints]]
    return angles, velocities if isinstance(robot, HalfCheetah) else velocities.clip(-10, 10)


def excess(task, a, theta, w):
    """The k constraints of the paper's table at actions (n, d), as left side / bound - 1 (n, k)."""
    l1, positive = np.abs(w * a).sum(-1), np.maximum(w * a, 0).sum(-1)
    ellipse = (a**2 * np.sin(theta) ** 2).sum(-1)
    a1, a2 = a[:, 0], a[:, 1]
    sides = {
        "R+N": [],
        "R+L2": [(a1**2 + a2**2) / 0.05],
        "R+O03": [l1 / 0.3],
        "R+O10": [l1 / 1],
        "R+O30": [l1 / 3],
        "R+M": [positive / 1],
        "R+T": [(a1**2 + 2 * a1 * (a1 + a2) * np.cos(theta[1]) + (a1 + a2) ** 2) / 0.05],
        "HC+O": [l1 / 20],
        "H+M": [positive / 10],
        "H+O+S": [l1 / 10, ellipse / 0.1],
        "W+M": [positive / 10],
        "W+O+S": [l1 / 10, ellipse / 0.1],
    }
    if task == "HC+MA":
        back, front = np.sin(theta[:3].sum()), np.sin(theta[3:].sum())
        sides["HC+MA"] = [(w[0] * a[:, 0] * back + w[3] * a[:, 3] * front) / 5]
    return np.stack([np.abs(a).max(-1), *sides[task]], -1) - 1


def test_table_of_tasks():
    assert list(envs.TASKS) == NAMES
    for name, task in envs.TASKS.items():
        assert task.steps == (300_000 if name.startswith("R+") else 1_000_000)
        assert task.constraint.dim == task.robot.action_dim
        assert envs.constraint(name) is task.constraint
        assert task.description


@pytest.mark.parametrize("task", NAMES)
def test_feasible_set_is_the_papers(task):
    """Feasibility of random actions along a rollout, against the paper's formulas on the simulator's joints."""
    env, rng = envs.make(task, project=True), np.random.default_rng(0)
    infeasible = set()
    for t in range(600):
        if t % 100 == 0:  # not after falls, which bring large velocities
            obs, _ = env.reset(seed=t)
        if t % 20 == 0:  # keep a push for a while, so that the constraint matters
            push = rng.choice([-1.0, 1.0], env.action_space.shape)
        # actions of every length, many at corners of the box, some beyond it
        actions = rng.normal(0, 1.5, (64, *env.action_space.shape)).clip(-1, 1) * rng.uniform(0, 1.1, (64, 1))
        sides = excess(task, actions, *joint_angles_and_velocities(env))
        violation = env.constraint.violation(torch.from_numpy(obs), torch.from_numpy(actions)).numpy()
        clear = np.abs(sides).min(-1) > 1e-9  # rounding decides on the boundary itself
        np.testing.assert_array_equal((violation <= 0)[clear], (sides <= 0).all(-1)[clear])
        infeasible.update(np.flatnonzero((sides > 0).any(0)))
        obs = env._obs = env.step(push)[0]
    assert infeasible == set(range(sides.shape[1]))  # the box and every constraint were violated somewhere
    env.close()


# ---------------------------------------------------------------- the feasibility check


def reach_an_infeasible_action(env, rng):
    """Drive `env` by feasible actions to a state with a clearly infeasible action in the box. Returns that action."""
    obs, _ = env.reset(seed=1)
    for _ in range(1000):
        corners = torch.from_numpy(rng.choice([-1.0, 1.0], (64, env.action_space.shape[0])))
        violation = env.constraint.violation(torch.from_numpy(obs), corners)
        if violation.max() > 0.01:
            return corners[violation.argmax()].numpy()
        action = env.constraint.project(torch.from_numpy(obs), torch.from_numpy(draw(rng, env)))
        obs, _, terminated, truncated, _ = env.step(action.numpy())
        if terminated or truncated:
            obs, _ = env.reset()
    raise AssertionError("every corner of the box stayed feasible")


@pytest.mark.parametrize("task", NAMES)
def test_infeasible_action_is_refused_and_projected_on_request(task):
    env = envs.make(task)
    if task == "R+N":
        env.reset(seed=1)
        action = np.array([1.5, 0.0])
    else:
        action = reach_an_infeasible_action(env, np.random.default_rng(0))
    before, count, step = torch.tensor(env._obs), env.executed_actions, env.elapsed_steps
    violation = env.constraint.violation(before, torch.from_numpy(action)).item()
    with pytest.raises(envs.InfeasibleActionError) as refusal:
        env.step(action)
    for part in (f"{task}, step {step + 1} ", f"{violation:.3g}"):
        assert part in str(refusal.value)
    assert isinstance(refusal.value, ValueError)
    assert (env.executed_actions, env.elapsed_steps) == (count, step)
    assert env.largest_violation <= envs.TOLERANCE

    expected = env.constraint.project(before, torch.from_numpy(action)).numpy()
    env.project = True
    obs, _, _, _, info = env.step(action)
    np.testing.assert_array_equal(info["executed_action"], expected)
    assert np.abs(expected - action).max() > 1e-3
    assert env.executed_actions == count + 1
    assert env.largest_violation <= envs.TOLERANCE
    assert not np.array_equal(obs, before.numpy())  # the projection was executed
    env.close()


def test_tolerance_and_bookkeeping():
    env = envs.make("R+N")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    env.reset(seed=0)
    assert (env.largest_violation, env.executed_actions) == (-np.inf, 0)
    env.step(np.array([0.25, 0.5]))
    assert (env.largest_violation, env.executed_actions) == (-0.5, 1)
    env.step(np.array([1 + 9e-7, 0.0]))
    assert env.largest_violation == pytest.approx(9e-7, rel=1e-6)
    with pytest.raises(envs.InfeasibleActionError):
        env.step(np.array([1 + 1.1e-6, 0.0]))
    env.reset()
    assert (env.executed_actions, env.elapsed_steps) == (2, 0)  # the count continues over episodes
    env.close()


def test_feasible_action_is_executed_as_it_is_when_projecting():
    env = envs.make("R+L2", project=True)
    env.reset(seed=0)
    action = np.array([0.1, -0.1], np.float32)
    executed = env.step(action)[4]["executed_action"]
    np.testing.assert_array_equal(executed, action)
    assert not np.shares_memory(executed, action)
    env.close()


def test_check_uses_its_own_copy_of_the_observation():
    env = envs.make("R+O03")
    obs, _ = env.reset(seed=0)
    obs[:] = 1e6  # the velocities would make the action infeasible
    obs, *_ = env.step(np.array([0.5, 0.5]))
    obs[:] = 1e6
    env.step(np.array([0.01, 0.01]))
    env.close()


@pytest.mark.parametrize("project", [False, True])
def test_what_is_no_action_is_refused(project):
    env = envs.make("H+M", project=project)
    env.reset(seed=0)
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(envs.InfeasibleActionError, match="H.M, step 1 .* not finite"):
            env.step(np.array([0.0, bad, 0.0]))
    for bad in (np.zeros(2), np.zeros((1, 3)), 0.0):
        with pytest.raises(envs.InfeasibleActionError, match=r"H.M, step 1 .* expected \(3,\)"):
            env.step(bad)
    assert env.executed_actions == 0


# ---------------------------------------------------------------- several environments at once


@pytest.mark.parametrize("task", NAMES)
def test_stepped_together_each_does_what_it_does_alone(task):
    """Three environments, the last one projecting, with feasible, infeasible and invalid actions in two precisions."""
    together, alone = ([envs.make(task, project=i == 2) for i in range(3)] for _ in range(2))
    for group in (together, alone):
        for seed, env in enumerate(group):
            env.reset(seed=seed)
    rng, refused = np.random.default_rng(0), 0
    for t in range(200):
        actions = [draw(rng, env) * rng.choice([SMALL, 1.0, 1.2]) for env in together]
        actions = [action.astype(np.float32 if t % 2 else np.float64) for action in actions]
        if t % 10 == 0:
            actions[t // 10 % 3] = [np.full(len(actions[0]), np.nan), np.zeros(7)][t // 10 % 2]
        for env, reference, action, outcome in zip(
            together, alone, actions, envs.step_together(together, actions), strict=True
        ):
            try:
                wanted = reference.step(action)
            except envs.InfeasibleActionError as error:
                refused += 1
                assert type(outcome) is envs.InfeasibleActionError and str(outcome) == str(error)
            else:
                np.testing.assert_array_equal(outcome[0], wanted[0])
                assert outcome[1:4] == wanted[1:4]
                assert repr(outcome[4]) == repr(wanted[4])
                if any(wanted[2:4]):
                    np.testing.assert_array_equal(env.reset()[0], reference.reset()[0])
            for name in ("executed_actions", "elapsed_steps", "largest_violation"):
                assert getattr(env, name) == getattr(reference, name)
    assert 20 < refused < 500
    assert all(env.executed_actions > 50 and env.largest_violation <= envs.TOLERANCE for env in together)
    for env in together + alone:
        env.close()


@pytest.mark.parametrize("task", NAMES)
def test_a_violation_does_not_depend_on_which_others_are_computed_with_it(task):
    env, generator = envs.make(task), torch.Generator().manual_seed(0)
    obs = 4 * torch.randn(100, env.robot.obs_dim, dtype=torch.float64, generator=generator)
    action = 2 * torch.rand(100, env.robot.action_dim, dtype=torch.float64, generator=generator) - 1
    together = env.constraint.violation(obs, action)
    for size in (1, 2, 7, 50):
        parts = zip(obs.split(size), action.split(size), strict=True)
        assert torch.equal(torch.cat([env.constraint.violation(*part) for part in parts]), together)
    env.close()


def test_what_cannot_be_stepped_together():
    first, second, other = envs.make("R+N"), envs.make("R+N"), envs.make("R+L2")
    first.reset(seed=0), other.reset(seed=0)
    for group in ([first, other], [first, first]):  # two constraints; one environment twice
        with pytest.raises(ValueError, match="different environments with the same constraint"):
            envs.step_together(group, np.zeros((2, 2)))
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step_together([first, second], np.zeros((2, 2)))
    with pytest.raises(ValueError, match="shorter"):
        envs.step_together([first], np.zeros((0, 2)))
    assert first.executed_actions == other.executed_actions == 0
    assert envs.step_together([], np.zeros((0, 2))) == []


# ---------------------------------------------------------------- Gymnasium's interface


@pytest.mark.filterwarnings("ignore:.*observation space m(in|ax)imum value is -?infinity")
@pytest.mark.parametrize("project", [False, True])
@pytest.mark.parametrize("task", NAMES)
def test_gymnasium_checker(task, project):
    env = gymnasium.make(f"acrl/{task.replace('+', '-')}-v0", project=project).unwrapped
    assert type(env) is type(envs.make(task))
    assert env.observation_space.dtype == np.float64
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (env.constraint.dim,), np.float32)
    if not project:  # the checker executes its samples, so all must be feasible
        env.action_space = gymnasium.spaces.Box(-SMALL, SMALL, env.action_space.shape, np.float32)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="(?!.*(infinity|recommend|render))")
        check_env(env, skip_render_check=True)
    assert env.executed_actions > 0
    env.close()


@pytest.mark.filterwarnings("ignore:.*observation space m(in|ax)imum value is -?infinity")
def test_gymnasium_checker_with_pictures():
    env = gymnasium.make("acrl/R-N-v0", project=True, render_mode="rgb_array")
    assert env.render_mode == "rgb_array"
    check_env(env.unwrapped)
    env.close()


def test_same_seed_same_rollout():
    rollouts = []
    for _ in range(2):
        env, rng = envs.make("W+O+S", project=True), np.random.default_rng(0)
        rollouts.append([env.reset(seed=3)[0]] + [env.step(SMALL * draw(rng, env))[0] for _ in range(50)])
        env.close()
    np.testing.assert_array_equal(*rollouts)


@pytest.mark.parametrize("task", NAMES)
def test_gymnasium_make_wrappers_keep_the_environment(task):
    env = gymnasium.make(f"acrl/{task.replace('+', '-')}-v0", project=True)
    assert env.unwrapped.task == task
    env.action_space.seed(0)
    env.reset(seed=0)
    rewards, done = 0.0, False
    while not done:
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert "executed_action" in info
        rewards, done = rewards + reward, terminated or truncated
    assert np.isfinite(rewards)
    assert env.unwrapped.largest_violation <= envs.TOLERANCE
    env.close()


def test_unknown_task():
    for call in (envs.make, envs.constraint):
        with pytest.raises(ValueError, match="unknown task 'w.m'; did you mean W.M") as error:
            call("w+m")
        assert ", ".join(NAMES) in str(error.value)
        with pytest.raises(ValueError, match=r"unknown task 'Ant' \(choices"):
            call("Ant")
    with pytest.raises(ValueError, match="render_mode 'human'"):
        envs.make("R+N", render_mode="human")


@pytest.mark.parametrize("absent, task", [(["pybullet"], "HC+O"), (["pybullet", "mujoco"], "R+T")])
def test_needs_only_its_own_simulator_and_is_silent(absent, task, tmp_path):
    code = f"""
import sys
for name in {absent!r}:
    sys.modules[name] = None  # importing it fails
import envs
env = envs.make({task!r})
env.reset(seed=0)
env.step([0.0] * env.action_space.shape[0])
env.close()
"""
    run = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


# ---------------------------------------------------------------- pictures


def picture(env):
    """A picture, or None if this machine has no OpenGL backend and the error says so."""
    try:
        frame = env.render()
    except RuntimeError as error:
        assert "libegl1 or libosmesa6" in str(error)
        return None
    assert (frame.shape, frame.dtype) == ((480, 480, 3), np.uint8)
    return frame.astype(int)


def test_no_picture_without_render_mode():
    env = envs.make("R+N")
    env.reset(seed=0)
    assert env.render() is None
    env.close()


@pytest.mark.parametrize("name, robot_class, task", LOCOMOTION)
def test_camera_follows_the_robot(name, robot_class, task):
    env = envs.make(task, render_mode="rgb_array")
    env.reset(seed=0)
    for x in (0.0, 30.3):
        env.robot.data.qpos[0] = x
        env.step(np.zeros(env.action_space.shape))
        frame = picture(env)
        if frame is None:
            break
        skin = frame[..., 0] > frame[..., 2] + 30  # the floor and the sky are grey, green or blue
        rows, columns = np.nonzero(skin)
        assert skin.sum() > 1000
        assert abs(columns.mean() - 240) < 60
        assert np.percentile(rows, 1) > 0 and np.percentile(rows, 99) < 479
    env.close()


def test_no_opengl_backend_is_a_clear_error(monkeypatch):
    env = envs.make("H+M", render_mode="rgb_array")
    env.reset(seed=0)
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with pytest.raises(RuntimeError, match="backend 'nonsense' does not work on this machine"):
        env.render()
    for variable in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("ctypes.util.find_library", lambda library: None)
    with pytest.raises(RuntimeError, match="libegl1 or libosmesa6"):
        env.render()
    env.step(np.zeros(3))  # training continues
    env.close()


# ---------------------------------------------------------------- state


def rollout(env, rng, steps):
    """Step with random actions and reset at the ends of episodes. Returns all answers of the environment."""
    answers = []
    for _ in range(steps):
        obs, reward, terminated, truncated, _ = env.step(SMALL * draw(rng, env).astype(np.float32))
        if terminated or truncated:
            obs, _ = env.reset()
        answers.append([*obs, reward, terminated, truncated])
    return np.array(answers)


@pytest.mark.parametrize("task", ["R+L2", "HC+O", "H+O+S", "W+M"])
@pytest.mark.parametrize("steps", [0, 1, 140])
def test_an_environment_goes_on_bit_for_bit_from_a_saved_state(task, steps, tmp_path):
    rng = np.random.default_rng(steps)
    env, other = envs.make(task), envs.make(task)
    env.reset(seed=1)
    rollout(env, rng, steps)
    torch.save(env.get_state(), tmp_path / "state.pt")
    actions = rng.bit_generator.state
    wanted = rollout(env, rng, 200)
    other.reset(seed=2)  # another past must have no effect
    rollout(other, np.random.default_rng(9), 77)
    other.set_state(torch.load(tmp_path / "state.pt", weights_only=True))
    rng.bit_generator.state = actions
    np.testing.assert_array_equal(rollout(other, rng, 200), wanted)
    assert (other.executed_actions, other.largest_violation) == (env.executed_actions, env.largest_violation)
    assert other.elapsed_steps == env.elapsed_steps
    env.close(), other.close()


@pytest.mark.parametrize("task", ["R+N", "HC+MA"])
def test_an_episode_does_not_depend_on_those_before_it(task):
    """Saved states rely on this. The actions drive the arm against its limits and the robot onto its back."""
    rng = np.random.default_rng(0)
    env, fresh = envs.make(task, project=True), envs.make(task, project=True)
    env.reset(seed=1)
    for _ in range(3):
        for _ in range(120):
            if any(env.step(np.sign(rng.standard_normal(env.action_space.shape)))[2:4]):
                env.reset()
        start = env.np_random.bit_generator.state
        actions = np.sign(rng.standard_normal((100, *env.action_space.shape)))
        answers = []
        for each in (env, fresh):
            each.np_random.bit_generator.state = start
            each.reset()
            answers.append([np.append(*each.step(action)[:2]) for action in actions])
        np.testing.assert_array_equal(*answers)


def test_a_saved_end_of_an_episode_needs_a_reset():
    env, other = envs.make("R+N"), envs.make("R+N")
    env.reset(seed=1)
    for _ in range(150):
        env.step(np.zeros(2))
    state = env.get_state()
    assert state["actions"] is None and not state["in_episode"]
    other.reset(seed=3)
    other.set_state(state)
    with pytest.raises(gymnasium.error.ResetNeeded):
        other.step(np.zeros(2))
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])
    assert other.executed_actions == 150
