"""Sets of one's own: rows and ellipses that depend on the observation, and their intersections.

They have no closed forms. General solvers find projection, linear oracle and centre, on the CPU in float64, wherever
the tensors are. In training, a GPU has to wait for them.
"""

from constraints.general.intersection import Intersection
from constraints.general.linear import LinearConstraint
from constraints.general.quadratic import QuadraticConstraint
from constraints.general.units import InUnits

__all__ = ["InUnits", "Intersection", "LinearConstraint", "QuadraticConstraint"]
