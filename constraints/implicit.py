"""Gradients of projections with respect to the action and to the coefficients of the set, by its KKT conditions.

Let a be the projection of x, with multipliers lam on the active surfaces g_j = 0. In the coordinates that neither the
box nor a kink holds, a - x + sum lam_j grad g_j = 0 and g_j = 0. These equations define a as a function of x and of all
that g depends on. To differentiate them, let v be the gradient of a loss with respect to a, and solve the transposed
system for p and w:

    p + sum lam_j hess g_j p + sum w_j grad g_j = v,    grad g_j . p = 0.

Then p is the gradient with respect to x, and -sum (lam_j grad g_j . p + w_j g_j), differentiated with p, w, lam and a
held fixed, is the gradient with respect to the coefficients. p is the closed form of `constraints.jacobian`.

The backward passes here solve the projection again. The usual case, gradients with respect to the action alone, does
not use them: it keeps the Jacobian of the solution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from constraints.jacobian import JacobianProduct
from constraints.numerics import one_where_zero, root_or_one

_ACTIVE = 1e-7  # a surface is active at points whose value g is above minus this
_DEPENDENT = 1e-10  # squared sines of angles between normals below this are 0 up to rounding


class Boundary(NamedTuple):
    """A surface g = 0, smooth at a point. Both fields are differentiable in the point and the coefficients."""

    value: Tensor  # (...) g, at most 0 inside and of order 1 there
    normal: Tensor  # (..., d) gradient of g


class Solver(NamedTuple):
    """The projection on a set, as a function of an action and of the set's coefficients `at`."""

    project: Callable[[Any, Tensor], tuple[Tensor, JacobianProduct]]
    boundaries: Callable[[Any, Tensor], list[Boundary]]
    """The surfaces, without those of the box, that can be active at a projection (..., d)."""
    free: Callable[[Tensor], Tensor]
    """Mask (..., d) of the coordinates of a point that neither the box nor a kink holds."""


def tensors_of(at: Any) -> list[Tensor]:
    """The tensors among coefficients, which are a tensor or a NamedTuple of tensors and numbers."""
    return [at] if isinstance(at, Tensor) else [value for value in at if isinstance(value, Tensor)]


def differentiable_projection(solver: Solver, at: Any, action: Tensor) -> Tensor:
    """The projection (..., d) of `action` (..., d), with first derivatives in it and in the tensors of `at`."""
    return _Projection.apply(_Partial(solver, at), action, *tensors_of(at))


class _Partial(NamedTuple):
    """A solver with coefficients like `at`, but with other tensors, given one by one."""

    solver: Solver
    at: Any

    def with_values(self, values: Sequence[Tensor]) -> Any:
        if isinstance(self.at, Tensor):
            return values[0]
        rest = iter(values)
        return type(self.at)(*(next(rest) if isinstance(value, Tensor) else value for value in self.at))

    def project(self, action: Tensor, values: Sequence[Tensor]) -> tuple[Tensor, JacobianProduct]:
        return self.solver.project(self.with_values(values), action)


def _with_batch_first(size: int, dims: Sequence[int | None], tensors: Sequence[Tensor]) -> list[Tensor]:
    """Tensors (..., k) with the axis of torch.func.vmap in front of all leading axes; the first one always has it."""
    rank = max(tensor.dim() - (dim is not None) for tensor, dim in zip(tensors, dims, strict=True))
    moved: list[Tensor] = []
    for tensor, dim in zip(tensors, dims, strict=True):
        if dim is not None:
            tensor = tensor.movedim(dim, 0)
            tensor = tensor.reshape(size, *[1] * (rank + 1 - tensor.dim()), *tensor.shape[1:])
        moved.append(tensor)
    moved[0] = moved[0].expand(size, *moved[0].shape[-rank:])
    return moved


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(partial: _Partial, action: Tensor, *values: Tensor) -> Tensor:
        return partial.project(action, values)[0]

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.partial, action, *values = inputs
        ctx.save_for_backward(action, output, *values)

    @staticmethod
    def backward(ctx, grad: Tensor):
        action, point, *values = ctx.saved_tensors
        moved = _JacobianProduct.apply(ctx.partial, grad, action, *values)
        by_values: Sequence[Tensor | None] = [None] * len(values)
        if any(ctx.needs_input_grad[2:]):
            by_values = _coefficient_gradients(ctx.partial, grad, moved, action, point, values)
        return None, moved, *by_values

    @staticmethod
    def vmap(info, in_dims, partial: _Partial, *tensors: Tensor):
        return _Projection.apply(partial, *_with_batch_first(info.batch_size, in_dims[1:], tensors)), 0


class _JacobianProduct(torch.autograd.Function):
    """The product (..., d) of a projection's Jacobian in the action with a vector (..., d)."""

    @staticmethod
    def forward(partial: _Partial, vector: Tensor, action: Tensor, *values: Tensor) -> Tensor:
        return partial.project(action, values)[1](vector)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        pass

    @staticmethod
    def backward(ctx, grad: Tensor):
        raise RuntimeError("projections have first derivatives only")

    @staticmethod
    def vmap(info, in_dims, partial: _Partial, vector: Tensor, action: Tensor, *values: Tensor):
        dims = in_dims[2], in_dims[1], *in_dims[3:]
        action, vector, *moved = _with_batch_first(info.batch_size, dims, (action, vector, *values))
        return _JacobianProduct.apply(partial, vector, action, *moved), 0


def _coefficient_gradients(
    partial: _Partial, grad: Tensor, moved: Tensor, action: Tensor, point: Tensor, values: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Gradients with respect to `values`, for `grad` (..., d) with respect to `point`, and `moved` with respect to
    `action`."""
    solver = partial.solver

    def boundaries(point: Tensor, *values: Tensor) -> tuple[Tensor, Tensor]:
        found = solver.boundaries(partial.with_values(values), point)
        return torch.stack([b.value for b in found], -1), torch.stack([b.normal for b in found], -2)

    value, normal = boundaries(point, *values)
    held = normal * (solver.free(point).unsqueeze(-2) & (value > -_ACTIVE).unsqueeze(-1))
    largest = one_where_zero(held.abs().amax(-1, keepdim=True))
    length = largest * root_or_one((held / largest).square().sum(-1, keepdim=True))
    unit = held / length
    # For dependent normals, the shortest combination counts.
    inverse = torch.linalg.pinv(unit @ unit.mT, rtol=_DEPENDENT, hermitian=True)

    def components(vector: Tensor) -> Tensor:
        """Coefficients (..., k) of the normals in the vector (..., d)."""
        return ((inverse @ (unit @ vector.unsqueeze(-1))) / length).squeeze(-1)

    multiplier = components(action - point).clamp(min=0.0)

    def pull(point: Tensor, *values: Tensor) -> Tensor:
        return (multiplier * (boundaries(point, *values)[1] * moved.unsqueeze(-2)).sum(-1)).sum()

    bend = torch.func.grad(pull)(point, *values)
    weight = components(grad - moved - bend)

    def lagrangian(*values: Tensor) -> Tensor:
        return -(pull(point, *values) + (weight * boundaries(point, *values)[0]).sum())

    return torch.func.grad(lagrangian, argnums=tuple(range(len(values))))(*values)
