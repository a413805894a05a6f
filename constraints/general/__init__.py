"""General sets, for constraints of your own: rows and ellipses that depend on the observation, and their intersections.

They have no closed forms. Wherever the tensors are, solvers compute projection, linear oracle and centre on the CPU in
float64. In training, a GPU has to wait for them.
"""

from constraints.general.intersection import Intersection
from constraints.general.linear import LinearConstraint
from constraints.general.quadratic import QuadraticConstraint
from constraints.general.units import InUnits

__all__ = ["InUnits", "Intersection", "LinearConstraint", "QuadraticConstraint"]
