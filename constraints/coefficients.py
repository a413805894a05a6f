"""The coefficients of the closed forms: functions of the observation, and bounds that may be numbers.

They are checked in the first calls only, because a check takes as long as a closed form. `check_inputs(True)` checks
them in every call.
"""

from __future__ import annotations

import numbers
from collections.abc import Callable

import torch
from torch import Tensor

from constraints.checks import check_each_alone, check_function, check_tensor, checked
from constraints.errors import ConstraintError, check_bound, name_samples, require
from constraints.numerics import is_transformed

Coefficients = Callable[[Tensor], Tensor]
"""Maps observations (..., n) to a constraint's state-dependent coefficients (..., d) or (..., d, d)."""
Bound = float | Coefficients
"""A positive number, or a function from observations (..., n) to positive numbers (...)."""

_FIRST = 100  # the number of calls that are checked
_always = False


def check_inputs(always: bool = True) -> bool:
    """Make the closed forms check coefficients and given centres in every call, not only in the first 100 of each.

    This holds for all of them in the process. They raise a ConstraintError for values that are NaN, infinite or of the
    wrong sign or shape, for a matrix that is not symmetric and positive semi-definite, and for a centre that is not
    inside the set. General sets always check them. On a GPU, each check waits for the device, so a CUDA graph cannot
    contain it. Returns the previous value of `always`.
    """
    global _always
    before, _always = _always, always
    return before


class FirstCalls:
    """Decides what to check: shapes in the first `_FIRST` calls, and on the CPU values as well.

    With `check_inputs`, it is both in every call on every device.
    """

    def __init__(self) -> None:
        self._left = _FIRST

    def wanted(self) -> bool:
        """Whether to check shapes in this call, and values if `readable` allows it."""
        # torch.compile would recompile for each number of calls.
        return (self._left > 0 and not torch.compiler.is_compiling()) or _always

    def readable(self, *values: Tensor) -> bool:
        """Count this call, and return whether to check its values."""
        self._left -= 1
        return (
            all(value.is_cpu or (_always and value.device.type != "meta") for value in values) and not is_transformed()
        )


class Coefficient:
    """A function of the observation with values (..., *shape), which `check` may test further.

    A ConstraintError names the coefficient by `what` and, for wrong values, the sample. If any observation of the batch
    is not finite, no values of this call are checked; NaN is passed on.
    """

    def __init__(
        self,
        what: str,
        function: Coefficients,
        shape: tuple[int, ...],
        check: Callable[[Tensor, str], object] | None = None,
    ):
        check_function(what, function)
        self._what, self._function, self._shape, self._check = f"{what}(obs)", function, shape, check
        self._calls, self._compared = FirstCalls(), False

    def __call__(self, obs: Tensor) -> Tensor:
        """The values (..., *shape), float64, at obs (..., n)."""
        values = self._function(obs)
        if self._calls.wanted():
            values = self._checked(values, obs)
        return values.double()

    def _checked(self, values: Tensor, obs: Tensor) -> Tensor:
        check_tensor(self._what, values)
        if values.is_complex():
            raise ConstraintError(f"{self._what} is complex")
        look = self._calls.readable(obs) and bool(obs.isfinite().all())
        values = checked(values, self._what, self._shape, obs, finite=look)
        if look and self._check is not None:
            self._check(values, self._what)
        if look and not self._compared and obs.shape[:-1].numel() > 1:
            self._compared = True
            check_each_alone(self._function, values, self._what, len(self._shape), obs)
        return values


class BoundCoefficient:
    """A bound that broadcasts against (..., 1). ValueError for a number that is not positive and finite."""

    def __init__(self, what: str, bound: Bound):
        self._number: float | None = None
        if callable(bound):
            self._values = Coefficient(what, bound, (), check_positive)
        else:
            if not isinstance(bound, numbers.Real):
                raise TypeError(f"{what} must be a number or a function of the observation, got {type(bound).__name__}")
            check_bound(bound)
            self._number = float(bound)

    def __call__(self, obs: Tensor) -> Tensor | float:
        """The number, or the function's values (..., 1) at obs (..., n)."""
        return self._values(obs).unsqueeze(-1) if self._number is None else self._number


def check_positive(values: Tensor, what: str) -> None:
    """Raise a ConstraintError for values (...) that are not positive."""
    require((values > 0.0).flatten(), f"{what} is not positive", name_samples(tuple(values.shape)))


def check_not_negative(values: Tensor, what: str) -> None:
    """Raise a ConstraintError for values (..., d) that are negative."""
    valid = (values >= 0.0).all(-1)
    require(valid.flatten(), f"{what} is negative", name_samples(tuple(valid.shape)))


def flat(bound: Tensor | float) -> Tensor | float:
    """A bound without its last axis: (..., 1) -> (...)."""
    return bound.squeeze(-1) if isinstance(bound, Tensor) else bound
