"""HalfCheetah, Hopper and Walker2d on MuJoCo: step for step Gymnasium's `-v4` tasks (the v3 rewards)."""

from __future__ import annotations

import ctypes.util
import functools
import importlib
import os
import sys
import weakref
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import gymnasium
import numpy as np
import torch

from envs.robot import Robot, SimulatedRobot, Step
from envs.threads import call_each


def import_mujoco() -> Any:
    """The package mujoco, even if MUJOCO_GL names an OpenGL library that is not installed.

    The import loads that library and fails without it, although only pictures need it.
    """
    try:
        return importlib.import_module("mujoco")
    except ModuleNotFoundError:
        raise
    except Exception:  # each library has errors of its own, an absent one an AttributeError
        chosen = os.environ.get("MUJOCO_GL")
        if chosen is None:
            raise
    os.environ["MUJOCO_GL"] = "disable"
    try:
        return importlib.import_module("mujoco")
    finally:
        os.environ["MUJOCO_GL"] = chosen


@contextmanager
def silent_mujoco() -> Iterator[None]:
    """Hide warnings: half_cheetah.xml makes MuJoCo print one and write a MUJOCO_LOG.TXT to the current folder."""
    mujoco = import_mujoco()
    warning_handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(warning_handler)


@functools.cache
def _load_model(file: str) -> Any:
    """The MuJoCo model of `file`. Robots share it: half a megabyte each would fill the processor's cache."""
    mujoco = import_mujoco()
    # Gymnasium's own path without its `envs.mujoco` package, which would load every MuJoCo task
    assets = os.path.join(os.path.dirname(gymnasium.__file__), "envs", "mujoco", "assets")
    with silent_mujoco():
        return mujoco.MjModel.from_xml_path(os.path.join(assets, file))


class _Locomotion(SimulatedRobot):
    """A planar robot that is rewarded for running along x.

    Observation (nq - 1 + nv,): joint positions without the root's x, then joint velocities.
    Action (nu,): joint torques in units of the model's gear ratios.
    """

    max_episode_steps = 1000
    # set by each robot
    model_file: str
    frame_skip: int
    ctrl_cost_weight: float
    healthy_reward: float
    fps: int  # 1 / (time step of the model * frame_skip)

    def __init__(self) -> None:
        self._mujoco = mujoco = import_mujoco()
        self.model = _load_model(self.model_file)
        self.data = mujoco.MjData(self.model)
        # views of the simulator's memory
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._dt = self.model.opt.timestep * self.frame_skip
        self._picture: _Picture | None = None
        self._built()

    def reset(self, rng: np.random.Generator) -> np.ndarray:
        """Draw positions and velocities around the model's own from `rng` (numpy Generator); return obs."""
        self._mujoco.mj_resetData(self.model, self.data)
        self._perturb(rng)
        self._mujoco.mj_forward(self.model, self.data)
        return self._observe()

    def step(self, action: np.ndarray) -> Step:
        """Apply `action` (nu,) for `frame_skip` time steps; return observation, reward, terminated, info.

        The control cost is summed in the action's own precision, as Gymnasium does.
        """
        x_before = self._start(action)
        self._simulate()
        return self._end(x_before, np.square(action).sum())

    @classmethod
    def step_together(cls, robots: Sequence[Robot], actions: Sequence[np.ndarray]) -> list[Step]:
        """`step` of each robot, with the same bits. MuJoCo runs in as many threads as PyTorch uses."""
        ours = cast("Sequence[_Locomotion]", robots)
        starts = [robot._start(action) for robot, action in zip(ours, actions, strict=True)]
        call_each([robot._simulate for robot in ours], torch.get_num_threads())
        if len({action.dtype for action in actions}) == 1:
            squares = [*np.square(np.array(actions)).sum(-1)]
        else:
            squares = [np.square(action).sum() for action in actions]
        return [robot._end(*about) for robot, *about in zip(ours, starts, squares, strict=True)]

    def _start(self, action: np.ndarray) -> float:
        """Apply the action; return x before the step."""
        self._ctrl[:] = action
        return float(self._qpos[0])

    def _simulate(self) -> None:
        """MuJoCo's part of a step. It runs in parallel with other Python threads."""
        self._mujoco.mj_step(self.model, self.data, nstep=self.frame_skip)

    def _end(self, x_before: float, action_squared: np.floating) -> Step:
        """What `step` returns, after MuJoCo's part."""
        x = float(self._qpos[0])
        x_velocity = (x - x_before) / self._dt
        ctrl_cost = float(self.ctrl_cost_weight * action_squared)
        reward = x_velocity + self.healthy_reward - ctrl_cost
        return self._observe(), reward, not self._healthy(), {"x_position": x, "x_velocity": x_velocity}

    def get_state(self) -> np.ndarray:
        """Everything that MuJoCo's next step depends on (k,), the solver's warm start included."""
        state = np.empty(self._mujoco.mj_stateSize(self.model, self._mujoco.mjtState.mjSTATE_INTEGRATION))
        self._mujoco.mj_getState(self.model, self.data, state, self._mujoco.mjtState.mjSTATE_INTEGRATION)
        return state

    def set_state(self, state: np.ndarray) -> np.ndarray:
        """Continue from `state` (k,), which `get_state` returned; return the observation."""
        self._mujoco.mj_resetData(self.model, self.data)
        self._mujoco.mj_setState(self.model, self.data, state, self._mujoco.mjtState.mjSTATE_INTEGRATION)
        self._place_bodies()  # the next step computes everything else
        return self._observe()

    def render(self, width: int = 480, height: int = 480) -> np.ndarray:
        """Picture (height, width, 3), uint8, from the side, the camera following the robot.

        Raises RuntimeError if no OpenGL backend works.
        """
        if self._picture is None:
            self._picture = _Picture(self._mujoco, self.model, width, height)
        self._place_bodies()  # a step leaves them where they were before its last time step
        return self._picture.take(self.data)

    def close(self) -> None:
        """Free the renderer; closing twice is harmless."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None

    def _place_bodies(self) -> None:
        """Compute where the bodies, cameras and lights are; the next step does not depend on it."""
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_camlight(self.model, self.data)

    @abstractmethod
    def _perturb(self, rng: np.random.Generator) -> None:
        """Draw the start of an episode around the model's own positions and velocities."""

    @abstractmethod
    def _observe(self) -> np.ndarray: ...

    @abstractmethod
    def _healthy(self) -> bool:
        """Whether the robot has not fallen."""


class HalfCheetah(_Locomotion):
    """Action (6,): torques of the driven joints, in their order. Never terminates. Observation (17,):

        0      height in m, less the 0.7 m of the model's pose: rootz
        1      pitch in rad: rooty
        2-7    angles of the driven joints in rad:
               bthigh, bshin, bfoot, fthigh, fshin, ffoot
        8-9    velocities of the torso in m/s: rootx, rootz
        10     velocity of the pitch in rad/s: rooty
        11-16  velocities of the driven joints in rad/s:
               bthigh, bshin, bfoot, fthigh, fshin, ffoot

    A joint has the name that it has in MuJoCo's model.
    """

    model_file, frame_skip, obs_dim, action_dim = "half_cheetah.xml", 5, 17, 6
    ctrl_cost_weight, healthy_reward = 0.1, 0.0
    fps = 20

    def _perturb(self, rng: np.random.Generator) -> None:
        self._qpos += rng.uniform(-0.1, 0.1, self.model.nq)
        self._qvel += 0.1 * rng.standard_normal(self.model.nv)

    def _observe(self) -> np.ndarray:
        return np.concatenate((self._qpos[1:], self._qvel))

    def _healthy(self) -> bool:
        return True


class _Upright(_Locomotion):
    """A robot that gets a bonus each step, the last one included, and terminates when it falls.

    Its observation clips velocities to +-10.
    """

    frame_skip, ctrl_cost_weight, healthy_reward = 4, 1e-3, 1.0
    fps = 125

    def _perturb(self, rng: np.random.Generator) -> None:
        self._qpos += rng.uniform(-5e-3, 5e-3, self.model.nq)
        self._qvel += rng.uniform(-5e-3, 5e-3, self.model.nv)

    def _observe(self) -> np.ndarray:
        return np.concatenate((self._qpos[1:], self._qvel.clip(-10.0, 10.0)))


class Hopper(_Upright):
    """Action (3,): torques of the driven joints, in their order. Observation (11,), velocities clipped to +-10:

        0     height in m: rootz
        1     pitch in rad: rooty
        2-4   angles of the driven joints in rad: thigh_joint, leg_joint, foot_joint
        5-6   velocities of the torso in m/s: rootx, rootz
        7     velocity of the pitch in rad/s: rooty
        8-10  velocities of the driven joints in rad/s: thigh_joint, leg_joint, foot_joint

    Falls below 0.7 m, past 0.2 rad or at a state beyond +-100.
    """

    hyperparameters = "Hopper"  # its group in the paper's table
    model_file, obs_dim, action_dim = "hopper.xml", 11, 3

    def _healthy(self) -> bool:
        z, angle = self._qpos[1:3].tolist()
        state = self._qpos[2:].tolist() + self._qvel.tolist()
        return z > 0.7 and abs(angle) < 0.2 and all(-100.0 < s < 100.0 for s in state)


class Walker2d(_Upright):
    """Action (6,): torques of the driven joints, in their order. Observation (17,), velocities clipped to +-10:

        0      height in m: rootz
        1      pitch in rad: rooty
        2-7    angles of the driven joints in rad:
               thigh_joint, leg_joint, foot_joint, thigh_left_joint, leg_left_joint, foot_left_joint
        8-9    velocities of the torso in m/s: rootx, rootz
        10     velocity of the pitch in rad/s: rooty
        11-16  velocities of the driven joints in rad/s:
               thigh_joint, leg_joint, foot_joint, thigh_left_joint, leg_left_joint, foot_left_joint

    Falls outside 0.8 m to 2 m and past 1 rad.
    """

    model_file, obs_dim, action_dim = "walker2d.xml", 17, 6

    def _healthy(self) -> bool:
        z, angle = self._qpos[1:3].tolist()
        return 0.8 < z < 2.0 and -1.0 < angle < 1.0


def _gl_backend() -> str:
    """Name of the OpenGL backend to use: MUJOCO_GL if set, otherwise one that fits this machine.

    The first choice must be right, because PyOpenGL cannot change its platform later. It is made here and not at
    import: `import mujoco` fails if MUJOCO_GL names a backend whose library is missing, and training needs no backend.
    RuntimeError if there is neither a display nor a library for rendering without one.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if chosen:
        return chosen
    if sys.platform == "darwin":
        return "cgl"
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return "glfw"
    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            return backend
    raise RuntimeError(
        "rendering without a display needs libEGL or libOSMesa, and neither is installed "
        "(Debian, Ubuntu: apt-get install libegl1 or libosmesa6)"
    )


class _Picture:
    """An off-screen OpenGL context with a camera that follows the robot's torso."""

    def __init__(self, mujoco: Any, model: Any, width: int, height: int):
        backend = _gl_backend()
        try:
            self._gl = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except Exception as error:  # each backend has errors of its own, an absent library an AttributeError
            raise RuntimeError(
                f"the OpenGL backend {backend!r} does not work on this machine ({error!r}); without a "
                "display, install libegl1 or libosmesa6 and set MUJOCO_GL to 'egl' or 'osmesa'"
            ) from error
        # called once, by close() or when the object is deleted
        self.close = weakref.finalize(self, _free, self._gl, self._context)
        self.close.atexit = False  # at exit OpenGL may be gone already, and the process frees its memory anyway
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._mujoco, self._model = mujoco, model
        self._scene, self._option = mujoco.MjvScene(model, maxgeom=1000), mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        self._camera.trackbodyid = model.body("torso").id
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 4.0, 90.0, -15.0

    def take(self, data: Any) -> np.ndarray:
        self._gl.make_current()
        self._mujoco.mjv_updateScene(
            self._model, data, self._option, None, self._camera, self._mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        self._mujoco.mjr_render(self._viewport, self._scene, self._context)
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), np.uint8)
        self._mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return pixels[::-1].copy()  # OpenGL counts rows from below


def _free(gl: Any, context: Any) -> None:
    gl.make_current()
    context.free()
    gl.free()
