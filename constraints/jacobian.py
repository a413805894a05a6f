"""Exact Jacobians of projections, by implicit differentiation of their optimality (KKT) conditions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from constraints.numerics import refuse_second_derivatives

JacobianProduct = Callable[[Tensor], Tensor]
"""Multiplies the symmetric Jacobian of a projection with a vector (..., d)."""


def deflated_jacobian(curvature: Tensor, *normals: Tensor) -> JacobianProduct:
    """Jacobian product of a projection whose Lagrangian has a diagonal Hessian.

    Args:
        curvature: (..., d) diagonal of the inverse Hessian, 0 (or False) on coordinates that are held fixed.
        normals: (..., d) each, the gradient of an active constraint, 0 where it is inactive. Each removes the direction
            that it blocks from J: J <- J - (J n)(J n)' / (n' J n).
    """

    def product(vector: Tensor) -> Tensor:
        out = curvature * vector
        removed: list[tuple[Tensor, Tensor]] = []
        for normal in normals:
            column = curvature * normal
            pivot = (normal * column).sum(-1, keepdim=True)
            if removed:
                own = pivot
                for other, other_pivot in removed:
                    column = column - other * ((other * normal).sum(-1, keepdim=True) / other_pivot)
                pivot = (normal * column).sum(-1, keepdim=True)
                # The earlier normals may span this one. Then no freedom is left along it, and nothing to remove.
                column = column * (pivot > 1e-12 * own)
            pivot = pivot.clamp(min=1e-300)  # an inactive normal has pivot 0 and column 0
            out = out - column * ((normal * out).sum(-1, keepdim=True) / pivot)
            removed.append((column, pivot))
        return out

    return product


class _WithJacobian(torch.autograd.Function):
    @staticmethod
    def forward(ctx, action: Tensor, solution: tuple[Tensor, JacobianProduct]) -> Tensor:
        projected, ctx.jacobian_product = solution
        return projected.to(action.dtype)

    @staticmethod
    def backward(ctx, grad: Tensor):
        refuse_second_derivatives()
        return ctx.jacobian_product(grad.double()).to(grad.dtype), None


def with_jacobian(action: Tensor, projected: Tensor, product: JacobianProduct) -> Tensor:
    """The projection (..., d) of `action`, solved outside autograd, with its Jacobian and in the action's dtype."""
    return _WithJacobian.apply(action, (projected, product))
