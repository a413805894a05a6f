"""PyBullet-Gym's Reacher: a two-joint planar arm whose fingertip has to reach a target.

The dynamics are a closed form of what Bullet computes for the model `mjcf/reacher.xml` of pybullet_data: Featherstone's
articulated-body algorithm (Bullet, zlib licence, btMultiBody.cpp), with Bullet's damping, joint limit and integrator.
The closed form keeps Bullet's order of operations, so that joint angles equal Bullet's in every bit. That matters: an
arm that spins is chaotic, and a difference in the last bit grows to a different episode.

Units: metres, kilograms, seconds, radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from envs.drawing import draw_arm
from envs.robot import Robot, Step

Value = TypeVar("Value", float, np.ndarray)


def _single(value: float) -> float:
    """The value after a pass through single precision, as Bullet's importer reads lengths."""
    return float(np.float32(value))


# ---------------------------------------------------------------- the model

TIME_STEP = 0.0165
TORQUE = 0.05
"""Torque of an action of 1, in N m."""
LIMIT = 3.0
"""Joint 1 stops at +-3 rad; joint 0 turns freely."""
LARGEST_SPEED = 100.0
"""Bullet's bound on the speed of a joint, in rad/s."""

HALF = _single(0.1) / 2  # from a joint to the centre of its arm, and from there to the next joint
_TIP = _single(0.11) - HALF  # from the centre of the forearm to the fingertip
_RADIUS = _single(0.01)  # of the capsules of both arms
_UPPER, _FORE = 2.0 * HALF, HALF + _TIP  # lengths of the upper arm and, to the fingertip, of the forearm
REACH = math.sqrt(_UPPER**2 + _FORE**2 + 2.0 * _UPPER * _FORE * math.cos(LIMIT)), _UPPER + _FORE
"""Least and largest distance of the fingertip from joint 0."""
_DENSITY = 1000.0
_MASS = _DENSITY * (4.0 / 3.0 * math.pi * _RADIUS**3 + math.pi * _RADIUS**2 * (2.0 * HALF))  # of an arm
# Bullet takes the inertia of the bounding box, and that box includes a collision margin of 0.04 m.
_BOX_LENGTH, _BOX_WIDTH = 2.0 * (HALF + _RADIUS + 0.04), 2.0 * (_RADIUS + 0.04)
_INERTIA = _MASS / 12.0 * (_BOX_LENGTH * _BOX_LENGTH + _BOX_WIDTH * _BOX_WIDTH)  # of an arm, about its centre
_TIP_MASS = _DENSITY * (4.0 / 3.0 * math.pi * 0.01 * 0.01 * 0.01)
_TIP_INERTIA = 0.4 * _TIP_MASS * 0.01**2
_DAMPING = _single(0.04)  # btMultiBody's default; the same number is its linear and its quadratic coefficient

# Forearm and fingertip are one rigid body that hinges at joint 1.
_FORE_MASS = _MASS + _TIP_MASS
_FORE_MOMENT = _TIP_MASS * _TIP + _FORE_MASS * HALF  # first moment of mass about joint 1
_FORE_INERTIA = HALF * _FORE_MOMENT + (_INERTIA + (_TIP * (_TIP_MASS * _TIP) + _TIP_INERTIA)) + _TIP_MASS * _TIP * HALF
_INVERSE_FORE_INERTIA = 1.0 / _FORE_INERTIA
_FORE_RATIO = _FORE_MOMENT * _INVERSE_FORE_INERTIA
_FREE_MASS = _FORE_MASS - _FORE_MOMENT * _FORE_RATIO  # what a push across the forearm at joint 1 has to move

_TINY = np.finfo(np.float64).eps  # Bullet takes the length of a vector as 0 if its square is below this
_CORRECTED = 0.2  # Bullet's ERP: the share of a limit's error that a step corrects
_DEEPEST_CORRECTED = -_single(0.04)  # past this, Bullet stops the joint and does not push it back


# ---------------------------------------------------------------- the dynamics


class Arithmetic(NamedTuple):
    """The functions that differ between floats and arrays. They round alike, so one arm and many have the same bits."""

    cos: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    sqrt: Callable[[Any], Any]
    root: Callable[[Any], Any]  # the square root, as Bullet applies it to squared lengths
    clip: Callable[[Any, float, float], Any]
    stop: Callable[..., Any]  # `_stop` where joint 1 is at its limit


def _accelerate(
    half_cos: Value, half_sin: Value, w1: Value, w2: Value, t1: Value, t2: Value, root: Callable[[Value], Value]
) -> tuple[Value, ...]:
    """Joint accelerations, and the values that an impulse on joint 1 needs: (a1, a2, 1 / inertia at joint 0, rx, c).

    `half_cos` and `half_sin` belong to half the angle of joint 1, `w1`, `w2` are joint speeds, `t1`, `t2` torques.
    Floats and arrays take the same operations in the same order, and so give the same bits. All vectors are in the
    frame of the forearm, x along it. The first pass gives velocities and bias forces (damping, centripetal and
    Coriolis terms), the second articulated inertias, the third accelerations.
    """
    # Bullet keeps the rotation of joint 1 as a quaternion. The vector (rx, -ry) leads from the centre of the upper
    # arm to joint 1; c and s are cosine and sine by the rotation matrix, with other roundings.
    rx = half_cos * (HALF * half_cos) - half_sin * (HALF * half_sin)
    ry = half_cos * (HALF * half_sin) + half_sin * (HALF * half_cos)
    zs = half_sin * (2.0 / (half_sin * half_sin + half_cos * half_cos))
    c, s = 1.0 - half_sin * zs, half_cos * zs

    # Velocities: of the upper arm's centre, of joint 1 (vx, vy), across the forearm at its centre and at the fingertip.
    upper_speed = HALF * w1
    w = w1 + w2
    vx, vy = ry * w1 + s * upper_speed, rx * w1 + c * upper_speed
    fore_speed = vy + HALF * w
    tip_speed = fore_speed + _TIP * w

    # Damping coefficients: linear of the upper arm, forearm and fingertip, angular of upper arm and forearm.
    upper_drag = _DAMPING + _DAMPING * root(upper_speed * upper_speed)
    fore_drag = _DAMPING + _DAMPING * root(vx * vx + fore_speed * fore_speed)
    tip_drag = _DAMPING + _DAMPING * root(vx * vx + tip_speed * tip_speed)
    upper_spin_drag = _DAMPING + _DAMPING * root(w1 * w1)
    fore_spin_drag = _DAMPING + _DAMPING * root(w * w)

    # Bias forces of fingertip and forearm, and their moment about joint 1.
    turn = vx * w
    tip_fy = _TIP_MASS * tip_speed * tip_drag + _TIP_MASS * turn
    tip_fx = _TIP_MASS * vx * tip_drag - _TIP_MASS * (w * tip_speed)
    fy = (_MASS * fore_speed * fore_drag + _MASS * turn) + tip_fy
    fx = (_MASS * vx * fore_drag - _MASS * (w * fore_speed)) + tip_fx
    moment = (_INERTIA * w * fore_spin_drag + (_TIP_INERTIA * w * fore_spin_drag + _TIP * tip_fy)) + HALF * fy

    # The rest of the forearm's load acts on the upper arm: force (px, py) and moment about its centre.
    coriolis = vx * w2
    y2 = (moment - t2) - _FORE_MOMENT * coriolis
    z = y2 * _INVERSE_FORE_INERTIA
    py = (fy - _FORE_MASS * coriolis) - _FORE_MOMENT * z
    px = fx + _FORE_MASS * (vy * w2)
    upper_moment = _INERTIA * w1 * upper_spin_drag + (
        ((moment - _FORE_MOMENT * coriolis) - _FORE_INERTIA * z) + (rx * py + ry * px)
    )
    y1 = (upper_moment + HALF * (_MASS * upper_speed * upper_drag + (s * px + c * py))) - t1

    # Articulated inertia of the whole arm about joint 0.
    b = s * (ry * _FORE_MASS) + c * (rx * _FREE_MASS)
    a = _MASS + (s * (s * _FORE_MASS) + c * (c * _FREE_MASS))
    inertia = (_INERTIA + (ry * (ry * _FORE_MASS) + rx * (rx * _FREE_MASS))) + HALF * (b + HALF * a) + HALF * b

    inverse = 1.0 / inertia
    a1 = y1 * inverse
    a2 = _INVERSE_FORE_INERTIA * (y2 - (_FORE_MOMENT * (rx * a1 + c * (HALF * a1)) + _FORE_INERTIA * a1))
    return -a1, -a2, inverse, rx, c


def _stop(q2: float, w1: float, w2: float, inverse: float, rx: float, c: float) -> tuple[float, float]:
    """The joint speeds after the impulse of the limit on joint 1, for |q2| >= 3.

    An impulse only pushes inward. It stops the joint and, up to 0.04 rad past the limit, corrects a fifth of the error
    in each step. `inverse`, `rx`, `c` come from `_accelerate`.
    """
    side, gap = math.copysign(1.0, q2), LIMIT - abs(q2)
    # Responses of the joint speeds to a unit impulse on joint 1.
    r1 = inverse * ((1.0 + rx * _FORE_RATIO) + HALF * (c * _FORE_RATIO))
    r2 = _INVERSE_FORE_INERTIA * (1.0 + (_FORE_MOMENT * (rx * r1 + c * (HALF * r1)) + _FORE_INERTIA * r1))
    r1 = -r1
    mass = 1.0 / r2
    wanted = -gap * _CORRECTED / TIME_STEP if gap > _DEEPEST_CORRECTED else 0.0
    impulse = max(wanted * mass + side * w2 * mass, 0.0)
    # The solver's second iteration corrects no more than rounding.
    rest = impulse - r2 * impulse * mass if (impulse / mass) ** 2 > 1e-7 else 0.0
    w1 = _clip(w1 - side * (r1 * impulse + r1 * rest), -LARGEST_SPEED, LARGEST_SPEED)
    w2 = _clip(w2 - side * (r2 * impulse + r2 * rest), -LARGEST_SPEED, LARGEST_SPEED)
    return w1, w2


def advance(
    q1: Value, q2: Value, w1: Value, w2: Value, t1: Value, t2: Value, arithmetic: Arithmetic
) -> tuple[Value, Value, Value, Value]:
    """Angles and speeds (q1, q2, w1, w2) a time step later, under the torques `t1`, `t2`."""
    half = 0.5 * q2
    a1, a2, *rest = _accelerate(arithmetic.cos(half), arithmetic.sin(half), w1, w2, t1, t2, arithmetic.root)
    w1 = arithmetic.clip(w1 + a1 * TIME_STEP, -LARGEST_SPEED, LARGEST_SPEED)
    w2 = arithmetic.clip(w2 + a2 * TIME_STEP, -LARGEST_SPEED, LARGEST_SPEED)
    w1, w2 = arithmetic.stop(q2, w1, w2, *rest)
    return q1 + TIME_STEP * w1, q2 + TIME_STEP * w2, w1, w2


def _root(x: float) -> float:
    return math.sqrt(x) if x > _TINY else 0.0


def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


def _stop_one(q2: float, w1: float, w2: float, *rest: float) -> tuple[float, float]:
    return _stop(q2, w1, w2, *rest) if abs(q2) >= LIMIT else (w1, w2)


def _stop_many(q2: np.ndarray, w1: np.ndarray, w2: np.ndarray, *rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    for k in np.flatnonzero(np.abs(q2) >= LIMIT).tolist():
        w1[k], w2[k] = _stop(*(float(x[k]) for x in (q2, w1, w2, *rest)))
    return w1, w2


FLOATS = Arithmetic(math.cos, math.sin, math.sqrt, _root, _clip, _stop_one)
ARRAYS = Arithmetic(
    # The C library's functions, as in Bullet: NumPy's may differ in the last bit.
    cos=lambda x: np.array([*map(math.cos, x.tolist())]),
    sin=lambda x: np.array([*map(math.sin, x.tolist())]),
    sqrt=np.sqrt,
    root=lambda x: np.where(x > _TINY, np.sqrt(x), 0.0),
    clip=np.clip,
    stop=_stop_many,
)


# ---------------------------------------------------------------- the robot

MANY = 40
"""From this number of arms on, arrays are faster than a loop over floats."""


class State(NamedTuple):
    """An arm's state: angles and speeds of the joints, target, and the fingertip that the observation reports.

    That fingertip is one step late: Bullet reports its position at the start of a step, beside the angles at the end.
    The reward uses the same late position.
    """

    q1: Any
    q2: Any
    w1: Any
    w2: Any
    target_x: Any
    target_y: Any
    seen_x: Any
    seen_y: Any

    def fingertip(self, arithmetic: Arithmetic) -> tuple[Any, Any]:
        """Position (x, y) of the fingertip, without the delay."""
        cos, sin, total = arithmetic.cos, arithmetic.sin, self.q1 + self.q2
        return _UPPER * cos(self.q1) + _FORE * cos(total), _UPPER * sin(self.q1) + _FORE * sin(total)

    def observation(self, arithmetic: Arithmetic) -> tuple[Any, ...]:
        """The nine numbers of `Reacher`'s observation."""
        to_target = self.seen_x - self.target_x, self.seen_y - self.target_y
        angle = arithmetic.cos(self.q1), arithmetic.sin(self.q1), 0.1 * self.w1
        return (self.target_x, self.target_y, *to_target, *angle, self.q2 / LIMIT, 0.1 * self.w2)

    def potential(self, arithmetic: Arithmetic) -> Any:
        """-100 times the distance of the reported fingertip from the target."""
        x, y = self.seen_x - self.target_x, self.seen_y - self.target_y
        return -100.0 * arithmetic.sqrt(x * x + y * y)

    def after(self, a1: Any, a2: Any, arithmetic: Arithmetic) -> tuple[State, Any]:
        """The state after a step under the action (a1, a2), and the reward."""
        t1, t2 = TORQUE * arithmetic.clip(a1, -1.0, 1.0), TORQUE * arithmetic.clip(a2, -1.0, 1.0)
        q1, q2, w1, w2 = advance(self.q1, self.q2, self.w1, self.w2, t1, t2, arithmetic)
        state = State(q1, q2, w1, w2, self.target_x, self.target_y, *self.fingertip(arithmetic))
        progress = state.potential(arithmetic) - self.potential(arithmetic)
        electricity = -0.10 * (abs(a1 * (0.1 * w1)) + abs(a2 * (0.1 * w2))) - 0.01 * (abs(a1) + abs(a2))
        stuck = -0.1 * (abs(abs(q2 / LIMIT) - 1.0) < 0.01)
        return state, progress + electricity + stuck


class Reacher(Robot):
    """One arm. Action (2,): torques of the two joints in units of 0.05. Observation (9,):

    0-1  target, x and y in m
    2-3  fingertip minus target, x and y in m; the fingertip is that of a step ago
    4-5  cos and sin of the angle of joint 0
    6    0.1 times the velocity of joint 0 in rad/s
    7    the angle of joint 1 in rad divided by 3, its limit
    8    0.1 times the velocity of joint 1 in rad/s
    """

    hyperparameters = "Reacher"  # its group in the paper's table
    obs_dim, action_dim = 9, 2
    max_episode_steps = 150
    fps = 61  # 1 / 0.0165 s
    simulators = {
        "closed-form": "envs.reacher:Reacher",
        "pybullet": "envs.pybullet_reacher:PyBulletReacher",
    }

    def __init__(self) -> None:
        self.state = State(*[0.0] * 8)

    def reset(self, rng: np.random.Generator) -> np.ndarray:
        """Draw target and joint positions from `rng`; return the observation (9,)."""
        target = rng.uniform(-0.27, 0.27), rng.uniform(-0.27, 0.27)
        angles = rng.uniform(-3.14, 3.14), rng.uniform(-3.14, 3.14)
        start = State(*angles, 0.0, 0.0, *target, 0.0, 0.0)
        self.state = State(*start[:6], *start.fingertip(FLOATS))
        return np.array(self.state.observation(FLOATS))

    def step(self, action: np.ndarray) -> Step:
        """Apply `action` (2,) for 0.0165 s; return obs (9,), reward, False (never ends), info."""
        a1, a2 = map(float, action)
        self.state, reward = self.state.after(a1, a2, FLOATS)
        return np.array(self.state.observation(FLOATS)), reward, False, {}

    @classmethod
    def step_together(cls, robots: Sequence[Robot], actions: Sequence[np.ndarray]) -> list[Step]:
        """`step` of many arms in one call, with the same bits."""
        if len(robots) < MANY:
            return super().step_together(robots, actions)
        arms = cast("Sequence[Reacher]", robots)
        state = State(*np.array([arm.state for arm in arms]).T)
        a1, a2 = np.array(actions, np.float64).T
        state, reward = state.after(a1, a2, ARRAYS)
        for arm, numbers in zip(arms, np.stack(state, -1).tolist(), strict=True):
            arm.state = State(*numbers)
        obs = np.stack(state.observation(ARRAYS), -1)
        return [(row, value, False, {}) for row, value in zip(obs, reward.tolist(), strict=True)]

    def get_state(self) -> np.ndarray:
        """The numbers of `State` (8,)."""
        return np.array(self.state)

    def set_state(self, state: np.ndarray) -> np.ndarray:
        """Continue from `state` (8,), which `get_state` returned; return the observation (9,)."""
        self.state = State(*state.tolist())
        return np.array(self.state.observation(FLOATS))

    def render(self) -> np.ndarray:
        """Picture of the arena from above (480, 480, 3), uint8."""
        state = self.state
        elbow = _UPPER * math.cos(state.q1), _UPPER * math.sin(state.q1)
        return draw_arm(elbow, state.fingertip(FLOATS), (state.target_x, state.target_y), LIMIT)

    def close(self) -> None:
        """There is nothing to free."""
