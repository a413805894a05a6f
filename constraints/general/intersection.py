"""Several constraints at once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from constraints.base import Constraint, ExplicitSet, OnEmpty
from constraints.checks import ON_BOUNDARY
from constraints.errors import name_samples, require
from constraints.general.base import At, GeneralConstraint, check_obs
from constraints.implicit import tensors_of


class Intersection(GeneralConstraint):
    """The actions that all of `constraints` allow.

    Each is a constraint of this package, your own class with `explicit`, or another intersection. ValueError if there
    is none, or for different dimensions. `penalty` is the sum of their penalties, `violation` their largest violation.

    `center` is continuous in the coefficients. If all parts are linear, it is the centre of a LinearConstraint with all
    their rows. With an ellipse, it is the origin if that is well inside the set. Otherwise it is the point nearest to
    the origin among those at least 0.9 times as deep as the deepest, or a mean of both if the origin is near the
    boundary. (For a single ellipse without rows, its centre takes the origin's place.)

    Methods raise the ConstraintErrors of LinearConstraint and QuadraticConstraint. `on_empty` applies to the whole set;
    the `on_empty` of a part is ignored.
    """

    def __init__(self, *constraints: Constraint, on_empty: OnEmpty = "error"):
        wrong = next((part for part in constraints if not isinstance(part, Constraint)), None)
        if wrong is not None:
            hint = "; pass them one by one: Intersection(a, b)" if isinstance(wrong, list | tuple) else ""
            raise TypeError(f"Intersection takes constraints, got {type(wrong).__name__}{hint}")
        if not constraints:
            raise ValueError("an intersection needs at least one constraint")
        dims = {constraint.dim for constraint in constraints}
        if len(dims) > 1:
            raise ValueError(f"the constraints have different dimensions: {sorted(dims)}")
        super().__init__(dims.pop(), on_empty)
        self.constraints = constraints

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return self._coefficients(obs).written

    def _coefficients(self, obs: Tensor) -> At:
        check_obs(obs)
        parts = tuple(constraint._at(obs) for constraint in self.constraints)
        tensors = [tensor for part in parts for tensor in tensors_of(part)]
        return At(obs, tensors, lambda: self._write(obs, parts), parts)

    def _write(self, obs: Tensor, at: tuple[Any, ...]) -> ExplicitSet:
        parts = [
            part.written if isinstance(part, At) else constraint.explicit(obs)
            for constraint, part in zip(self.constraints, at, strict=True)
        ]
        leads = [lead for part in parts for lead in (part.rows.shape[:-2], part.bounds.shape[:-1])]
        lead = torch.broadcast_shapes(*leads)
        rows = torch.cat([part.rows.expand(*lead, *part.rows.shape[-2:]) for part in parts], -2)
        bounds = torch.cat([part.bounds.expand(*lead, part.bounds.shape[-1]) for part in parts], -1)
        return ExplicitSet(rows, bounds, [ellipse for part in parts for ellipse in part.ellipses])

    def _violation(self, at: At | Tensor, action: Tensor) -> Tensor:
        excess = [part._violation(own, action) for part, own in self._parts(at)]
        return torch.stack(torch.broadcast_tensors(*excess)).amax(0)

    def _penalty(self, at: At | Tensor, action: Tensor) -> Tensor:
        return sum((part._penalty(own, action) for part, own in self._parts(at)), 0.0 * action.sum(-1))

    def _part_gauges(self, at: At, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        gradients = []
        for part, own in self._parts(at):
            # The closed forms do not check the centre.
            if not isinstance(part, GeneralConstraint) and center is not None:
                inside = part._violation(own, center) < -ON_BOUNDARY
                require(inside.flatten(), "the centre is not inside the set", name_samples(tuple(inside.shape)))
            gradients.append(part._gauge_and_gradient(own, direction, center)[1])
        return gradients

    def _parts(self, at: At | Tensor) -> Iterator[tuple[Constraint, Any]]:
        """Each constraint with its coefficients."""
        return zip(self.constraints, self.at(at).parts, strict=True)
