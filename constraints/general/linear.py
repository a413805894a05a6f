"""Linear constraints of your own: A(obs) a <= b(obs) in the box, with any number of rows."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from constraints.base import ExplicitSet, OnEmpty
from constraints.checks import ON_BOUNDARY, check_function
from constraints.errors import name_samples, require
from constraints.general.base import At, GeneralConstraint, check_obs
from constraints.general.scaled_sets import unit_rows
from constraints.numerics import safe_sqrt, times


class LinearConstraint(GeneralConstraint):
    """A(obs) a <= b(obs) in the box [-1, 1]^dim.

    Pass A and b as functions, or override them in a subclass; if one is missing, its first use raises a TypeError.
    `center` is the point nearest to the origin among those at least 0.9 times as deep as the Chebyshev centre. It is
    unique, continuous in A and b, and 0 in coordinates that no row uses.

    Methods raise a ConstraintError for NaN or infinite observations or coefficients, wrong shapes and an empty set.
    `center` and methods that need a centre also raise it for a set without interior. The error names the sample and, if
    one row is the cause, the row.
    """

    def __init__(
        self,
        dim: int,
        A: Callable[[Tensor], Tensor] | None = None,
        b: Callable[[Tensor], Tensor] | None = None,
        on_empty: OnEmpty = "error",
    ):
        super().__init__(dim, on_empty)
        for what, function in (("A", A), ("b", b)):
            if function is not None:
                check_function(what, function)
        self._A, self._b = A, b

    def A(self, obs: Tensor) -> Tensor:
        """Rows (..., m, d), of any norm, at obs (..., n), which is float64. Methods scale them to unit norm."""
        if self._A is None:
            raise TypeError(f"{type(self).__name__} needs A(obs): pass A, or override it")
        return self._A(obs)

    def b(self, obs: Tensor) -> Tensor:
        """Bounds (..., m) of the rows at obs (..., n)."""
        if self._b is None:
            raise TypeError(f"{type(self).__name__} needs b(obs): pass b, or override it")
        return self._b(obs)

    def explicit(self, obs: Tensor) -> ExplicitSet:
        check_obs(obs)
        rows = self._values(self.A, "A(obs)", (-1, self.dim), obs)
        bounds = self._values(self.b, "b(obs)", (rows.shape[-2],), obs)
        return ExplicitSet(rows, bounds, [])

    def _coefficients(self, obs: Tensor) -> At:
        written = self.explicit(obs)
        return At(obs, [written.rows, written.bounds], lambda: written)

    def _excess(self, at: At | Tensor, action: Tensor) -> Tensor:
        """Ax - b (..., m) with unit rows."""
        written = self.at(at).written
        rows, bounds = unit_rows(written.rows, written.bounds)
        return times(rows, action) - bounds

    def _violation(self, at: At | Tensor, action: Tensor) -> Tensor:
        excess = self._excess(at, action)
        # There may be no rows.
        return torch.cat((excess, torch.full_like(action[..., :1], -torch.inf)), -1).amax(-1)

    def _penalty(self, at: At | Tensor, action: Tensor) -> Tensor:
        return safe_sqrt(self._excess(at, action).clamp(min=0.0).square().sum(-1))

    def _part_gauges(self, at: At, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        rows, bounds = unit_rows(at.written.rows, at.written.bounds)
        lead, m = direction.shape[:-1], rows.shape[-2]
        rows, slack = rows.expand(*lead, m, self.dim), bounds.expand(*lead, m)
        if m == 0:
            return []
        if center is not None:
            slack = slack - times(rows, center)
        # 0 <= 0 holds everywhere.
        vacuous = (rows == 0.0).all(-1) & (slack >= 0.0)
        inside = vacuous | (slack > ON_BOUNDARY)
        require(inside.reshape(-1, m), "the centre is not inside this row", name_samples(tuple(lead)))
        normals = rows / torch.where(vacuous, 1.0, slack).unsqueeze(-1)
        first = (normals @ direction.detach().unsqueeze(-1)).argmax(-2, keepdim=True)
        return [normals.take_along_dim(first, -2).squeeze(-2)]
