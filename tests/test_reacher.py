"""The arm in closed form: equality with recorded steps and with PyBullet, its states, its pictures."""

import platform
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import envs
from envs.pybullet_reacher import PyBulletReacher
from envs.reacher import ARRAYS, FLOATS, MANY, Reacher, State, advance

DATA = Path(__file__).parent / "data"
SAME_BITS = platform.machine() == "x86_64" and platform.libc_ver()[0] == "glibc"
"""Whether sine, cosine and sums round on this machine as on the machine that made the recordings."""


@pytest.fixture(params=["closed-form", "pybullet"])
def robot(request):
    if request.param == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
    robot = envs.make("R+N", simulator=request.param).robot
    yield robot
    robot.close()


@pytest.fixture
def bullet():
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    robot = PyBulletReacher()
    yield robot
    robot.close()


def states(rng, count):
    """States (4, count) of all regimes: joint 1 inside its limits, at them, a little past and far past; speeds up to
    the largest. Torques (2, count) up to 20 times the task's."""
    sides = rng.choice([-1.0, 1.0], count)
    past = sides * (3.0 + rng.choice([0.0, 0.04, 1.5], count) * rng.uniform(0, 1, count))
    q = np.stack((rng.uniform(-9, 9, count), np.where(rng.random(count) < 0.5, rng.uniform(-3.1, 3.1, count), past)))
    w = rng.uniform(-1, 1, (2, count)) * rng.choice([0.0, 1.0, 30.0, 100.0], (2, count))
    torques = 0.05 * rng.uniform(-1, 1, (2, count)) * rng.choice([0.0, 1.0, 20.0], (2, count))
    return np.concatenate((q, w)), torques


# ---------------------------------------------------------------- the originals


@pytest.mark.parametrize("seed", [0, 1])
def test_episodes_equal_those_of_the_original(robot, seed):
    golden = np.load(DATA / f"golden_seed{seed}.npz")
    rng, noise = np.random.default_rng(seed), np.random.default_rng(5)
    other = type(robot)()
    for obs, actions, rewards in zip(golden["obs"], golden["actions"], golden["rewards"], strict=True):
        other.reset(noise)  # a neighbour in the same process must not disturb it
        np.testing.assert_allclose(robot.reset(rng), obs[0], rtol=0, atol=1e-9)
        for action, expected_obs, expected_reward in zip(actions, obs[1:], rewards, strict=True):
            other.step(noise.uniform(-1, 1, 2))
            got_obs, reward, terminated, info = robot.step(action)
            np.testing.assert_allclose(got_obs, expected_obs, rtol=0, atol=1e-9)
            assert abs(reward - expected_reward) < 1e-9
            assert (terminated, info) == (False, {})
    other.close()


def test_single_steps_equal_recorded_ones_of_pybullet():
    recorded = np.load(DATA / "transitions.npz")
    state = np.concatenate((recorded["q"].T, recorded["qd"].T))
    wanted = np.concatenate((recorded["next_q"].T, recorded["next_qd"].T))
    assert (np.abs(state[1]) >= 3).mean() > 0.2 and np.abs(state[2:]).max() > 50  # the limit and spinning arms
    np.testing.assert_allclose(np.stack(advance(*state, *recorded["torque"].T, ARRAYS)), wanted, rtol=1e-12, atol=1e-12)


def test_episodes_that_spin_and_hit_the_limit_equal_recorded_ones_of_pybullet():
    recorded = np.load(DATA / "transitions.npz")
    steps = 150 if SAME_BITS else 20  # elsewhere the last bit differs, and the difference grows
    limited = 0
    for actions, q, w in zip(*(recorded[f"episode_{name}"] for name in ("actions", "q", "qd")), strict=True):
        state = (*q[0].tolist(), *w[0].tolist())
        for action, before, *after in zip(actions[:steps], q, q[1:], w[1:], strict=False):
            limited += abs(before[1]) >= 3
            state = advance(*state, *(0.05 * np.clip(action, -1, 1)).tolist(), FLOATS)
            if SAME_BITS:
                np.testing.assert_array_equal(state, np.concatenate(after))
            else:
                np.testing.assert_allclose(state, np.concatenate(after), rtol=1e-9, atol=1e-9)
    assert limited > 10


def test_single_steps_equal_pybullets_in_every_bit(bullet):
    state, torques = states(np.random.default_rng(1), 3000)
    got = np.stack(advance(*state, *torques, ARRAYS))
    for k in range(state.shape[1]):
        bullet.place(*state[:, k])
        np.testing.assert_array_equal(got[:, k], bullet.advance(*torques[:, k]))


@pytest.mark.parametrize("kind", ["uniform", "constant", "bang-bang", "held", "zero", "20-fold torques"])
def test_whole_episodes_equal_pybullets_in_every_bit(bullet, kind):
    rng = np.random.default_rng(2)
    for episode in range(10):
        signs = rng.choice([-1.0, 1.0], (150, 2))
        actions = {
            "uniform": rng.uniform(-1, 1, (150, 2)),
            "constant": signs[:1].repeat(150, 0),
            "bang-bang": signs,
            "held": signs[::20].repeat(20, 0)[:150],
            "zero": np.zeros((150, 2)),
            "20-fold torques": 20 * rng.uniform(-1, 1, (150, 2)),
        }[kind]
        speed = 30.0 * (episode % 2)
        state = (rng.uniform(-3, 3), rng.uniform(-3.14, 3.14), *rng.uniform(-speed, speed, 2))
        bullet.place(*state)
        for t1, t2 in (0.05 * actions).tolist():
            state = advance(*state, t1, t2, FLOATS)
            assert state == bullet.advance(t1, t2)


def test_observations_and_rewards_are_those_of_pybullet(bullet):
    arm, actions = Reacher(), np.random.default_rng(3).choice([-1.0, 1.0], (2, 8, 2)).repeat(20, 1)[:, :150]
    rngs = np.random.default_rng(4), np.random.default_rng(4)
    for episode in actions:
        np.testing.assert_allclose(
            *(each.reset(rng) for each, rng in zip((arm, bullet), rngs, strict=True)), atol=1e-14
        )
        for action in episode:
            (obs, reward, *_), (wanted, wanted_reward, *_) = arm.step(action), bullet.step(action)
            np.testing.assert_allclose(obs, wanted, rtol=0, atol=1e-13)
            assert abs(reward - wanted_reward) < 1e-11


# ---------------------------------------------------------------- one arm and many


def test_floats_and_arrays_give_the_same_bits():
    state, torques = states(np.random.default_rng(5), 5000)
    many = np.stack(advance(*state, *torques, ARRAYS))
    for k in range(state.shape[1]):
        one = advance(*state[:, k].tolist(), *torques[:, k].tolist(), FLOATS)
        np.testing.assert_array_equal(one, many[:, k])


def test_speeds_stay_below_the_largest():
    state = np.array([[0.0], [3.5], [100.0], [-100.0]])
    for _ in range(50):
        state = np.stack(advance(*state, np.array([1.0]), np.array([-1.0]), ARRAYS))
        assert np.abs(state[2:]).max() <= 100


@pytest.mark.parametrize("count", [3, MANY, MANY + 10])
def test_many_arms_step_together_as_each_does_alone(count):
    together, alone = ([envs.make("R+L2", project=True) for _ in range(count)] for _ in range(2))
    for group in (together, alone):
        for seed, env in enumerate(group):
            env.reset(seed=seed)
    rng = np.random.default_rng(0)
    for t in range(60):
        actions = rng.uniform(-1, 1, (count, 2)).astype(np.float32 if t % 2 else np.float64)
        outcomes = envs.step_together(together, actions)
        for outcome, env, action in zip(outcomes, alone, actions, strict=True):
            wanted = env.step(action)
            np.testing.assert_array_equal(outcome[0], wanted[0])
            assert outcome[1:4] == wanted[1:4]
            np.testing.assert_array_equal(outcome[4]["executed_action"], wanted[4]["executed_action"])


def test_a_stuck_joint_is_penalised(robot):
    for gamma, penalty in ((2.985, -0.1), (-2.985, -0.1), (2.9, 0.0)):
        if isinstance(robot, Reacher):
            state = State(0.0, gamma, *[0.0] * 6)
            robot.set_state(np.array([*state[:6], *state.fingertip(FLOATS)]))
        else:
            robot.place(0.0, gamma, 0.0, 0.0)
        obs, reward, _, _ = robot.step(np.zeros(2))  # nothing moves: no progress, no cost of torques
        assert obs[7] == pytest.approx(gamma / 3)
        assert reward == pytest.approx(penalty, abs=1e-9)


def tip(q1, q2):
    arms = 0.1 * np.array([np.cos(q1), np.sin(q1)]) + 0.11 * np.array([np.cos(q1 + q2), np.sin(q1 + q2)])
    return arms.tolist()


def test_the_fingertip_is_where_the_angles_put_it_one_step_late():
    arm = Reacher()
    obs = arm.reset(np.random.default_rng(0))
    for _ in range(20):
        before = arm.state[:2]
        np.testing.assert_array_equal(obs[4:6], (np.cos(before[0]), np.sin(before[0])))
        obs = arm.step(np.array([1.0, -1.0]))[0]
        np.testing.assert_allclose(obs[:2] + obs[2:4], tip(*before), atol=1e-7)


# ---------------------------------------------------------------- the choice of a simulator


def test_a_simulator_that_is_not_there_is_one_clear_line(monkeypatch):
    for task, message in (
        ("R+N", r"unknown simulator 'mujoco' for R\+N \(choices: closed-form, pybullet\)"),
        ("W+M", r"unknown simulator 'mujoco' for W\+M \(its robot has only one simulator\)"),
    ):
        with pytest.raises(envs.UnavailableError, match=message):
            envs.make(task, simulator="mujoco")
    monkeypatch.setitem(sys.modules, "pybullet", None)  # importing it fails
    with pytest.raises(envs.UnavailableError, match=r"with Python up to 3.11 \(this is Python 3\.") as error:
        envs.make("R+N", simulator="pybullet")
    assert "\n" not in str(error.value)
    assert type(envs.make("R+N").robot) is type(envs.make("R+N", simulator="closed-form").robot) is Reacher


def test_a_state_of_another_simulator_is_refused(bullet):
    env = envs.make("R+N", simulator="pybullet")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="the state of PyBulletReacher does not fit Reacher"):
        envs.make("R+N").set_state(env.get_state())


@pytest.mark.parametrize("stateless", [False, True])
def test_pybullet_goes_on_from_its_state_and_by_repeating_actions(bullet, stateless, monkeypatch):
    """A robot that returns no state is restored by repeating its actions, as PyBullet was in earlier checkpoints."""
    if stateless:
        monkeypatch.setattr(PyBulletReacher, "get_state", lambda self: None)
    env, other = (envs.make("R+N", simulator="pybullet") for _ in range(2))
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    for action in actions[:20]:
        env.step(action)
    state = env.get_state()
    if stateless:
        assert state["robot"] is None and state["actions"].shape == (20, 2)
    else:
        assert state["robot"].shape == (9,) and state["actions"] is None
    other.set_state(state)
    for action in actions[20:]:
        np.testing.assert_array_equal(other.step(action)[0], env.step(action)[0])
    assert other.elapsed_steps == env.elapsed_steps == 40


def test_close_frees_the_physics_client(bullet):
    env, neighbour = (envs.make("R+N", simulator="pybullet") for _ in range(2))
    module, client = env.robot._bullet, env.robot._client
    assert module.getConnectionInfo(client)["isConnected"]
    env.close()
    assert not module.getConnectionInfo(client)["isConnected"]
    env.close()
    neighbour.reset(seed=0)  # has a client of its own
    neighbour.step(np.zeros(2))
    neighbour.close()


# ---------------------------------------------------------------- pictures


def pixel(x, y):
    """Row and column of a point in the arena."""
    return round(240 - y / 0.33 * 240), round(240 + x / 0.33 * 240)


@pytest.mark.parametrize("simulator", ["closed-form", "pybullet"])
def test_a_picture_shows_arm_limit_and_target(simulator):
    if simulator == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
    env = envs.make("R+N", render_mode="rgb_array", simulator=simulator)
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 61}
    obs, _ = env.reset(seed=0)
    first = env.render()
    assert (first.shape, first.dtype) == ((480, 480, 3), np.uint8)
    q1 = np.arctan2(obs[5], obs[4])
    elbow = 0.1 * np.cos(q1), 0.1 * np.sin(q1)
    middle = np.mean([elbow, obs[:2] + obs[2:4]], axis=0)  # of the forearm
    assert first[pixel(*obs[:2])].tolist() == [230, 51, 51]
    assert first[pixel(*middle)].tolist() == [0, 102, 153]
    orange = np.argwhere((first == (255, 165, 60)).all(-1))
    assert len(orange) > 50 and np.linalg.norm(orange - pixel(*elbow), axis=1).max() < 0.055 / 0.33 * 240
    for _ in range(20):
        env.step(np.ones(2))
    assert (env.render() != first).any()
    env.close()


@pytest.mark.parametrize("task", ["R+L2", "R+T", "R+O03", "R+M"])
def test_a_picture_shows_the_feasible_set_and_the_action_where_asked(task):
    plain, env = (envs.make(task, render_mode="rgb_array", show_set=show) for show in (False, True))
    plain.reset(seed=1), env.reset(seed=1)
    green = [(picture == (196, 230, 200)).all(-1).sum() for picture in (plain.render(), env.render())]
    assert green[0] == 0 and green[1] > 100
    before = env.render()
    env.step(np.array([0.05, 0.05])), plain.step(np.array([0.05, 0.05]))
    dots = [(picture == (200, 60, 20)).all(-1).sum() for picture in (before, env.render())]
    assert dots[0] == 0 and dots[1] > 20
    green = (before == (196, 230, 200)).all(-1), (env.render() == (196, 230, 200)).all(-1)
    assert (green[0] >= green[1]).all()  # the set belongs to the drawn action, not to the next one
    np.testing.assert_array_equal(env.render()[:, :300], plain.render()[:, :300])


def test_the_drawn_set_has_the_area_of_the_feasible_set():
    env = envs.make("R+L2", render_mode="rgb_array", show_set=True)
    env.reset(seed=0)
    points = env._boundary(env._obs)
    area = 0.5 * abs(sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in pairwise([*points, points[0]])))
    assert area == pytest.approx(0.05 * np.pi, rel=1e-3)


def test_a_set_of_more_dimensions_is_not_drawn():
    with pytest.raises(ValueError, match=r"W\+M has 6 dimensions"):
        envs.make("W+M", render_mode="rgb_array", show_set=True)
