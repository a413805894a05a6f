"""Observations at which a constraint breaks down, as where its set is empty: each ends its own seed, not the others."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any

import torch
from torch import Tensor

from constraints import Constraint, ConstraintError
from constraints.ray import Ray
from core.evaluation import StepTogether, refusal


class Guard:
    """Keeps a ConstraintError that names a sample from the seeds that the sample does not belong to.

    `constraint` is a copy of the given one. A method of it that cannot handle a seed's observations takes another
    seed's in their place, and `refused` says why: position of the seed -> reason. The results of that seed mean
    nothing from there on; those of the others are what they are without it. The first axis of the observations must be
    that of the seeds. Any other error, and one that leaves no seed, is raised.
    """

    def __init__(self, constraint: Constraint, seeds: int):
        self.positions: Sequence[int] = range(seeds)  # of the seeds on the first axis
        self.refused: dict[int, str] = {}
        self.constraint = copy.copy(constraint)
        for name, function in inspect.getmembers(type(constraint), inspect.isfunction):
            if not name.startswith("_") and "obs" in inspect.signature(function).parameters:
                setattr(self.constraint, name, self._guarded(getattr(constraint, name)))

    @contextmanager
    def of(self, which: Sequence[int]) -> Iterator[dict[int, str]]:
        """In the block, the first axis is that of the seeds `which`. Gives what is refused there, at first nothing."""
        before = self.positions, self.refused
        self.positions, self.refused = which, {}
        try:
            yield self.refused
        finally:
            self.positions, self.refused = before

    def apart(self, policy: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
        """`policy`, obs (seeds, m, n) -> actions (seeds, m, d), with NaN for refused seeds: they execute nothing."""

        def act(obs: Tensor) -> Tensor:
            try:
                actions = policy(obs)
            except ConstraintError:
                if any(position not in self.refused for position in self.positions):  # it is about no single seed
                    raise
                return obs.new_full((*obs.shape[:-1], self.constraint.dim), torch.nan)
            refused = [k for k, position in enumerate(self.positions) if position in self.refused]
            if refused:
                actions[refused] = torch.nan
            return actions

        return act

    def _guarded(self, method: Callable) -> Callable:
        @wraps(method)
        def guarded(*args: Any, **kwargs: Any) -> Any:
            result, rows = self._call(method, args, kwargs)
            if isinstance(result, Ray):
                result._gauge_of = self._guarded_gauge(result, rows, method, args, kwargs)
            return result

        return guarded

    def _guarded_gauge(self, ray: Ray, rows: Sequence[int], method: Callable, args: tuple, kwargs: dict) -> Callable:
        """A ray asks for its gauge later. This guards that as well."""
        gauge_of = ray._gauge_of

        def guarded(direction: Tensor) -> tuple[Tensor, Tensor]:
            ask, stand_in = gauge_of, rows
            while True:
                try:
                    return ask(direction)
                except ConstraintError as error:
                    self._refuse(error, _arguments(method, args, kwargs).arguments["obs"], stand_in)
                    again, stand_in = self._call(method, args, kwargs)
                    ask = again._gauge_of

        return guarded

    def _call(self, method: Callable, args: tuple, kwargs: dict[str, Any]) -> tuple[Any, Sequence[int]]:
        """The result of `method`, and which rows' observations and centres have stood in the place of each row's."""
        while True:
            rows: Sequence[int] = range(len(self.positions))
            call = _arguments(method, args, kwargs) if self.refused else None
            if call is not None and self._has_seeds(obs := call.arguments["obs"]):
                sound = [k for k in rows if self.positions[k] not in self.refused]
                rows = [k if k in sound else sound[0] for k in rows] if sound else rows
                call.arguments["obs"], center = obs[list(rows)], call.arguments.get("center")
                if center is not None and center.shape[:-1] == obs.shape[:-1]:
                    call.arguments["center"] = center[list(rows)]
            try:
                return (method(*args, **kwargs) if call is None else method(*call.args, **call.kwargs)), rows
            except ConstraintError as error:
                self._refuse(error, _arguments(method, args, kwargs).arguments["obs"], rows)

    def _refuse(self, error: ConstraintError, obs: Tensor, rows: Sequence[int]) -> None:
        """Note the seed that `error` is about, if the observations of `rows` have stood in the place of `obs`.

        Raises the error where it names no seed, and where no seed is left.
        """
        lead = obs.shape[:-1]
        if error.sample is None or len(error.sample) < len(lead) or not self._has_seeds(obs):
            raise error
        # The batch may have more leading dimensions than the observations, which repeat along those.
        first, *others = error.sample[len(error.sample) - len(lead) :]
        index = (rows[first], *others)
        self.refused[self.positions[rows[first]]] = refusal(error, obs[index])
        if all(position in self.refused for position in self.positions):
            raise error

    def _has_seeds(self, obs: Tensor) -> bool:
        return obs.dim() > 1 and obs.shape[0] == len(self.positions)


def _arguments(method: Callable, args: tuple, kwargs: dict[str, Any]) -> inspect.BoundArguments:
    """The arguments of a call by their names."""
    return inspect.signature(method).bind(*args, **kwargs)


def step_apart(step_together: StepTogether) -> StepTogether:
    """`step_together` that returns a ConstraintError as the outcome of the environment that it is about.

    It then steps each environment alone, because the error has come before any step.
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
