"""Isolates constraint failures: an observation with, say, an empty set ends its own seed and no other one."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial, wraps
from typing import Any

import torch
from torch import Tensor

from constraints import Constraint, ConstraintError
from constraints.ray import Ray
from core.evaluation import StepTogether, refusal

Rows = Sequence[int] | None
"""For each row of a batch, the index of the row used instead; None if no row is replaced."""


class Guard:
    """Confines a ConstraintError that names a sample to the seed of that sample.

    `constraint` is a copy of the given one. If a method of the copy fails on a seed's observations, it uses another
    seed's observations instead, and `refused` maps the seed's position to the reason. From then on, the results of this
    seed are meaningless. The results of the other seeds do not change. The first axis of the observations must be the
    seeds. Any other error, and an error that leaves no seed, is raised.
    """

    def __init__(self, constraint: Constraint, seeds: int):
        self.positions: Sequence[int] = range(seeds)  # of the seeds on the first axis
        self.refused: dict[int, str] = {}
        self.constraint = replace_methods(constraint, self._guarded)

    @contextmanager
    def of(self, which: Sequence[int]) -> Iterator[dict[int, str]]:
        """In the block, the first axis is the seeds `which`. Yields the seeds refused in the block, at first none."""
        before = self.positions, self.refused
        self.positions, self.refused = which, {}
        try:
            yield self.refused
        finally:
            self.positions, self.refused = before

    def apart(self, policy: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
        """Wrap `policy`, obs (seeds, m, n) -> actions (seeds, m, d), to return NaN for refused seeds.

        Environments refuse to execute NaN.
        """

        def act(obs: Tensor) -> Tensor:
            try:
                actions = policy(obs)
            except ConstraintError:
                if any(position not in self.refused for position in self.positions):  # it belongs to no single seed
                    raise
                return obs.new_full((*obs.shape[:-1], self.constraint.dim), torch.nan)
            refused = [k for k, position in enumerate(self.positions) if position in self.refused]
            if refused:
                actions[refused] = torch.nan
            return actions

        return act

    def _guarded(self, name: str, method: Callable) -> Callable:
        @wraps(method)
        def guarded(*args: Any, **kwargs: Any) -> Any:
            obs = kwargs["obs"] if "obs" in kwargs else args[0]

            def call(rows: Rows) -> Any:
                return method(*args, **kwargs) if rows is None else _call_with(rows, method, args, kwargs)

            result, rows = self._attempt(obs, call)
            if isinstance(result, Ray):  # a ray computes its gauge later
                gauge_of = result._gauge_of

                def gauge(direction: Tensor, now: Rows) -> tuple[Tensor, Tensor]:
                    return (gauge_of if now == rows else call(now)._gauge_of)(direction)

                result._gauge_of = lambda direction: self._attempt(obs, partial(gauge, direction))[0]
            return result

        return guarded

    def _attempt(self, obs: Tensor, call: Callable[[Rows], Any]) -> tuple[Any, Rows]:
        """Run `call`, refusing seeds until it succeeds. Return its result and the rows that it used."""
        while True:
            rows = self._rows(obs)
            try:
                return call(rows), rows
            except ConstraintError as error:
                self._refuse(error, obs, rows)

    def _rows(self, obs: Tensor) -> Rows:
        """For each row of `obs`, the row to use in its place: itself, or a sound one if its seed is refused."""
        if not self.refused or not self._has_seeds(obs):
            return None
        sound = [k for k, position in enumerate(self.positions) if position not in self.refused]
        return [k if k in sound else sound[0] for k in range(len(self.positions))] if sound else None

    def _refuse(self, error: ConstraintError, obs: Tensor, rows: Rows) -> None:
        """Refuse the seed that caused `error` in a call that used the rows `rows` of `obs`.

        Raises the error if it names no seed or if no seed is left.
        """
        lead = obs.shape[:-1]
        if error.sample is None or len(error.sample) < len(lead) or not self._has_seeds(obs):
            raise error
        # The batch may have more leading dimensions than the observations, which broadcast along them.
        first, *others = error.sample[len(error.sample) - len(lead) :]
        row = first if rows is None else rows[first]
        self.refused[self.positions[row]] = refusal(error, obs[(row, *others)])
        if all(position in self.refused for position in self.positions):
            raise error

    def _has_seeds(self, obs: Tensor) -> bool:
        return obs.dim() > 1 and obs.shape[0] == len(self.positions)


def replace_methods(constraint: Constraint, wrap: Callable[[str, Callable], Callable]) -> Constraint:
    """A copy of `constraint` in which `wrap(name, method)` replaces each public method that takes observations."""
    changed = copy.copy(constraint)
    for name, function in inspect.getmembers(type(constraint), inspect.isfunction):
        if not name.startswith("_") and "obs" in inspect.signature(function).parameters:
            setattr(changed, name, wrap(name, getattr(constraint, name)))
    return changed


def _call_with(rows: Sequence[int], method: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Call `method` with these rows of its observations and centres."""
    call = inspect.signature(method).bind(*args, **kwargs)
    obs, center = call.arguments["obs"], call.arguments.get("center")
    call.arguments["obs"] = obs[list(rows)]
    if center is not None and center.shape[:-1] == obs.shape[:-1]:
        call.arguments["center"] = center[list(rows)]
    return method(*call.args, **call.kwargs)


def step_apart(step_together: StepTogether) -> StepTogether:
    """Wrap `step_together` to return a ConstraintError as the outcome of the environment that caused it.

    After such an error it steps each environment alone. The error is raised before any environment steps.
    """

    def step(envs: Sequence[Any], actions: Any) -> Sequence[Any]:
        try:
            return step_together(envs, actions)
        except ConstraintError:
            outcomes: list[Any] = []
            for env, action in zip(envs, actions, strict=True):
                try:
                    outcomes += step_together([env], action[None])
                except ConstraintError as error:
                    outcomes.append(error)
            return outcomes

    return step
