"""Checks of coefficients that are functions of the observation, and of the arguments of methods."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from constraints.errors import ConstraintError, name_samples, require

ON_BOUNDARY = 1e-12
"""A centre closer than this to the boundary counts as lying on it."""
ROUNDING = 1e-7
"""Largest change of a coordinate of a centre in the box when it is rounded to float32."""
_SAME = 1e-4
"""Relative tolerance, for float32, between values of a function in a batch and for one observation alone."""
# Asymmetry and negative eigenvalues of a matrix up to this share of its largest entry count as rounding of float32.
_ROUNDING = 1e-6


def check_tensor(what: str, value: Any) -> None:
    """Raise a TypeError if the value is not a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{what} must be a torch.Tensor, got {type(value).__name__}; torch.as_tensor({what}) makes one")


def check_precision(what: str, value: Tensor) -> None:
    """Raise a TypeError for a tensor that is not float32 or float64. Half precision rounds points out of their set."""
    if value.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"expected float32 or float64 {what}, got {value.dtype}")


def check_observation(obs: Any) -> None:
    """Raise a TypeError if `obs`, whose dtype results get, is not a tensor of float32 or float64."""
    check_tensor("obs", obs)
    check_precision("observations", obs)


def check_function(what: str, value: Any) -> None:
    """Raise a TypeError if the value is not a function."""
    if not callable(value):
        raise TypeError(f"{what} must be a function of the observation, got {type(value).__name__}")


def checked(values: Tensor | float, what: str, shape: tuple[int, ...], obs: Tensor, finite: bool = True) -> Tensor:
    """Coefficients as float64 (*lead, *shape), finite and of the expected shape, or a ConstraintError.

    -1 in `shape` stands for any size; lead may be the observation's leading shape or one that broadcasts to it. With
    `finite` False, the values are not read, so NaN and infinite ones pass.
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


@torch.no_grad()
def check_each_alone(function: Callable[[Tensor], Any], values: Tensor, what: str, axes: int, obs: Tensor) -> None:
    """Raise a ConstraintError if `values`, of the batch `obs`, differ from what `function` returns for one observation.

    A function written for single observations can seem to work on a batch: rows (d,) of n observations look like n rows
    for each observation. `axes` is the number of axes of the values of one observation.
    """
    lead = obs.shape[:-1]
    one = obs[(slice(-1, None),) * len(lead)]
    try:
        alone = checked(function(one), what, (-1,) * axes, one, finite=False)
    except (ValueError, RuntimeError, IndexError):
        return  # it returns the coefficients of a fixed batch, whatever the observation

    def last_of(values: Tensor, lead: torch.Size) -> Tensor:
        return values.expand(*lead, *values.shape[values.dim() - axes :])[(-1,) * len(lead)]

    last, single = last_of(values, lead), last_of(alone, one.shape[:-1])
    if last.shape != single.shape or not torch.allclose(last, single, _SAME, _SAME * float(last.abs().sum())):
        raise ConstraintError(
            f"{what} of an observation depends on the others in its batch: it has shape {tuple(values.shape)} for"
            f" observations {tuple(obs.shape)} and {tuple(alone.shape)} for one of them; it must treat each separately"
        )


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
