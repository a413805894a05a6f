"""Errors for feasible sets that are ill-posed, empty or without interior."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor


class ConstraintError(ValueError):
    """An operation that the constraint's coefficients, its observation or the set itself do not allow.

    Attributes: `index`, the position of the (first) sample that it is about in the leading dimensions of the
    observations; None where it is about no single sample.
    """

    def __init__(self, message: str, index: tuple[int, ...] | None = None):
        super().__init__(message)
        self.index = index


class SampleName:
    """Names the samples of a flattened batch of shape `lead`, as in 'sample 3' or 'sample (1, 2)'.

    `chosen` are those of them that there are; None for all.
    """

    def __init__(self, lead: tuple[int, ...], chosen: Sequence[int] | None = None):
        self.lead, self.chosen = lead, chosen

    def __call__(self, index: int) -> str:
        position = self.position(index)
        if not position:
            return "the only sample"
        return f"sample {position[0] if len(position) == 1 else position}"

    def position(self, index: int) -> tuple[int, ...]:
        """The position in the batch of shape `lead` of the sample number `index`."""
        if self.chosen is not None:
            index = self.chosen[index]
        position: list[int] = []
        for size in reversed(self.lead):
            index, last = divmod(index, size)
            position.insert(0, last)
        return tuple(position)

    def of(self, chosen: Sequence[int]) -> SampleName:
        """Names of the samples number `chosen` of these."""
        return SampleName(self.lead, [i if self.chosen is None else self.chosen[i] for i in chosen])


def name_samples(lead: tuple[int, ...]) -> SampleName:
    """Names for a batch of shape `lead`."""
    return SampleName(lead)


def check_bound(bound: float) -> None:
    """Raise a ValueError for a bound that is not positive."""
    if bound <= 0.0:
        raise ValueError(f"bound must be positive for the origin to be interior, got {bound}")


def require(valid: Tensor, message: str, name: SampleName) -> None:
    """Raise a ConstraintError that names the first sample where `valid` (n,), or (n, m) over rows, is False."""
    if bool(valid.all()):
        return
    first = (~valid).nonzero()[0].tolist()
    row = f", row {first[1]}" if len(first) > 1 else ""
    raise ConstraintError(f"{name(first[0])}{row}: {message}", name.position(first[0]))
