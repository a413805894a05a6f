"""The paper's 13 tasks (Table "Experiment environments and constraints"): a robot and a constraint each.

All indices into observations are in this file. Angles and velocities are as the observation reports them: Hopper and
Walker2d clip velocities to +-10, Reacher's velocities are 0.1 x rad/s, and its theta_2 is the joint angle divided by 3.
"""

from __future__ import annotations

import torch
from torch import Tensor

from constraints import (
    Ball,
    Box,
    HalfSpace,
    PlanarEllipse,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)
from envs.locomotion import HalfCheetah, Hopper, Walker2d
from envs.reacher import Reacher
from envs.registry import TASKS, Task


def _reacher_velocities(obs: Tensor) -> Tensor:
    return obs[..., 6:9:2]


def _hopper_velocities(obs: Tensor) -> Tensor:
    return obs[..., 8:11]


def _six_joint_velocities(obs: Tensor) -> Tensor:  # HalfCheetah and Walker2d have the same layout
    return obs[..., 11:17]


def _hopper_sin2(obs: Tensor) -> Tensor:
    return torch.sin(obs[..., 2:5]).square()


def _six_joint_sin2(obs: Tensor) -> Tensor:
    return torch.sin(obs[..., 2:8]).square()


def _tip_matrix(obs: Tensor) -> Tensor:
    """Q (..., 2, 2) with a'Qa = a1^2 + 2 a1 (a1 + a2) cos(theta_2) + (a1 + a2)^2."""
    c = torch.cos(obs[..., 7])
    return torch.stack((2 + 2 * c, 1 + c, 1 + c, torch.ones_like(c)), -1).unflatten(-1, (2, 2))


def _leg_normal(obs: Tensor) -> Tensor:
    """Normal (..., 6) of HC+MA: thigh velocity times sine of its leg's summed angles, back and front."""
    sines = torch.sin(obs[..., 2:8].unflatten(-1, (2, 3)).sum(-1))
    normal = torch.zeros_like(obs[..., :6])
    normal[..., ::3] = obs[..., 11:17:3] * sines
    return normal


REACHER_STEPS, LOCOMOTION_STEPS = 300_000, 1_000_000
_OUTPUT = "total absolute mechanical power at most {}"
_POSITIVE = "total positive mechanical power at most {}"

_PAPER = {
    "R+N": Task(
        Reacher,
        Box(2),
        "no additional constraint",
        r"\text{no additional constraint}",
        REACHER_STEPS,
    ),
    "R+L2": Task(
        Reacher,
        Ball(0.05, 2),
        "sum of squared torques at most 0.05",
        r"a_1^2 + a_2^2 \leq 0.05",
        REACHER_STEPS,
    ),
    "R+O03": Task(
        Reacher,
        WeightedL1(_reacher_velocities, 0.3, 2),
        _OUTPUT.format(0.3),
        r"\sum_{i=1}^2 |w_i a_i| \leq 0.3",
        REACHER_STEPS,
    ),
    "R+O10": Task(
        Reacher,
        WeightedL1(_reacher_velocities, 1.0, 2),
        _OUTPUT.format(1),
        r"\sum_{i=1}^2 |w_i a_i| \leq 1.0",
        REACHER_STEPS,
    ),
    "R+O30": Task(
        Reacher,
        WeightedL1(_reacher_velocities, 3.0, 2),
        _OUTPUT.format(3),
        r"\sum_{i=1}^2 |w_i a_i| \leq 3.0",
        REACHER_STEPS,
    ),
    "R+M": Task(
        Reacher,
        WeightedPositivePart(_reacher_velocities, 1.0, 2),
        _POSITIVE.format(1),
        r"\sum_{i=1}^2 \max\{w_i a_i, 0\} \leq 1.0",
        REACHER_STEPS,
    ),
    "R+T": Task(
        Reacher,
        PlanarEllipse(_tip_matrix, 0.05),
        "squared length of the sum of two vectors of lengths a_1 and a_1 + a_2 at the angle theta_2, at most 0.05",
        r"a_1^2 + 2 a_1 (a_1 + a_2) \cos\theta_2 + (a_1 + a_2)^2 \leq 0.05",
        REACHER_STEPS,
    ),
    "HC+O": Task(
        HalfCheetah,
        WeightedL1(_six_joint_velocities, 20.0, 6),
        _OUTPUT.format(20),
        r"\sum_{i=1}^6 |w_i a_i| \leq 20",
        LOCOMOTION_STEPS,
    ),
    "HC+MA": Task(
        HalfCheetah,
        HalfSpace(_leg_normal, 5.0, 6),
        "power of the two thighs, each times the sine of its leg's summed angles, at most 5",
        r"w_1 a_1 \sin(\theta_1 + \theta_2 + \theta_3) + w_4 a_4 \sin(\theta_4 + \theta_5 + \theta_6) \leq 5",
        LOCOMOTION_STEPS,
    ),
    "H+M": Task(
        Hopper,
        WeightedPositivePart(_hopper_velocities, 10.0, 3),
        _POSITIVE.format(10),
        r"\sum_{i=1}^3 \max\{w_i a_i, 0\} \leq 10",
        LOCOMOTION_STEPS,
    ),
    "H+O+S": Task(
        Hopper,
        WeightedL1AndEllipse(_hopper_velocities, 10.0, _hopper_sin2, 0.1, 3),
        _OUTPUT.format(10) + "; squared torques, weighted by sin^2 of the joint angles, at most 0.1",
        r"\sum_{i=1}^3 |w_i a_i| \leq 10,\ \sum_{i=1}^3 a_i^2 \sin^2\theta_i \leq 0.1",
        LOCOMOTION_STEPS,
    ),
    "W+M": Task(
        Walker2d,
        WeightedPositivePart(_six_joint_velocities, 10.0, 6),
        _POSITIVE.format(10),
        r"\sum_{i=1}^6 \max\{w_i a_i, 0\} \leq 10",
        LOCOMOTION_STEPS,
    ),
    "W+O+S": Task(
        Walker2d,
        WeightedL1AndEllipse(_six_joint_velocities, 10.0, _six_joint_sin2, 0.1, 6),
        _OUTPUT.format(10) + "; squared torques, weighted by sin^2 of the joint angles, at most 0.1",
        r"\sum_{i=1}^6 |w_i a_i| \leq 10,\ \sum_{i=1}^6 a_i^2 \sin^2\theta_i \leq 0.1",
        LOCOMOTION_STEPS,
    ),
}

TASKS.update(_PAPER)
