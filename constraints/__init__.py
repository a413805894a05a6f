"""Feasible action sets and differentiable maps onto them; usable on their own."""

from constraints.ball import Ball
from constraints.base import Constraint
from constraints.box import Box
from constraints.ellipse import DiagonalEllipse, PlanarEllipse
from constraints.errors import ConstraintError
from constraints.intersection import Intersection
from constraints.l1_and_ellipse import WeightedL1AndEllipse
from constraints.linear import LinearConstraint
from constraints.quadratic import QuadraticConstraint
from constraints.weighted import HalfSpace, WeightedL1, WeightedPositivePart

__all__ = [
    "Ball",
    "Box",
    "Constraint",
    "ConstraintError",
    "DiagonalEllipse",
    "HalfSpace",
    "Intersection",
    "LinearConstraint",
    "PlanarEllipse",
    "QuadraticConstraint",
    "WeightedL1",
    "WeightedL1AndEllipse",
    "WeightedPositivePart",
]
