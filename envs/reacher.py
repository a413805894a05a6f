"""PyBullet-Gym's Reacher: a two-joint planar arm whose fingertip has to reach a target.

Matches the original's observations and rewards to 1e-6 (`tests/data/golden_seed*.npz`).
"""

import os
from contextlib import contextmanager

import numpy as np


@contextmanager
def _silent_import():
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


class Reacher:
    """One arm in a physics client of its own, so several can live in one process.

    Observation (9,): target x, y; fingertip minus target x, y; cos and sin of joint 0; its velocity
    (x 0.1); joint 1's position (mapped to +-1 over its limits of +-3 rad) and velocity (x 0.1).
    Action (2,): torques of the two joints in units of 0.05.
    """

    hyperparameters = "Reacher"  # its group in the paper's table
    obs_dim, action_dim = 9, 2
    max_episode_steps = 150
    fps = 61  # 1 / 0.0165 s

    def __init__(self):
        with _silent_import():
            import pybullet
            import pybullet_data
        self._bullet = bullet = pybullet
        self._client = client = bullet.connect(bullet.DIRECT)
        if client < 0:
            raise RuntimeError("PyBullet could not start another physics client in this process")
        bodies = bullet.loadMJCF(
            os.path.join(pybullet_data.getDataPath(), "mjcf", "reacher.xml"),
            flags=bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS,
            physicsClientId=client,
        )
        bullet.setGravity(0, 0, 0, physicsClientId=client)
        bullet.setDefaultContactERP(0.9, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=0.0165, numSolverIterations=5, numSubSteps=1, physicsClientId=client
        )
        # name -> (body, index), for joints and for links alike
        self._joints, self._links = {}, {}
        for body in bodies:
            for index in range(bullet.getNumJoints(body, physicsClientId=client)):
                joint = bullet.getJointInfo(body, index, physicsClientId=client)
                self._joints[joint[1].decode()] = body, index
                self._links[joint[12].decode()] = body, index
                self._disable_motor(body, index)
        # colours for pictures; the loader ignores the model's own
        for name, colour in (
            ("body0", (0, 0.4, 0.6, 1)),
            ("body1", (0, 0.4, 0.6, 1)),
            ("target", (0.9, 0.2, 0.2, 1)),
        ):
            body, index = self._links[name]
            bullet.changeVisualShape(body, index, rgbaColor=colour, physicsClientId=client)
        self._potential = 0.0

    def reset(self, rng):
        """Draw target and joint positions from `rng` (numpy Generator); return the observation (9,)."""
        target = rng.uniform(-0.27, 0.27), rng.uniform(-0.27, 0.27)
        joints = rng.uniform(-3.14, 3.14), rng.uniform(-3.14, 3.14)
        for name, position in zip(("target_x", "target_y", "joint0", "joint1"), target + joints, strict=True):
            body, index = self._joints[name]
            self._bullet.resetJointState(body, index, position, 0.0, physicsClientId=self._client)
            self._disable_motor(body, index)
        obs, self._potential = self._observe()
        return obs

    def step(self, action):
        """Apply `action` (2,) for 0.0165 s; return obs (9,), reward, False (never ends), info."""
        bullet, client = self._bullet, self._client
        a0, a1 = map(float, action)
        for name, a in (("joint0", a0), ("joint1", a1)):
            body, index = self._joints[name]
            bullet.setJointMotorControl2(
                body,
                index,
                bullet.TORQUE_CONTROL,
                force=0.05 * min(max(a, -1.0), 1.0),
                physicsClientId=client,
            )
        bullet.stepSimulation(physicsClientId=client)
        obs, potential = self._observe()
        progress, self._potential = potential - self._potential, potential
        electricity = -0.10 * (abs(a0 * obs[6]) + abs(a1 * obs[8])) - 0.01 * (abs(a0) + abs(a1))
        stuck = -0.1 if abs(abs(obs[7]) - 1.0) < 0.01 else 0.0
        return obs, float(progress + electricity + stuck), False, {}

    def render(self, width=480, height=480):
        """Picture of the arena from above (height, width, 3), uint8, by PyBullet's software renderer."""
        bullet, client = self._bullet, self._client
        view = bullet.computeViewMatrix([0, -0.25, 0.8], [0, -0.01, 0], [0, 1, 0], physicsClientId=client)
        projection = bullet.computeProjectionMatrixFOV(50, width / height, 0.1, 5, physicsClientId=client)
        pixels = bullet.getCameraImage(
            width, height, view, projection, renderer=bullet.ER_TINY_RENDERER, physicsClientId=client
        )[2]
        return np.array(pixels, np.uint8).reshape(height, width, 4)[:, :, :3].copy()

    def close(self):
        """Free the physics client; closing twice is harmless."""
        if self._client is not None:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = None

    def _disable_motor(self, body, index):
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

    def _joint_state(self, name):
        return self._bullet.getJointState(*self._joints[name], physicsClientId=self._client)[:2]

    def _link_position(self, name):
        return self._bullet.getLinkState(*self._links[name], physicsClientId=self._client)[0]

    def _observe(self):
        """Return the observation (9,) and the potential -100 |fingertip - target| (in three dimensions)."""
        (theta, theta_velocity), (gamma, gamma_velocity) = map(self._joint_state, ("joint0", "joint1"))
        target_x, target_y = self._joint_state("target_x")[0], self._joint_state("target_y")[0]
        to_target = np.subtract(self._link_position("fingertip"), self._link_position("target"))
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
