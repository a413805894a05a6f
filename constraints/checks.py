"""Checks of what functions of the observation return, and of what methods are given."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from constraints.errors import ConstraintError, name_samples, require

ON_BOUNDARY = 1e-12
"""A centre that is nearer than this to the boundary is on it, up to rounding."""
# Asymmetry and negative eigenvalues of a matrix up to this share of its largest entry are rounding, in float32 too.
_ROUNDING = 1e-6


def check_tensor(what: str, value: Any) -> None:
    """Raise a TypeError for what is not a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{what} must be a torch.Tensor, got {type(value).__name__}; torch.as_tensor({what}) makes one")


def checked(values: Tensor | float, what: str, shape: tuple[int, ...], obs: Tensor, finite: bool = True) -> Tensor:
    """Coefficients as float64 (*lead, *shape), finite and of the expected shape, or a ConstraintError.

    -1 in `shape` stands for any size; lead may be the observation's leading shape or one that broadcasts to it. Values
    are looked at where they have to be `finite`.
    """
    values = torch.as_tensor(values, dtype=torch.float64, device=obs.device)
    lead = values.shape[: values.dim() - len(shape)]
    fits = len(values.shape) >= len(shape) and all(
        have == want or want == -1 for have, want in zip(values.shape[len(lead) :], shape, strict=True)
    )
    try:
        fits = fits and torch.broadcast_shapes(lead, obs.shape[:-1]) == obs.shape[:-1]
    except RuntimeError:
        fits = False
    if not fits:
        wanted = ", ".join(["..."] + ["m" if size == -1 else str(size) for size in shape])
        raise ConstraintError(
            f"{what} has shape {tuple(values.shape)}, expected ({wanted}) with ... = {tuple(obs.shape[:-1])}"
        )
    if not finite:
        return values
    valid = values.isfinite().flatten(len(lead)).all(-1) if shape else values.isfinite()
    require(valid.flatten(), f"{what} is NaN or infinite", name_samples(tuple(lead)))
    return values


def check_semidefinite(matrix: Tensor, what: str) -> Tensor:
    """Smallest eigenvalues (...) of matrices (..., d, d), or a ConstraintError.

    The matrices have to be symmetric and positive semi-definite; eigenvalues may be negative by rounding.
    """
    name = name_samples(tuple(matrix.shape[:-2]))
    largest = matrix.abs().flatten(-2).amax(-1)
    skew = (matrix - matrix.mT).abs().flatten(-2).amax(-1)
    require((skew <= _ROUNDING * largest).flatten(), f"{what} is not symmetric", name)
    least = torch.linalg.eigvalsh(0.5 * (matrix + matrix.mT))[..., 0]
    require((least >= -_ROUNDING * largest).flatten(), f"{what} is not positive semi-definite", name)
    return least
