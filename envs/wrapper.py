"""Any Gymnasium environment under any constraint: the wrapper `Constrained`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from constraints import Constraint
from core.words import known_name
from envs.constrained import InfeasibleActionError, allowed_violation

MAPPINGS: dict[str, Callable[[Constraint, Tensor, Tensor], Tensor]] = {
    "project": lambda constraint, obs, action: constraint.project(obs, action),
    "alpha": lambda constraint, obs, action: constraint.alpha_map(obs, action),
    "radial": lambda constraint, obs, action: constraint.radial_map(obs, action),
    "gauge": lambda constraint, obs, action: constraint.gauge_map(obs, action.clamp(-1.0, 1.0)),
}
"""How a suggested action (d,) becomes a feasible one at an observation (n,)."""

KEEP_FEASIBLE = ("project", "alpha")
"""The mappings that leave feasible actions as they are."""


class Constrained(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Lets an environment execute feasible actions only, so that any Gymnasium agent can train under `constraint`.

    The agent's actions are suggestions (d,) in the box [-1, 1]^d. `mapping` turns a suggestion into a feasible action,
    which is rescaled from [-1, 1]^d to the action box of `env`. The feasible set is the one at the last observation of
    `env`, on which the agent has based its action.

    `mapping` is one of
    - "project": the closest feasible point. Suits every agent with a bounded action space.
    - "alpha": the suggestion itself where it is feasible, else the boundary point on its ray from the centre.
    - "gauge": the box, scaled onto the set ray by ray. The map is one to one: different suggestions lead to different
      actions. Suggestions outside the box are clipped to it first.
    - "radial": c + tanh(L)/L (suggestion - c), with L the set's gauge around the centre c. It is made for actors
      without a tanh, whose suggestions are unbounded. A suggestion in the box gets only the share tanh(L) of the way
      from the centre to the boundary: at most 76 % if the set is the box.
    - None: suggestions must be feasible; others raise InfeasibleActionError.

    `info` of each step has `suggested_action` and `executed_action`, both normalised, float64 (d,), and `violation`,
    the suggestion's `Constraint.violation` as a NumPy float64 (feasible if <= 0).

    `constraint` is on normalised actions; `constraints.InUnits` converts a constraint in the units of `env`. It gets
    the observations of `env` as float64 (n,). Put a wrapper that changes observations around this one; inside, it would
    change what the constraint gets. `features` maps an observation to the array (n,) that the constraint gets. It is
    needed if observations are not flat arrays.

    Raises ValueError for an unknown mapping, for an action space that is not a bounded box of floating-point numbers
    (d,), for a constraint of another dimension, and for observations that need `features`. `step` raises
    InfeasibleActionError, a ValueError too, for an action of another shape and for one that is not finite; also if a
    mapped action violates the constraint by more than 1e-6, which shows that the constraint or the observation is
    wrong.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        constraint: Constraint,
        mapping: str | None = "project",
        features: Callable[[Any], np.ndarray] | None = None,
    ):
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, _disable_deepcopy=True, constraint=constraint, mapping=mapping, features=features
        )
        super().__init__(env)
        if not isinstance(constraint, Constraint):
            raise TypeError(f"constraint must be an instance of constraints.Constraint, got {constraint!r}")
        if mapping is not None:
            known_name("mapping", mapping, MAPPINGS)
        if features is None:
            _check_observations(env.observation_space)
        self._box = box = _checked_box(env.action_space, constraint.dim)
        self._middle = (box.high.astype(np.float64) + box.low) / 2.0
        self._half = (box.high.astype(np.float64) - box.low) / 2.0
        self.constraint, self.mapping, self.features = constraint, mapping, features
        self._obs: Tensor | None = None  # what the constraint sees of the last observation
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, box.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Reset the environment; return its observation and info."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._see(obs)
        return obs, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Map `action` (d,) to a feasible action and execute it; return what the environment returns.

        Raises gymnasium.error.ResetNeeded before the first reset, and InfeasibleActionError as the class says.
        """
        if self._obs is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        suggested = np.array(action, np.float64)
        if suggested.shape != self.action_space.shape:
            raise InfeasibleActionError(f"action has shape {suggested.shape}, expected {self.action_space.shape}")
        if not np.isfinite(suggested).all():
            raise InfeasibleActionError(f"action {suggested} is not finite")
        executed, violation = self._feasible(suggested)
        # Rounding may lead out of the box.
        scaled = np.clip((self._middle + self._half * executed).astype(self._box.dtype), self._box.low, self._box.high)
        obs, reward, terminated, truncated, info = self.env.step(scaled)
        self._see(obs)
        own = {"suggested_action": suggested, "executed_action": executed, "violation": np.float64(violation)}
        return obs, float(reward), terminated, truncated, {**info, **own}

    @torch.no_grad()  # coefficients may be learned
    def _feasible(self, suggested: np.ndarray) -> tuple[np.ndarray, float]:
        """The feasible action (d,) of a suggestion (d,), and the suggestion's violation."""
        action = torch.from_numpy(suggested)
        violation = self._violation(action)
        if self.mapping is None:
            if not violation <= (allowed := self._allowed(violation)):
                raise InfeasibleActionError(f"action {suggested} {_excess(violation, allowed)}")
            return suggested.copy(), violation
        if self.mapping in KEEP_FEASIBLE and violation <= 0.0:
            return suggested.copy(), violation
        mapped = MAPPINGS[self.mapping](self.constraint, self._obs, action)
        left = self._violation(mapped)
        if not left <= (allowed := self._allowed(left)):  # a NaN is refused as well
            raise InfeasibleActionError(
                f"{self.mapping} maps {suggested} to {mapped.numpy()}, which {_excess(left, allowed)}; the constraint"
                f" does not work at the observation {self._obs.numpy()}"
            )
        return mapped.numpy(), violation

    def _violation(self, action: Tensor) -> float:
        return self.constraint.violation(self._obs, action).item()

    def _allowed(self, violation: float) -> float:
        return allowed_violation(self.constraint, self._obs, violation).item()

    def _see(self, obs: Any) -> None:
        """Keep a copy of what the constraint sees of an observation: environments may write into theirs."""
        seen = np.array(obs if self.features is None else self.features(obs), np.float64)
        if seen.ndim != 1:
            raise ValueError(f"features() must return an array (n,), got shape {seen.shape}")
        self._obs = torch.from_numpy(seen)


def _excess(violation: float, allowed: float) -> str:
    return f"violates the constraint by {violation:.3g} (at most {allowed:g} is allowed)"


def _checked_box(space: gymnasium.Space, dim: int) -> gymnasium.spaces.Box:
    """The action space; ValueError unless it is a bounded box of floating-point numbers (dim,)."""
    if not isinstance(space, gymnasium.spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise ValueError(f"the action space must be a box of floating-point numbers, got {space}")
    if not space.is_bounded():
        raise ValueError(f"the action space must be bounded, got {space}")
    if space.shape != (dim,):
        raise ValueError(f"the constraint has {dim} action coordinates, but the action space has shape {space.shape}")
    return space


def _check_observations(space: gymnasium.Space) -> None:
    """Raise ValueError for observations that a constraint cannot see without `features`."""
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"observations must be flat arrays, got {space}; pass features=, which turns an observation into the array"
            " (n,) that the constraint sees"
        )
