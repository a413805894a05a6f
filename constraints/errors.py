"""Errors for feasible sets that are ill-posed, empty or without interior."""

from __future__ import annotations

import math

from torch import Tensor


class SampleName:
    """Names a sample of a flattened batch of shape `lead`, as in 'sample 3' or 'sample (1, 2)'.

    With `chosen`, it numbers a selection of these samples: sample i is sample chosen[i] of the batch.
    """

    def __init__(self, lead: tuple[int, ...], chosen: list[int] | None = None):
        self._lead, self._chosen = lead, chosen

    def __call__(self, index: int) -> str:
        position = self.position(index)
        if not position:
            return "the only sample"
        return f"sample {position[0] if len(position) == 1 else position}"

    def position(self, index: int) -> tuple[int, ...]:
        """The sample's index in each leading dimension."""
        index = index if self._chosen is None else self._chosen[index]
        position: list[int] = []
        for size in reversed(self._lead):
            index, last = divmod(index, size)
            position.insert(0, last)
        return tuple(position)

    def part(self, chosen: list[int]) -> SampleName:
        """Names for the samples `chosen` of this batch."""
        return SampleName(self._lead, chosen if self._chosen is None else [self._chosen[i] for i in chosen])


class ConstraintError(ValueError):
    """The constraint's coefficients, the observation or the set itself do not allow an operation.

    `sample` is the position of the sample that caused the error: a tuple with an index for each leading dimension of
    the method's observation, empty for a single observation. It is None if no single sample is the cause.
    """

    def __init__(self, message: str, sample: tuple[int, ...] | None = None):
        super().__init__(message)
        self.sample = sample

    def __reduce__(self):  # so that a pickled copy for another process keeps the sample
        return type(self), (str(self), self.sample)


class EmptySetError(ConstraintError):
    """The set of one sample is empty, or has no interior although a method needs one."""


def name_samples(lead: tuple[int, ...]) -> SampleName:
    """Names for a batch of shape `lead`."""
    return SampleName(lead)


def check_bound(bound: float) -> None:
    """Raise a ValueError for a bound that is not positive and finite."""
    if not 0.0 < bound < math.inf:
        raise ValueError(f"bound must be positive (the origin must be interior) and finite, got {bound}")


def require(valid: Tensor, message: str, name: SampleName, error: type[ConstraintError] = ConstraintError) -> None:
    """Raise an error that names the first sample where `valid` (n,), or (n, m) over rows, is False."""
    if bool(valid.all()):
        return
    first = (~valid).nonzero()[0].tolist()
    row = f", row {first[1]}" if len(first) > 1 else ""
    raise error(f"{name(first[0])}{row}: {message}", name.position(first[0]))
