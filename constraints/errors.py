"""Errors for feasible sets that are ill-posed, empty or without interior."""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor

SampleName = Callable[[int], str]
"""Names a sample of a flattened batch, as in 'sample 3' or 'sample (1, 2)'."""


class ConstraintError(ValueError):
    """An operation that the constraint's coefficients, its observation or the set itself do not allow."""


def name_samples(lead: tuple[int, ...]) -> SampleName:
    """Names for a batch of shape `lead`."""

    def name(index: int) -> str:
        position: list[int] = []
        for size in reversed(lead):
            index, last = divmod(index, size)
            position.insert(0, last)
        if not position:
            return "the only sample"
        return f"sample {position[0] if len(position) == 1 else tuple(position)}"

    return name


def check_bound(bound: float) -> None:
    """Raise a ValueError for a bound that is not positive and finite."""
    if not 0.0 < bound < math.inf:
        raise ValueError(f"bound must be positive for the origin to be interior, and finite, got {bound}")


def require(valid: Tensor, message: str, name: SampleName) -> None:
    """Raise a ConstraintError that names the first sample where `valid` (n,), or (n, m) over rows, is False."""
    if bool(valid.all()):
        return
    first = (~valid).nonzero()[0].tolist()
    row = f", row {first[1]}" if len(first) > 1 else ""
    raise ConstraintError(f"{name(first[0])}{row}: {message}")
