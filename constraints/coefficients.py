"""The coefficients of the closed forms: functions of the observation, and bounds that may be numbers."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from constraints.errors import check_bound

Coefficients = Callable[[Tensor], Tensor]
"""Maps observations (..., n) to a constraint's state-dependent coefficients (..., d) or (..., d, d)."""
Bound = float | Coefficients
"""A positive number, or a function from observations (..., n) to positive numbers (...)."""


class Coefficient:
    """A function of the observation, in float64."""

    def __init__(self, function: Coefficients):
        self._function = function

    def __call__(self, obs: Tensor) -> Tensor:
        """The coefficients (..., d) or (..., d, d) at obs (..., n)."""
        return self._function(obs).double()


class BoundCoefficient:
    """A bound, ready to be compared with (..., 1). ValueError for a number that is not positive and finite."""

    def __init__(self, bound: Bound):
        if not callable(bound):
            check_bound(bound)
        self._bound = bound

    def __call__(self, obs: Tensor) -> Tensor | float:
        """The number, or the function's values (..., 1) at obs (..., n)."""
        return self._bound(obs).double().unsqueeze(-1) if callable(self._bound) else self._bound


def flat(bound: Tensor | float) -> Tensor | float:
    """A bound without its last axis: (..., 1) -> (...)."""
    return bound.squeeze(-1) if isinstance(bound, Tensor) else bound
