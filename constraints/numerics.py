"""Small numerical functions that all sets share."""

from __future__ import annotations

import torch
from torch import Tensor


def one_where_zero(norm: Tensor) -> Tensor:
    """The norm (...), and 1 where it is 0 or NaN, so that one can divide by it."""
    return torch.where(norm > 0.0, norm, 1.0)


def root_or_one(square: Tensor) -> Tensor:
    """sqrt (...), and 1 where the square is 0 or NaN, so that one can divide by it; its gradient there is 0."""
    return torch.where(square > 0.0, square, 1.0).sqrt()


def safe_sqrt(square: Tensor) -> Tensor:
    """sqrt with gradient 0 at 0."""
    positive = square > 0.0
    return torch.where(positive, torch.where(positive, square, 1.0).sqrt(), square)


def keep_nan(solution: Tensor, source: Tensor) -> Tensor:
    """The solution (..., d), all NaN where the source (..., d) has a NaN."""
    return torch.where(source.isnan().any(-1, keepdim=True), torch.nan, solution)


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Product (..., m) of matrices (..., m, d) with vectors (..., d)."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def is_transformed() -> bool:
    """Whether a transform of torch.func is active, so that tensors may have hidden axes."""
    return torch._C._are_functorch_transforms_active()


def is_mapped() -> bool:
    """Whether torch.func.vmap is active, so that values of tensors cannot be read."""
    if not is_transformed():
        return False
    functorch = torch._C._functorch
    return any(level.key() == functorch.TransformType.Vmap for level in functorch.get_interpreter_stack() or ())


def refuse_transforms(what: str) -> None:
    """Raise a RuntimeError if a transform of torch.func is active."""
    if is_transformed():
        raise RuntimeError(
            f"{what} does not support torch.func transforms; it takes batches of any leading shape without them"
        )


def is_traced(*values: object) -> bool:
    """Whether autograd records operations on one of the values, or a transform of torch.func is active."""
    return is_transformed() or (
        torch.is_grad_enabled() and any(isinstance(value, Tensor) and value.requires_grad for value in values)
    )


def refuse_second_derivatives() -> None:
    """Raise a RuntimeError under `create_graph=True`. A backward whose gradient is a closed form calls this first."""
    # PyTorch's once_differentiable would return zeros instead: the saved tensors carry no graph.
    if torch.is_grad_enabled():
        raise RuntimeError("projections, maps and their log-densities have first derivatives only")


class _WithGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, argument: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return value.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        return grad.unsqueeze(-1) * ctx.saved_tensors[0], None, None


def with_gradient(argument: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
    """The `value` (...) as a function of `argument` (..., d) with the derivative `gradient` (..., d)."""
    return _WithGradient.apply(argument, value.detach(), gradient.detach())
