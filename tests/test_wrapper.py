"""`envs.Constrained`: any Gymnasium environment and agent under any constraint. `constraints.InUnits`: its units."""

import copy
import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

import envs
from constraints import (
    Ball,
    Box,
    ConstraintError,
    Intersection,
    InUnits,
    LinearConstraint,
    QuadraticConstraint,
    WeightedL1,
)
from envs import TOLERANCE, Constrained, InfeasibleActionError
from envs.wrapper import MAPPINGS

LOW, HIGH = np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32)


def first_two(obs):
    return obs[..., :2]


WEIGHTED = WeightedL1(first_two, 1.0, 2)


class Robot(gymnasium.Env):
    """Writes each observation into the same array, and keeps the actions that it gets."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None, observation_space=None, action_space=None):
        self.observation_space = observation_space or gymnasium.spaces.Box(-10.0, 10.0, (3,), np.float32)
        self.action_space = action_space or gymnasium.spaces.Box(LOW, HIGH)
        self.render_mode, self.actions = render_mode, []
        self.obs = np.zeros(3, np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.obs[:] = self.np_random.uniform(1.0, 10.0, 3)
        return self.observed(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.actions.append(action)
        self.obs[:] = self.np_random.uniform(1.0, 10.0, 3)
        return self.observed(), float(action.sum()), False, False, {"own": 1}

    def observed(self):
        if isinstance(self.observation_space, gymnasium.spaces.Dict):
            return {"velocity": self.obs, "camera": np.zeros((8, 8, 3), np.uint8)}
        return self.obs if self.observation_space.shape == (3,) else np.full((8, 8, 3), 7, np.uint8)

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)


class SpeedLimit(LinearConstraint):
    """A picklable constraint of Pendulum-v1: the speed stays below 4 rad/s. Torques in newton metres."""

    def A(self, obs):
        return torch.stack((torch.ones_like(obs[..., 2:]), -torch.ones_like(obs[..., 2:])), -2)

    def b(self, obs):
        return 2.0 + torch.stack((4.0 - obs[..., 2], 4.0 + obs[..., 2]), -1)


PENDULUM = InUnits(SpeedLimit(dim=1), low=-2.0, high=2.0)


# ---------------------------------------------------------------- what is executed


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_the_environment_gets_the_mapped_action_in_its_own_units(mapping):
    env = Constrained(Robot(), WEIGHTED, mapping)
    seen = torch.from_numpy(env.reset(seed=1)[0].copy()).double()
    env.action_space.seed(2)
    for step in range(200):
        action = env.action_space.sample() * (0.05 if step % 3 == 0 else 1.0)
        exact = torch.from_numpy(action).double()
        expected = {
            "project": WEIGHTED.project,
            "alpha": WEIGHTED.alpha_map,
            "radial": WEIGHTED.radial_map,
            "gauge": WEIGHTED.gauge_map,
        }[mapping](seen, exact)
        obs, reward, terminated, truncated, info = env.step(action)
        assert np.array_equal(info["suggested_action"], action)
        assert np.allclose(info["executed_action"], expected, atol=1e-12)
        assert info["executed_action"].dtype == np.float64
        assert info["violation"] == WEIGHTED.violation(seen, exact).item()
        assert WEIGHTED.violation(seen, torch.from_numpy(info["executed_action"])).item() <= TOLERANCE
        physical = LOW + (info["executed_action"] + 1.0) / 2.0 * (HIGH - LOW)
        assert np.allclose(env.unwrapped.actions[-1], physical, rtol=1e-6, atol=1e-6)
        assert env.unwrapped.actions[-1].dtype == np.float32
        assert (reward, terminated, truncated, info["own"]) == (env.unwrapped.actions[-1].sum(), False, False, 1)
        seen = torch.from_numpy(obs.copy()).double()


@pytest.mark.parametrize("mapping", ["project", "alpha", None])
def test_a_feasible_action_passes_unchanged(mapping):
    env = Constrained(Robot(), Ball(0.5, 2), mapping)
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.array([0.3, -0.6], np.float32))
    assert np.array_equal(info["executed_action"], np.array([0.3, -0.6], np.float32))
    assert info["violation"] <= 0.0


def test_without_a_mapping_an_infeasible_action_is_refused_and_nothing_is_executed():
    env = Constrained(Robot(), Ball(0.5, 2), None)
    env.reset(seed=0)
    with pytest.raises(InfeasibleActionError, match=r"violates the constraint by 0.424 \(at most 1e-06"):
        env.step(np.array([0.8, -0.8]))
    assert env.unwrapped.actions == []
    env.step(np.array([0.5, -0.5]))
    assert len(env.unwrapped.actions) == 1


def test_each_mapping_takes_suggestions_outside_the_box():
    for mapping in MAPPINGS:
        env = Constrained(Robot(), Ball(0.5, 2), mapping)
        env.reset(seed=0)
        _, _, _, _, info = env.step(np.array([30.0, -40.0]))
        assert info["violation"] > 40.0
        assert np.linalg.norm(info["executed_action"]) == pytest.approx(0.5**0.5, abs=1e-6), mapping


def test_the_whole_box_reaches_both_ends_of_the_robots():
    env = Constrained(Robot(), Box(2))
    env.reset(seed=0)
    for action, end in ((np.ones(2), HIGH), (-np.ones(2), LOW)):
        env.step(action)
        assert np.array_equal(env.unwrapped.actions[-1], end)


# ---------------------------------------------------------------- observations


def test_features_make_of_any_observation_what_the_constraint_sees():
    space = gymnasium.spaces.Dict(
        velocity=gymnasium.spaces.Box(-10.0, 10.0, (3,), np.float32),
        camera=gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
    )
    plain = Constrained(Robot(), WEIGHTED)
    dictionary = Constrained(Robot(observation_space=space), WEIGHTED, features=lambda obs: obs["velocity"])
    plain.reset(seed=4)
    dictionary.reset(seed=4)
    for _ in range(5):
        executed = [env.step(np.array([0.9, -0.8]))[4]["executed_action"] for env in (plain, dictionary)]
        assert np.array_equal(*executed)
    image = Robot(observation_space=gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8))
    env = Constrained(image, WeightedL1(first_two, 1.0, 2), features=lambda obs: obs.mean((0, 1)))
    env.reset(seed=0)
    executed = env.step(np.array([1.0, 1.0]))[4]["executed_action"]
    assert np.abs(executed).sum() == pytest.approx(1.0 / 7.0)
    env.features = lambda obs: obs
    with pytest.raises(ValueError, match=r"array \(n,\), got shape \(8, 8, 3\)"):
        env.reset()


# ---------------------------------------------------------------- composition


def both_sides(mapping="project"):
    """`Constrained` with wrappers inside and outside; the constraint sees a stack of three observations."""
    inside = wrappers.RescaleAction(wrappers.TimeLimit(Robot("rgb_array"), 20), -3.0, 3.0)
    inside = wrappers.FlattenObservation(wrappers.FrameStackObservation(inside, 3))
    newest = InUnits(LinearConstraint(2, A=partial(newest_row, 6), b=bound_of_one), -3.0, 3.0)
    env = Constrained(inside, newest, mapping)
    env = wrappers.NormalizeObservation(wrappers.RescaleAction(env, -5.0, 5.0))
    env = wrappers.FlattenObservation(wrappers.FrameStackObservation(env, 2))
    return wrappers.RecordEpisodeStatistics(wrappers.RenderCollection(wrappers.TimeLimit(env, 15)))


def newest_row(start, obs):
    return obs[..., None, start : start + 2]


def bound_of_one(obs):
    return torch.ones_like(obs[..., :1])


def test_gymnasiums_wrappers_fit_on_both_sides():
    env = both_sides()
    obs, _ = env.reset(seed=3)
    robot, limit = env.unwrapped, 0
    assert obs.shape == (18,)
    for step in range(15):
        velocity = robot.obs[:2].astype(float)
        _, _, terminated, truncated, info = env.step(np.full(2, 5.0, np.float32))
        assert np.allclose(info["suggested_action"], 1.0)
        executed = 3.0 * info["executed_action"]
        assert velocity @ executed <= 1.0 + 1e-5
        limit += abs(velocity @ executed - 1.0) < 1e-5
        assert (terminated, truncated) == (False, step == 14)
    assert limit == 15, "every suggestion was infeasible, so that every action is on the boundary"
    assert "episode" in info and len(env.render()) == 16


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments(mode):
    gymnasium.register("acrl-test/Robot-v0", entry_point="test_wrapper:Robot", max_episode_steps=4)
    try:
        wrapper = partial(Constrained, constraint=WEIGHTED, mapping="alpha")
        vector = gymnasium.make_vec("acrl-test/Robot-v0", 3, mode, wrappers=[wrapper])
    finally:
        del gymnasium.registry["acrl-test/Robot-v0"]
    try:
        assert vector.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        obs, _ = vector.reset(seed=5)
        on_the_boundary = 0
        for _ in range(10):
            seen = torch.from_numpy(obs.copy()).double()
            obs, _, _, _, info = vector.step(np.ones((3, 2), np.float32))
            if "executed_action" in info:  # the step after the end of an episode resets
                violation = WEIGHTED.violation(seen, torch.from_numpy(info["executed_action"]))
                assert violation.abs().max() < 1e-9
                on_the_boundary += 3
        assert on_the_boundary == 24
    finally:
        vector.close()


def test_copies_and_pickles_go_on_with_the_same_bits():
    env = Constrained(gymnasium.make("Pendulum-v1"), PENDULUM)
    env.reset(seed=6)
    env.step(np.ones(1))
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        mine = copy.deepcopy(env)
        for _ in range(5):
            one, two = (each.step(np.ones(1)) for each in (mine, other))
            assert np.array_equal(one[0], two[0]) and one[1] == two[1]
            assert np.array_equal(one[4]["executed_action"], two[4]["executed_action"])


def test_gymnasium_makes_it_again_from_its_spec():
    env = Constrained(gymnasium.make("Pendulum-v1"), PENDULUM, "gauge")
    again = gymnasium.make(env.spec)
    assert isinstance(again, Constrained) and again.constraint is not None and again.mapping == "gauge"
    again.reset(seed=0)
    assert again.step(np.ones(1))[4]["executed_action"].shape == (1,)


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*", "ignore:.*spec of this.*")
@pytest.mark.parametrize("mapping", MAPPINGS)
def test_the_checks_of_gymnasium_and_of_stable_baselines3_pass(mapping):
    env = Constrained(gymnasium.make("Pendulum-v1", disable_env_checker=True), PENDULUM, mapping)
    check_env(env, skip_render_check=True)
    check_env_of_sb3(env, warn=True, skip_render_check=True)
    env = Constrained(envs.make("R+M").unwrapped, envs.constraint("R+M"), mapping)
    check_env(env, skip_render_check=True)


# ---------------------------------------------------------------- wrong input


@pytest.mark.parametrize(
    "robot, arguments, said",
    [
        ({}, dict(mapping="radail"), "unknown mapping 'radail'; did you mean radial.*project, alpha, radial, gauge"),
        (
            {},
            dict(constraint=Box(3)),
            r"the constraint has 3 action coordinates, but the action space has shape \(2,\)",
        ),
        (dict(action_space=gymnasium.spaces.Box(-np.inf, 1.0, (2,))), {}, "must be bounded"),
        (dict(action_space=gymnasium.spaces.Box(-1.0, 1.0, (2, 1))), {}, r"shape \(2, 1\)"),
        (dict(action_space=gymnasium.spaces.Discrete(3)), {}, r"floating-point numbers, got Discrete\(3\)"),
        (dict(action_space=gymnasium.spaces.Box(0, 3, (2,), np.int64)), {}, "floating-point numbers, got Box"),
        (dict(observation_space=gymnasium.spaces.Discrete(3)), {}, r"flat arrays, got Discrete\(3\); pass features="),
        (dict(observation_space=gymnasium.spaces.Box(0, 1, (2, 2))), {}, "flat arrays, got Box.*pass features="),
    ],
)
def test_what_does_not_fit_is_refused_at_once(robot, arguments, said):
    with pytest.raises(ValueError, match=said) as error:
        Constrained(Robot(**robot), **{"constraint": Box(2), **arguments})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("mapping", [*MAPPINGS, None])
@pytest.mark.parametrize(
    "action, said",
    [
        ([0.0], r"shape \(1,\), expected \(2,\)"),
        ([0.0, np.nan], "not finite"),
        ([np.inf, 0.0], "not finite"),
    ],
)
def test_what_is_no_action_is_refused(mapping, action, said):
    env = Constrained(Robot(), Box(2), mapping)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    env.reset()
    with pytest.raises(InfeasibleActionError, match=said):
        env.step(np.array(action))
    assert env.unwrapped.actions == []


def test_a_constraint_that_breaks_down_is_noticed():
    class Wrong(Ball):
        def _project(self, obs, action):
            return action, lambda vector: vector

    env = Constrained(Robot(), Wrong(0.5, 2))
    env.reset()
    with pytest.raises(InfeasibleActionError, match="the constraint does not work at the observation"):
        env.step(np.ones(2))
    env = Constrained(Robot(), WEIGHTED, features=lambda obs: np.full(3, np.nan))
    env.reset()
    with pytest.raises(InfeasibleActionError, match="does not work at the observation"):
        env.step(np.ones(2))
    assert env.unwrapped.actions == []


# ---------------------------------------------------------------- units


def test_a_constraint_in_units_is_the_same_set():
    """In every method: an action in [low, high] is in the inner set exactly if its rescaled action is in the outer."""
    generator = torch.Generator().manual_seed(0)
    low, high = np.array([-2.0, 0.0, 5.0]), np.array([2.0, 10.0, 6.0], np.float64)
    A = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    b = A @ torch.tensor([0.5, 6.0, 5.4], dtype=torch.float64) + 0.3
    Q = torch.diag(torch.tensor([0.3, 0.02, 4.0], dtype=torch.float64))
    c = torch.tensor([0.5, 6.0, 5.5], dtype=torch.float64)
    inner = Intersection(
        LinearConstraint(3, lambda obs: A, lambda obs: b), QuadraticConstraint(3, lambda obs: Q, 1.0, lambda obs: c)
    )
    constraint = InUnits(inner, low, high)
    obs = torch.zeros(1, dtype=torch.float64)
    action = 2.0 * torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 1.0
    physical = torch.from_numpy(low) + (action + 1.0) / 2.0 * torch.from_numpy(high - low)
    offset = physical - c
    allowed = ((physical @ A.T <= b).all(-1)) & ((offset @ Q * offset).sum(-1) <= 1.0)
    assert 50 < allowed.sum() < 1950
    assert torch.equal(constraint.violation(obs, action) <= 0.0, allowed)
    center = constraint.center(obs)
    for mapped in (
        constraint.project(obs, action),
        constraint.alpha_map(obs, action),
        constraint.radial_map(obs, action),
        constraint.gauge_map(obs, action),
        constraint.linear_oracle(obs, action),
        constraint.sample(obs, 50, generator),
    ):
        assert constraint.violation(obs, mapped).max() <= 1e-9
    assert constraint.violation(obs, center) < -1e-3
    moved = constraint.project(obs, action)
    assert torch.equal((moved - action).norm(dim=-1) < 1e-12, allowed)
    assert (constraint.penalty(obs, action) >= 0.0).all()
    assert torch.equal(constraint.penalty(obs, action) == 0.0, allowed)


@pytest.mark.parametrize(
    "low, high, said",
    [
        (1.0, 1.0, "low must be below high"),
        (-np.inf, 1.0, "both finite"),
        (-np.ones(2), np.ones(2), "numbers or have 1 values, got 2 and 2"),
    ],
)
def test_units_that_are_none_are_refused(low, high, said):
    with pytest.raises(ValueError, match=said):
        InUnits(SpeedLimit(dim=1), low, high)


def test_the_least_violating_action_of_an_empty_set_is_executed():
    gap = LinearConstraint(
        2, lambda obs: torch.tensor([[1.0, 0.0], [-1.0, 0.0]]), lambda obs: torch.full((2,), -0.3), on_empty="least"
    )
    for constraint in (gap, InUnits(gap, -1.0, 1.0)):
        for mapping in (*MAPPINGS, None):
            env = Constrained(Robot(), constraint, mapping)
            env.reset()
            if mapping is None:
                with pytest.raises(InfeasibleActionError, match="by 0.8 .at most 0.300001 is allowed"):
                    env.step(np.array([0.5, 0.5]))
            suggested = np.array([0.0, 0.5]) if mapping is None else np.array([0.5, 0.5])
            info = env.step(suggested)[4]
            assert abs(info["executed_action"][0]) <= 1e-6
            assert info["violation"] == pytest.approx(0.3 if mapping is None else 0.8)


def test_what_is_no_constraint_is_refused():
    for wrong in (Ball, None):
        with pytest.raises(TypeError, match="constraint must be an instance of constraints.Constraint, got"):
            Constrained(Robot(), wrong)


def test_an_empty_set_is_reported_by_the_step():
    impossible = LinearConstraint(2, lambda obs: torch.ones(1, 2), lambda obs: torch.tensor([-3.0]))
    env = Constrained(Robot(), impossible)
    env.reset()
    with pytest.raises(ConstraintError, match="the only sample"):
        env.step(np.zeros(2))


def test_a_number_in_units_keeps_its_double_precision():
    bound = 0.05  # in single precision it is 0.0500000007
    constraint = InUnits(Ball(bound, 2), -1.0, 1.0)
    projected = constraint.project(torch.zeros(1), torch.tensor([1.0, 0.0], dtype=torch.float64))
    assert projected[0].item() == pytest.approx(bound**0.5, rel=1e-14)
