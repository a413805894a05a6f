"""The parts of `algos.load_policy`: the policy that it returns, and reading the files of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from constraints import Constraint
from core.agent import Agent
from core.words import ConfigError, known_name
from store.checkpoint import CheckpointFolder
from store.files import one_line
from store.folder import has_ended, read_settings


@dataclass(frozen=True)
class Policy:
    """A deterministic policy, as evaluations run it.

    Call it with observations (n,) or (m, n); it returns the executed actions (d,) or (m, d), float32, which are
    feasible under `constraint`. Raises ValueError for observations of another shape.
    """

    agent: Agent
    constraint: Constraint

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        seen = torch.as_tensor(np.asarray(obs), dtype=torch.float32)
        n = self.agent.obs_dim
        if seen.dim() not in (1, 2) or seen.shape[-1] != n:
            raise ValueError(f"expected observations ({n},) or (m, {n}), got shape {tuple(seen.shape)}")
        actions = self.agent.policy([0])(seen.reshape(1, -1, n))
        return actions.reshape(*seen.shape[:-1], self.agent.action_dim).numpy()


def settings_of(folder: Path) -> dict[str, Any]:
    """The configuration in the folder of a run. Raises ConfigError if there is none."""
    settings = read_settings(folder)
    if not all(isinstance(settings.get(key), str) for key in ("algo", "env")):
        raise ConfigError(
            f"{folder} is not the folder of a run (no readable config.yaml; expected .../<task>/<algorithm>/seed=<n>)"
        )
    return settings


def parts_of(task: str) -> tuple[Constraint, type, int]:
    """A task's constraint, the class of its robot and the length of its observations. ConfigError if it is unknown."""
    # `algos` may not import `envs`, which has the tasks. Gymnasium imports `envs` if a program has not done so.
    env: Any = gymnasium.make("envs:acrl/Task-v0", task=task, disable_env_checker=True)
    found = env.unwrapped.constraint, type(env.unwrapped.robot), env.observation_space.shape[0]
    env.close()
    return found


def restore(agent: Agent, folder: Path, which: str) -> None:
    """Load the "best" or "last" parameters of the run in `folder` into the only seed of `agent`.

    Raises ConfigError for another `which`, and for parameters that are missing, damaged or of other networks.
    """
    parameters, path = _read_parameters(folder, known_name("parameters", which, ("best", "last")))
    try:
        agent.load_state(0, parameters)
    except (KeyError, RuntimeError) as error:
        raise ConfigError(f"{path} does not fit the networks of this version: {one_line(error)}") from error


def _read_parameters(folder: Path, which: str) -> tuple[dict[str, Tensor], Path]:
    """The parameters, and the path of their file."""
    if which == "last" and not has_ended(folder):
        checkpoints, _ = CheckpointFolder(folder).read()
        if checkpoints:
            return checkpoints[0].state()["agent"]["parameters"], checkpoints[0].path
    path = folder / f"{which}.pt"
    if not path.is_file():
        reason = {"best": "no evaluation yet (which=last takes its newest checkpoint)", "last": "no checkpoint yet"}[
            which
        ]
        raise ConfigError(f"{folder} has no {which} parameters: {reason}")
    try:
        parameters = torch.load(path, weights_only=True)
    except Exception as error:  # PyTorch passes on any error of its unpickler or archive reader
        raise ConfigError(f"{path} is damaged: {one_line(error) or type(error).__name__}") from error
    if not isinstance(parameters, dict) or not all(isinstance(value, Tensor) for value in parameters.values()):
        raise ConfigError(f"{path} is damaged: its content is not a dict of tensors")
    return parameters, path
