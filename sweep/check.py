"""The check before training: it tries once, in small, all that the run will use of constraint, map and algorithm.

Errors thus appear in the first second, and not after the warm-up or at the first checkpoint.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from typing import Any

import torch
from torch import Tensor

from algos import ALGORITHMS, Algorithm
from algos.check import ContractError, check_parameters
from constraints import Constraint
from constraints.ray import Ray
from core.agent import Agent
from core.config import Config
from core.guard import replace_methods
from core.maps import Sample
from core.replay import Batch
from core.words import ConfigError
from envs import TASKS
from envs.constrained import allowed_violation
from store.files import one_line

SEEDS, BATCH = 2, 3  # of the small training: observations have two leading axes, as in a gradient step
POINTS = ("project", "center", "alpha_map", "radial_map", "gauge_map", "linear_oracle")
"""Methods of a constraint that return points of the set."""


def check_training(config: Config, make_env: Callable[[], Any]) -> None:
    """Raise a ConfigError that names the method if the run of `config` would not work.

    The check acts, evaluates and learns with tiny networks at first observations of the task's robot, and saves the
    state. Errors in an algorithm's own code keep their type, because their tracebacks show the place.
    """
    constraint = TASKS[config.env].constraint
    env = make_env()
    try:
        observations = [env.reset(seed=0)[0], *(env.reset()[0] for _ in range(SEEDS * BATCH))]
        obs = torch.stack([torch.from_numpy(each).float() for each in observations])
        _check_projection(config.env, constraint, env.robot.action_dim, obs[:1])
        _check_saving(f"the state of {config.env}'s environment", env.unwrapped.get_state)
    finally:
        env.close()
    _check_algorithm(config, _named(config.env, constraint), obs[1:].unflatten(0, (SEEDS, BATCH)))


def _check_projection(task: str, constraint: Constraint, action_dim: int, obs: Tensor) -> None:
    """Raise ConfigError if the constraint does not fit the robot or its projection fails at obs (1, n)."""
    try:
        if constraint.dim != action_dim:
            raise ValueError(f"it is for {constraint.dim} action coordinates, but the robot has {action_dim}")
        action = constraint.project(obs, torch.ones(1, constraint.dim))
        if action.shape != (1, constraint.dim) or not _is_allowed(constraint, obs, action):
            raise ValueError(
                f"at a first observation of the robot, it projects (1, ..., 1) to {action.tolist()}, which is not a"
                " feasible action"
            )
    except Exception as error:  # the constraint may be the user's own code
        raise ConfigError(f"the constraint of {task} does not work: {one_line(error)}") from error


def _is_allowed(constraint: Constraint, obs: Tensor, action: Tensor) -> bool:
    """Whether environments execute the actions (..., d) at obs (..., n)."""
    violation = constraint.violation(obs, action)
    return bool((violation <= allowed_violation(constraint, obs, violation.max().item())).all())


def _named(task: str, constraint: Constraint) -> Constraint:
    """A copy of `constraint` whose methods raise ConfigErrors that name them, for errors and for impossible results."""
    return replace_methods(constraint, partial(_reporting, task, constraint))


def _reporting(task: str, constraint: Constraint, name: str, method: Callable) -> Callable:
    def refuse(obs: Tensor, said: str) -> ConfigError:
        return ConfigError(
            f"the constraint of {task} does not work: {name} at observations of shape {_shape(obs)}: {said}"
        )

    @wraps(method)
    def reporting(*args: Any, **kwargs: Any) -> Any:
        obs: Any = kwargs["obs"] if "obs" in kwargs else args[0]
        try:
            result = method(*args, **kwargs)
            if isinstance(result, Ray):
                _ = result.gradient  # a ray computes it only when asked
        except Exception as error:  # the constraint may be the user's own code
            raise refuse(obs, one_line(error)) from error
        if name in POINTS:
            if result.shape[-1:] != (constraint.dim,) or result.shape[-obs.dim() : -1] != obs.shape[:-1]:
                raise refuse(obs, f"the result has shape {_shape(result)}")
            if not _is_allowed(constraint, obs, result):
                violation = constraint.violation(obs, result).max().item()
                raise refuse(obs, f"the result violates the constraint by {violation:.3g}")
        return result

    return reporting


def _check_algorithm(config: Config, constraint: Constraint, obs: Tensor) -> None:
    """Act, evaluate and learn at obs (seeds, batch, n); ConfigError for a wrong result."""
    algorithm: Algorithm = ALGORITHMS[config.algo]
    small = replace(config, hidden=[4] * len(config.hidden), batch_size=BATCH)
    alone, agent = (
        algorithm.build(small, constraint, obs.shape[-1], seeds) for seeds in ([SEEDS - 1], list(range(SEEDS)))
    )
    for each in (alone, agent):
        each.map.use_untrained(constraint, obs)
    try:
        check_parameters(config.algo, alone, agent)
    except ContractError as error:
        raise ConfigError(str(error)) from error
    _check_map(config, agent, obs)
    which = list(range(SEEDS))
    agent.start_episode(which)
    agent.start_rollout(which)
    now, center = obs[:, 0], agent.centers(obs[:, 0])
    for warming_up, exploring in ((which, []), ([], which)):
        _check_actions(config, "acting", agent, now, agent.act(now, center, warming_up, exploring).executed)
    _check_actions(config, "the policy", agent, obs, agent.policy(which)(obs.to(agent.device)).cpu())

    stored = agent.act(now, center, which, []).stored.unsqueeze(1).expand(-1, BATCH, -1)
    zeros, centers = torch.zeros(SEEDS, BATCH), agent.centers(obs)
    batch = Batch(obs, stored, zeros, zeros, obs.flip(1), centers, None if centers is None else centers.flip(1))
    batch = Batch(*(None if column is None else column.to(agent.device) for column in batch))
    for _ in range(agent.cycle):
        agent.update(batch)
    agent.statistics()
    for i in which:
        if name := agent.infinite_parameter(i):
            raise ConfigError(f"{config.algo} on {config.env}: a gradient step makes parameter {name} infinite or NaN")
    _check_saving(f"the state of {config.algo}", lambda: agent.training_state(0))


def _check_map(config: Config, agent: Agent, obs: Tensor) -> None:
    """Try every method of the map that the algorithm may use, with its gradient; ConfigError if one fails."""
    generator = torch.Generator().manual_seed(0)
    suggested = torch.randn(*obs.shape[:-1], agent.action_dim, generator=generator)
    suggested = agent.squash(suggested).requires_grad_()
    center, constraint, name = agent.centers(obs), agent.constraint, type(agent.map).__name__
    try:
        mapped = {
            "__call__": agent.map(constraint, obs, suggested, center),
            "pull_back": agent.map.pull_back(constraint, obs, suggested.detach().clamp(-1.0, 1.0), center),
        }
        if agent.needs_log_prob and agent.placement != "environment":
            ones = torch.ones_like(suggested)
            sample = Sample(suggested, 0.5 * suggested, ones, suggested.sum(-1))
            mapped["with_log_prob"], log_prob = agent.map.with_log_prob(constraint, obs, sample, center)
            if log_prob.shape != obs.shape[:-1] or not log_prob.isfinite().all():
                raise ValueError(
                    f"with_log_prob returns {log_prob.tolist()}, not finite numbers of shape {tuple(obs.shape[:-1])}"
                )
        for method, action in mapped.items():
            _check_actions(config, f"the map {name}, {method}", agent, obs, action)
            if agent.placement == "layer" and method != "pull_back":
                (gradient,) = torch.autograd.grad(action.sum(), suggested, retain_graph=True)
                if not gradient.isfinite().all():
                    raise ValueError(f"the gradient through {method} is infinite or NaN")
    except ConfigError:
        raise
    except Exception as error:  # the map may be the user's own code
        said = f"{one_line(error)} (at observations of shape {_shape(obs)})"
        raise ConfigError(f"the map {name} does not work on {config.env}: {said}") from error


def _check_actions(config: Config, what: str, agent: Agent, obs: Tensor, action: Tensor) -> None:
    """Raise ConfigError if actions (..., d) have a wrong shape or are infeasible at obs (..., n)."""
    if action.shape != (*obs.shape[:-1], agent.action_dim):
        raise ConfigError(
            f"{config.algo} on {config.env}: {what} gives actions of shape {_shape(action)} for observations of shape"
            f" {_shape(obs)}"
        )
    if not _is_allowed(agent.constraint, obs, action.detach()):
        violation = agent.constraint.violation(obs, action.detach()).max().item()
        raise ConfigError(
            f"{config.algo} on {config.env}: {what} gives an action that violates the constraint by {violation:.3g}"
        )


def _check_saving(what: str, state: Callable[[], Any]) -> None:
    """Raise ConfigError if a checkpoint cannot store a state: it takes tensors, numbers and text."""
    try:
        saved = io.BytesIO()
        torch.save(state(), saved)
        saved.seek(0)
        torch.load(saved, weights_only=True)
    except Exception as error:  # whatever the user's state holds
        raise ConfigError(f"{what} cannot be saved in a checkpoint: {one_line(error)}") from error


def _shape(tensor: Tensor) -> str:
    return str(tuple(tensor.shape))
