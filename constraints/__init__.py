"""Feasible action sets and differentiable maps onto them; usable on their own."""

from constraints.ball import Ball
from constraints.base import Constraint
from constraints.box import Box
from constraints.coefficients import check_inputs
from constraints.ellipse import DiagonalEllipse, PlanarEllipse
from constraints.errors import ConstraintError, EmptySetError
from constraints.general import Intersection, InUnits, LinearConstraint, QuadraticConstraint
from constraints.l1_and_ellipse import WeightedL1AndEllipse
from constraints.weighted import HalfSpace, WeightedL1, WeightedPositivePart

__all__ = [
    "Ball",
    "Box",
    "Constraint",
    "ConstraintError",
    "DiagonalEllipse",
    "EmptySetError",
    "HalfSpace",
    "InUnits",
    "Intersection",
    "LinearConstraint",
    "PlanarEllipse",
    "QuadraticConstraint",
    "WeightedL1",
    "WeightedL1AndEllipse",
    "WeightedPositivePart",
    "check_inputs",
]
