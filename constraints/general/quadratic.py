"""An ellipse of your own: (a - c(obs))' Q(obs) (a - c(obs)) <= bound(obs) in the box."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from constraints.base import Ellipse, ExplicitSet, OnEmpty
from constraints.checks import ON_BOUNDARY, check_function, check_semidefinite
from constraints.ellipse import ellipse_excess, ellipse_gauge_gradient
from constraints.errors import name_samples, require
from constraints.general.base import At, GeneralConstraint, check_obs
from constraints.numerics import times

Coefficient = Callable[[Tensor], Tensor]


class QuadraticConstraint(GeneralConstraint):
    """(a - c(obs))' Q(obs) (a - c(obs)) <= bound(obs) in the box [-1, 1]^dim, Q positive semi-definite, bound > 0.

    Pass Q, bound (a function or a number) and c (default: the origin), or override them in a subclass; if Q or bound is
    missing, its first use raises a TypeError. `center` is c if that is well inside the box. If c is outside, it is the
    point nearest to c among those at least 0.9 times as deep in the set as the deepest; if c is near the box's
    boundary, it is a mean of both. It is continuous in the coefficients.

    Methods raise a ConstraintError that names the sample for NaN or infinite observations or coefficients, wrong
    shapes, a Q that is not positive semi-definite, a bound that is not positive, and an empty set. A set has no
    interior if it is nowhere deeper than 1e-9. `center` and methods that need a centre then raise the error; `project`
    and `linear_oracle` raise it only if the multipliers are not unique.
    """

    def __init__(
        self,
        dim: int,
        Q: Coefficient | None = None,
        bound: Coefficient | float | None = None,
        c: Coefficient | None = None,
        on_empty: OnEmpty = "error",
    ):
        super().__init__(dim, on_empty)
        for what, function in (("Q", Q), ("c", c)):
            if function is not None:
                check_function(what, function)
        self._Q, self._bound, self._c = Q, bound, c

    def Q(self, obs: Tensor) -> Tensor:
        """Matrix (..., d, d), symmetric positive semi-definite, at obs (..., n), which is float64."""
        if self._Q is None:
            raise TypeError(f"{type(self).__name__} needs Q(obs): pass Q, or override it")
        return self._Q(obs)

    def bound(self, obs: Tensor) -> Tensor | float:
        """Bound (...) or a number, positive."""
        if self._bound is None:
            raise TypeError(f"{type(self).__name__} needs bound(obs): pass bound, or override it")
        return self._bound(obs) if callable(self._bound) else self._bound

    def c(self, obs: Tensor) -> Tensor:
        """Centre (..., d) of the ellipse."""
        return obs.new_zeros(self.dim) if self._c is None else self._c(obs)

    def explicit(self, obs: Tensor) -> ExplicitSet:
        return self._coefficients(obs).written

    def _coefficients(self, obs: Tensor) -> At:
        ellipse = self._ellipse(obs)
        written = ExplicitSet(obs.new_zeros(0, self.dim), obs.new_zeros(0), [Ellipse(*ellipse)])
        return At(obs, list(ellipse), lambda: written)

    def _ellipse(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Q, c and the bound, checked."""
        check_obs(obs)
        matrix = self._values(self.Q, "Q(obs)", (self.dim, self.dim), obs)
        center = self._values(self.c, "c(obs)", (self.dim,), obs)
        bound = self._values(self.bound, "bound(obs)", (), obs)
        least = check_semidefinite(matrix.detach(), "Q(obs)")
        matrix = 0.5 * (matrix + matrix.mT)
        matrix = matrix + (-least).clamp(min=0.0)[..., None, None] * torch.eye(
            self.dim, dtype=matrix.dtype, device=matrix.device
        )
        require((bound > 0.0).flatten(), "bound(obs) is not positive", name_samples(tuple(bound.shape)))
        return matrix, center, bound

    def _violation(self, at: At | Tensor, action: Tensor) -> Tensor:
        matrix, center, bound = self.at(at)
        offset = action - center
        value = (offset * times(matrix, offset)).sum(-1)
        return ellipse_excess(value, matrix.diagonal(dim1=-2, dim2=-1).sum(-1), bound, self.dim)

    def _part_gauges(self, at: At, direction: Tensor, center: Tensor | None) -> list[Tensor]:
        matrix, middle, bound = at
        offset = (-middle if center is None else center - middle).expand_as(direction)
        bent = times(matrix, offset)
        inside = (bent * offset).sum(-1) < bound * (1.0 - ON_BOUNDARY)
        require(inside.flatten(), "the centre is not inside the ellipse", name_samples(tuple(inside.shape)))
        return [ellipse_gauge_gradient(direction, times(matrix, direction), offset, bent, bound.unsqueeze(-1))]
