"""A constraint on actions in the units of the robot, turned into one on normalised actions."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from constraints.base import Constraint, Ellipse, ExplicitSet
from constraints.general.base import At, GeneralConstraint
from constraints.general.intersection import Intersection
from constraints.general.linear import LinearConstraint
from constraints.general.quadratic import QuadraticConstraint


class InUnits(GeneralConstraint):
    """The normalised actions a in [-1, 1]^d for which `constraint` allows u = low + (a + 1) / 2 (high - low).

    `constraint` is in the units of u, such as newton metres. It must implement `explicit`, as LinearConstraint,
    QuadraticConstraint and Intersection do. Its own box [-1, 1]^d is ignored: the box of u is [low, high]. `low` and
    `high` are numbers or (d,), like the bounds of a `gymnasium.spaces.Box`; ValueError if they are not finite or low is
    not below high.

    Empty sets are handled as `constraint.on_empty` says. Violations and penalties are those of the rows and ellipses in
    a, each scaled as `Constraint.violation` says.
    """

    def __init__(self, constraint: Constraint, low: ArrayLike, high: ArrayLike):
        if not isinstance(constraint, Constraint):
            raise TypeError(f"constraint must be an instance of constraints.Constraint, got {constraint!r}")
        super().__init__(constraint.dim, constraint.on_empty)
        least, most = (np.asarray(bound, np.float64).reshape(-1) for bound in (low, high))
        if any(len(bound) not in (1, self.dim) for bound in (least, most)):
            raise ValueError(
                f"low and high must be numbers or have {self.dim} values, got {len(least)} and {len(most)}"
            )
        if not (np.isfinite(least).all() and np.isfinite(most).all() and (least < most).all()):
            raise ValueError(f"low must be below high, both finite, got {least.tolist()} and {most.tolist()}")
        self.constraint = constraint
        self.middle = np.broadcast_to((most + least) / 2.0, self.dim)
        self.half = np.broadcast_to((most - least) / 2.0, self.dim)

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return self._coefficients(obs).written

    def _coefficients(self, obs: Tensor) -> At:
        written = self._normalised(obs)
        rows, bounds, ellipses = written
        linear: list[Constraint] = [LinearConstraint(self.dim, lambda _: rows, lambda _: bounds)]
        # The set at just these observations, as the intersection of its rows and its ellipses.
        normalised = Intersection(*linear, *(_constant_ellipse(self.dim, ellipse) for ellipse in ellipses))
        at = normalised._coefficients(obs)
        return At(obs, list(at), lambda: written, (normalised, at))

    def _normalised(self, obs: Tensor) -> ExplicitSet:
        middle, half = obs.new_tensor(self.middle), obs.new_tensor(self.half)
        rows, bounds, ellipses = self.constraint.explicit(obs)
        scaled = [
            Ellipse(half.unsqueeze(-1) * ellipse.matrix * half, (ellipse.center - middle) / half, ellipse.bound)
            for ellipse in ellipses
        ]
        return ExplicitSet(rows * half, bounds - rows @ middle, scaled)

    def _violation(self, at: At | Tensor, action: Tensor) -> Tensor:
        normalised, own = self.at(at).parts
        return normalised._violation(own, action)

    def _penalty(self, at: At | Tensor, action: Tensor) -> Tensor:
        normalised, own = self.at(at).parts
        return normalised._penalty(own, action)

    def _part_gauges(self, at: At, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        normalised, own = at.parts
        return normalised._part_gauges(own, direction, center)


def _constant_ellipse(dim: int, ellipse: Ellipse) -> QuadraticConstraint:
    bound = torch.as_tensor(ellipse.bound, dtype=torch.float64, device=ellipse.matrix.device)
    return QuadraticConstraint(dim, lambda _: ellipse.matrix, lambda _: bound, lambda _: ellipse.center)
