"""Several constraints at once."""

from __future__ import annotations

import torch
from torch import Tensor

from constraints.base import Constraint, ExplicitSet
from constraints.errors import name_samples, require
from constraints.general.base import ON_BOUNDARY, GeneralConstraint, check_obs


class Intersection(GeneralConstraint):
    """The actions that all of `constraints` allow.

    Each is a constraint of this package, a user's own with `explicit`, or another intersection; ValueError for none, or
    for different dimensions. `penalty` is the sum of their penalties, `violation` the largest violation. `center` is
    that of a LinearConstraint if all are linear. With an ellipse it is the origin where that is interior, otherwise the
    point deepest in the set, and a mean of both where the origin is near the boundary. Methods raise a ConstraintError
    as those of LinearConstraint and QuadraticConstraint do.
    """

    def __init__(self, *constraints: Constraint):
        if not constraints:
            raise ValueError("an intersection needs at least one constraint")
        dims = {constraint.dim for constraint in constraints}
        if len(dims) > 1:
            raise ValueError(f"constraints of different dimensions: {sorted(dims)}")
        super().__init__(dims.pop())
        self.constraints = constraints

    def explicit(self, obs: Tensor) -> ExplicitSet:
        check_obs(obs)
        parts = [constraint.explicit(obs) for constraint in self.constraints]
        leads = [lead for part in parts for lead in (part.rows.shape[:-2], part.bounds.shape[:-1])]
        lead = torch.broadcast_shapes(*leads)
        rows = torch.cat([part.rows.expand(*lead, *part.rows.shape[-2:]) for part in parts], -2)
        bounds = torch.cat([part.bounds.expand(*lead, part.bounds.shape[-1]) for part in parts], -1)
        return ExplicitSet(rows, bounds, [ellipse for part in parts for ellipse in part.ellipses])

    def _violation(self, obs: Tensor, action: Tensor) -> Tensor:
        check_obs(obs)
        excess = [constraint._violation(constraint._at(obs), action) for constraint in self.constraints]
        return torch.stack(torch.broadcast_tensors(*excess)).amax(0)

    def _penalty(self, obs: Tensor, action: Tensor) -> Tensor:
        check_obs(obs)
        return sum(
            (constraint._penalty(constraint._at(obs), action) for constraint in self.constraints), 0.0 * action.sum(-1)
        )

    def _gauge_gradients(self, obs: Tensor, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        check_obs(obs)
        gradients = []
        for constraint in self.constraints:
            # The closed forms do not check the centre.
            if not isinstance(constraint, GeneralConstraint) and center is not None:
                inside = constraint._violation(constraint._at(obs), center) < -ON_BOUNDARY
                require(inside.flatten(), "the centre is not interior", name_samples(tuple(inside.shape)))
            gradients.append(constraint._gauge_and_gradient(constraint._at(obs), direction, center)[1])
        return gradients
