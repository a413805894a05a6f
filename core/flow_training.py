"""Trains a flow (`core.flow`) once for each task and settings, before any agent. All seeds share it.

Let x be the point of the box, a the action and s the state:

- `mle`, as FlowPG: actions a are uniform in the set, x = encode(a | s), and the loss is log |det da/dx| plus half the
  square of x's distance from the box in units of `mle_softness`: maximum likelihood under a box with soft edges.
- `reverse`, as CV-Flow: points x are uniform in the box, a = decode(x | s), and the loss is -log |det da/dx| plus how
  far a is outside in units of `reverse_softness`: the Kullback-Leibler divergence to a set with soft edges. "How far
  outside" is `Constraint.penalty` plus the sum of what exceeds the box. Every second point is moved to a face of the
  box, where policies often are. Otherwise the flow would take most of the faces outside the set.

The states come from random play and are moved towards their mean or away from it (`FURTHEST`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from constraints import Constraint, ConstraintError, check_inputs
from core.flow import Flow
from core.networks import Adam
from core.snapshot import parameters_of

POOL = 100_000
"""The number of training states. For `mle`, each has an action that is uniform in its set."""
HELD_OUT = 4_000
"""The number of states for the measures, from parts of random play that the training does not use."""
FURTHEST = 4.0
"""The largest factor on a state's distance from the mean: a trained policy moves faster than a random one."""
SCALING = 1_000
"""The number of actions that set the flow's scales for `reverse`. For `mle`, all actions do."""
LARGEST_STEP = 0.1
"""The norm to which gradients are clipped, as published."""
TRIES = 64
_CHUNK = 2_000
_SLOW_CHUNK = 100
"""The number of states for which `Constraint.sample` draws between two calls of `stop_if_asked`."""
_FEASIBLE = 1e-6


class DivergedError(Exception):
    """The loss of a flow is not finite. The message is one line."""


class FlowTraining:
    """Trains a flow with the settings of the map `flow`.

    `obs` (n, k) are observations of random play, the last `HELD_OUT` for the measures. The same arguments give the same
    bits. The constructor calls `stop_if_asked`, which raises to stop it. The constructor raises a ConstraintError if
    the constraint fails at one of `obs`.
    """

    def __init__(
        self, flow: Flow, constraint: Constraint, obs: Tensor, stop_if_asked: Callable[[], None] = lambda: None
    ):
        self.flow, self.constraint = flow, constraint
        self.generator = torch.Generator().manual_seed(1)
        self.step = 0
        self.obs = self._further_out(obs[:-HELD_OUT], POOL, stop_if_asked)
        self.test_obs = self._further_out(obs[-HELD_OUT:], HELD_OUT, stop_if_asked)
        self.features = torch.cat([constraint.features(chunk).float() for chunk in self.obs.split(_CHUNK)])
        self.actions = self._feasible(self.obs if flow.flow == "mle" else self.obs[:SCALING], stop_if_asked)
        self.test_actions = self._feasible(self.test_obs, stop_if_asked)
        self.tolerance = constraint.least_violation(self.test_obs) + _FEASIBLE  # of actions that count as feasible
        self.network = flow.new_network(constraint.dim, self.features.shape[-1])
        self.network.standardize(self.features, self.actions)
        self.optimizer = Adam(self.network.parameters(), flow.flow_learning_rate)
        self.parameters = parameters_of(self.optimizer)

    def _further_out(self, obs: Tensor, count: int, stop_if_asked: Callable[[], None]) -> Tensor:
        """Draw `count` of obs (n, k) and move each to 0 to `FURTHEST` times its distance from the mean of all.

        An observation does not move if its set would be empty. If the constraint fails at one of them, none moves.
        """
        some = obs[torch.randint(len(obs), (count,), generator=self.generator)]
        mean = obs.mean(0)
        moved = mean + FURTHEST * torch.rand(count, 1, generator=self.generator) * (some - mean)
        checked_before, empty = check_inputs(), []
        try:
            for chunk in moved.split(_CHUNK):
                stop_if_asked()
                self.constraint.project(chunk, chunk.new_zeros(len(chunk), self.constraint.dim))
                self.constraint.center(chunk)
                empty.append(self.constraint.least_violation(chunk) > 0.0)
        except ConstraintError:  # a user's set need not exist where the robot cannot be
            return some
        finally:
            check_inputs(checked_before)
        return torch.where(torch.cat(empty).unsqueeze(-1), some, moved)

    def _feasible(self, obs: Tensor, stop_if_asked: Callable[[], None]) -> Tensor:
        """Draw an action (n, d), uniform in its set, for each of obs (n, k).

        It is the first feasible one of `TRIES` draws from the box, which is much faster than `Constraint.sample`; only
        if there is none, `Constraint.sample` draws it. If the set is empty, a draw is projected to the actions with the
        least violation.
        """
        actions = []
        for chunk in obs.split(_CHUNK):
            stop_if_asked()
            tries = 2.0 * torch.rand(len(chunk), TRIES, self.constraint.dim, generator=self.generator) - 1.0
            feasible = self.constraint.violation(chunk.unsqueeze(1), tries) <= 0.0
            action = tries[torch.arange(len(chunk)), feasible.int().argmax(1)]
            empty = self.constraint.least_violation(chunk) > 0.0
            if empty.any():
                action[empty] = self.constraint.project(chunk[empty], action[empty])
            for some in (~feasible.any(1) & ~empty).nonzero().squeeze(1).split(_SLOW_CHUNK):
                stop_if_asked()
                action[some] = self.constraint.sample(chunk[some], 1, self.generator).squeeze(-2)
            actions.append(action)
        return torch.cat(actions)

    @property
    def ended(self) -> bool:
        return self.step == self.flow.flow_steps

    def advance(self) -> None:
        """Take one gradient step. Raises DivergedError if the loss or, at the end, a parameter is not finite."""
        self.optimizer.param_groups[0]["lr"] = self.learning_rate()
        rows = torch.randint(len(self.obs), (self.flow.flow_batch_size,), generator=self.generator)
        loss = (self._likelihood if self.flow.flow == "mle" else self._divergence)(rows).mean()
        gradients = torch.autograd.grad(loss, self.parameters)
        norm = torch.stack(torch._foreach_norm(gradients)).norm()
        torch._foreach_mul_(gradients, (LARGEST_STEP / norm.clamp(min=LARGEST_STEP)).item())
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        self.step += 1
        if not math.isfinite(loss.item()):
            raise DivergedError(f"its loss is {loss.item()} at step {self.step}")
        if self.ended and not all(parameter.isfinite().all() for parameter in self.parameters):
            raise DivergedError("a parameter is not finite at the end")

    def learning_rate(self) -> float:
        """The learning rate of the next step, which falls to 0 along a cosine."""
        return self.flow.flow_learning_rate * 0.5 * (1 + math.cos(math.pi * self.step / self.flow.flow_steps))

    def points(self, count: int) -> Tensor:
        """Draw points (count, d) of the box for the loss `reverse`, every second one on a face."""
        x = 2.0 * torch.rand(count, self.constraint.dim, generator=self.generator) - 1.0
        x[::2] = on_faces(x[::2])
        return x

    def _likelihood(self, rows: Tensor) -> Tensor:
        """The loss `mle` (batch,) at rows of the pool."""
        x, log_det = self.network.encode(self.features[rows], self.actions[rows])
        outside = (x.abs() - 1.0).clamp(min=0.0)
        return log_det + 0.5 * (outside / self.flow.mle_softness).square().sum(-1)

    def _divergence(self, rows: Tensor) -> Tensor:
        """The loss `reverse` (batch,) at rows of the pool."""
        action, log_det = self.network.decode(self.features[rows], self.points(len(rows)))
        outside = self.constraint.penalty(self.obs[rows], action) + (action.abs() - 1.0).clamp(min=0.0).sum(-1)
        return outside / self.flow.reverse_softness - log_det

    @torch.no_grad()
    def measure(self) -> dict[str, float]:
        """Measure the flow at the held-out states, with the same random numbers in every call.

        `accuracy` is the share of uniform points of the box that the flow decodes to feasible actions, `face_accuracy`
        the same share for points on the box's faces. `recall` is the share of uniform feasible actions that the flow
        encodes into the box. `violation` is the mean violation of the actions decoded from points of the box; a
        feasible action counts as 0.
        """
        features = self.constraint.features(self.test_obs)
        x = 2.0 * torch.rand(self.test_actions.shape, generator=torch.Generator().manual_seed(2)) - 1.0
        violation, on_face = (
            self.constraint.violation(self.test_obs, self.network.decode(features, each)[0])
            for each in (x, on_faces(x))
        )
        encoded = self.network.encode(features, self.test_actions)[0]
        return {
            "accuracy": (violation <= self.tolerance).double().mean().item(),
            "face_accuracy": (on_face <= self.tolerance).double().mean().item(),
            "recall": (encoded.abs().amax(-1) <= 1.0).double().mean().item(),
            "violation": violation.double().clamp(min=0.0).mean().item(),
        }

    def state(self) -> dict[str, Any]:
        """What a new object with the same arguments needs to continue with the same bits."""
        optimizer = {
            f"{number}.{key}": value.clone()
            for number, parameter in enumerate(self.parameters)
            for key, value in self.optimizer.state[parameter].items()
        }
        network = {name: value.clone() for name, value in self.network.state_dict().items()}
        return {
            "network": network, "optimizer": optimizer, "generator": self.generator.get_state(), "step": self.step
        }  # fmt: skip

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state` returned."""
        self.network.load_state_dict(state["network"])
        for name, value in state["optimizer"].items():
            number, key = name.split(".")
            self.optimizer.state[self.parameters[int(number)]][key].copy_(value)
        self.generator.set_state(state["generator"])
        self.step = state["step"]


def on_faces(x: Tensor) -> Tensor:
    """Move points x (..., d) along their rays from the origin to the faces of the box."""
    return x / x.abs().amax(-1, keepdim=True).clamp(min=1e-9)
