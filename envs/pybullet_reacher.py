"""Reacher on PyBullet, the reference of the closed form in `envs.reacher`: `simulator="pybullet"`.

Matches the original's observations and rewards to 1e-6 (`tests/data/golden_seed*.npz`).
"""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from envs.reacher import TIME_STEP, TORQUE, Reacher
from envs.robot import SimulatedRobot, Step, UnavailableError


@contextmanager
def _silent_import() -> Iterator[None]:
    """Send file descriptors 1 and 2 to the null device: PyBullet's C code prints its build time there."""
    null = os.open(os.devnull, os.O_WRONLY)
    saved = [(fd, os.dup(fd)) for fd in (1, 2)]
    try:
        for fd, _ in saved:
            os.dup2(null, fd)
        yield
    finally:
        for fd, copy in saved:
            os.dup2(copy, fd)
            os.close(copy)
        os.close(null)


class PyBulletReacher(SimulatedRobot):
    """One arm in a physics client of its own; observations and actions are those of `Reacher`.

    Raises UnavailableError if PyBullet is not installed.
    """

    obs_dim, action_dim = Reacher.obs_dim, Reacher.action_dim
    max_episode_steps, fps = Reacher.max_episode_steps, Reacher.fps

    def __init__(self) -> None:
        try:
            with _silent_import():
                import pybullet
                import pybullet_data
        except ImportError:
            python = f"{sys.version_info.major}.{sys.version_info.minor}"
            raise UnavailableError(
                "simulator 'pybullet' needs the package pybullet, which has wheels for Linux on x86-64 with Python up"
                f" to 3.11 (this is Python {python}); the default simulator gives bit-identical joint angles"
            ) from None
        self._bullet = bullet = pybullet
        client = bullet.connect(bullet.DIRECT)
        if client < 0:
            raise RuntimeError("PyBullet could not start another physics client in this process")
        # called once: by close(), when the robot is deleted, or when the process ends
        self._disconnect = weakref.finalize(self, bullet.disconnect, client)
        self._own_client = client
        bodies = bullet.loadMJCF(
            os.path.join(pybullet_data.getDataPath(), "mjcf", "reacher.xml"),
            flags=bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS,
            physicsClientId=client,
        )
        bullet.setGravity(0, 0, 0, physicsClientId=client)
        bullet.setDefaultContactERP(0.9, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, numSolverIterations=5, numSubSteps=1, physicsClientId=client
        )
        # name -> (body, index), for joints and for links alike
        self._joints, self._links = {}, {}
        for body in bodies:
            for index in range(bullet.getNumJoints(body, physicsClientId=client)):
                joint = bullet.getJointInfo(body, index, physicsClientId=client)
                self._joints[joint[1].decode()] = body, index
                self._links[joint[12].decode()] = body, index
                self._disable_motor(body, index)
        self._potential = 0.0
        self._to_target = 0.0, 0.0
        self._built()

    @property
    def _client(self) -> int:
        if not self._disconnect.alive:
            raise RuntimeError("this PyBulletReacher is closed; make a new one")
        return self._own_client

    def reset(self, rng: np.random.Generator) -> np.ndarray:
        """Draw target and joint positions from `rng` (numpy Generator); return the observation (9,)."""
        start = Reacher()
        start.reset(rng)
        self.place(*start.state[:4], target=start.state[4:6])
        return self._observe()[0]

    def place(self, q1: float, q2: float, w1: float, w2: float, target: tuple[float, float] = (0.0, 0.0)) -> None:
        """Put the arm at angles `q1`, `q2` in rad with speeds `w1`, `w2` in rad/s, and the target at (x, y)."""
        values = {"target_x": (target[0], 0.0), "target_y": (target[1], 0.0), "joint0": (q1, w1), "joint1": (q2, w2)}
        for name, (position, speed) in values.items():
            body, index = self._joints[name]
            self._bullet.resetJointState(body, index, position, speed, physicsClientId=self._client)
            self._disable_motor(body, index)
        self._potential = self._observe()[1]

    def advance(self, t1: float, t2: float) -> tuple[float, float, float, float]:
        """Apply torques in N m for a time step of 0.0165 s; return angles and speeds (q1, q2, w1, w2)."""
        bullet, client = self._bullet, self._client
        for name, torque in (("joint0", t1), ("joint1", t2)):
            body, index = self._joints[name]
            bullet.setJointMotorControl2(body, index, bullet.TORQUE_CONTROL, force=torque, physicsClientId=client)
        bullet.stepSimulation(physicsClientId=client)
        (q1, w1), (q2, w2) = map(self._joint_state, ("joint0", "joint1"))
        return q1, q2, w1, w2

    def step(self, action: np.ndarray) -> Step:
        """Apply `action` (2,) for 0.0165 s; return obs (9,), reward, False (never ends), info."""
        a0, a1 = map(float, action)
        self.advance(*(TORQUE * min(max(a, -1.0), 1.0) for a in (a0, a1)))
        obs, potential = self._observe()
        progress, self._potential = potential - self._potential, potential
        electricity = -0.10 * (abs(a0 * obs[6]) + abs(a1 * obs[8])) - 0.01 * (abs(a0) + abs(a1))
        stuck = -0.1 if abs(abs(obs[7]) - 1.0) < 0.01 else 0.0
        return obs, float(progress + electricity + stuck), False, {}

    def get_state(self) -> np.ndarray:
        """Angles, speeds, target, the reported fingertip minus target, and the potential (9,)."""
        (q1, w1), (q2, w2) = map(self._joint_state, ("joint0", "joint1"))
        target = self._joint_state("target_x")[0], self._joint_state("target_y")[0]
        return np.array((q1, q2, w1, w2, *target, *self._to_target, self._potential))

    def set_state(self, state: np.ndarray) -> np.ndarray:
        """Continue from `state` (9,), which `get_state` returned; return the observation (9,)."""
        q1, q2, w1, w2, target_x, target_y, dx, dy, potential = state.tolist()
        self.place(q1, q2, w1, w2, target=(target_x, target_y))
        obs = self._observe()[0]
        obs[2:4] = self._to_target = dx, dy  # the reported fingertip is one step late, see `envs.reacher.State`
        self._potential = potential
        return obs

    def render(self) -> np.ndarray:
        """The picture that `Reacher` makes (480, 480, 3), uint8; PyBullet's own would need its slow renderer."""
        arm = Reacher()
        (q1, w1), (q2, w2) = map(self._joint_state, ("joint0", "joint1"))
        target = self._joint_state("target_x")[0], self._joint_state("target_y")[0]
        arm.set_state(np.array((q1, q2, w1, w2, *target, *target)))
        return arm.render()

    def close(self) -> None:
        """Free the physics client; closing twice is harmless."""
        self._disconnect()

    def _disable_motor(self, body: int, index: int) -> None:
        # Bullet gives every joint a velocity motor of its own; one without force lets the joint move freely
        self._bullet.setJointMotorControl2(
            body,
            index,
            self._bullet.POSITION_CONTROL,
            targetPosition=0,
            targetVelocity=0,
            positionGain=0.1,
            velocityGain=0.1,
            force=0,
            physicsClientId=self._client,
        )

    def _joint_state(self, name: str) -> tuple[float, float]:
        return self._bullet.getJointState(*self._joints[name], physicsClientId=self._client)[:2]

    def _link_position(self, name: str) -> tuple[float, float, float]:
        return self._bullet.getLinkState(*self._links[name], physicsClientId=self._client)[0]

    def _observe(self) -> tuple[np.ndarray, float]:
        """Return the observation (9,) and the potential -100 |fingertip - target| (in three dimensions)."""
        (theta, theta_velocity), (gamma, gamma_velocity) = map(self._joint_state, ("joint0", "joint1"))
        target_x, target_y = self._joint_state("target_x")[0], self._joint_state("target_y")[0]
        to_target = np.subtract(self._link_position("fingertip"), self._link_position("target"))
        self._to_target = float(to_target[0]), float(to_target[1])
        obs = np.array(
            [
                target_x,
                target_y,
                to_target[0],
                to_target[1],
                np.cos(theta),
                np.sin(theta),
                0.1 * theta_velocity,
                gamma / 3.0,
                0.1 * gamma_velocity,
            ]
        )
        return obs, -100.0 * np.sqrt(to_target @ to_target)
