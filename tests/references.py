"""Independent references for the feasible sets: explicit rows and matrices, general solvers, optimality conditions.

Nothing here uses the package. A set is given explicitly: all its rows, up to 2^d, and its matrix. An interior-point
solver gives the answer to about 1e-6; the optimality conditions verify an answer up to rounding.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import clarabel
import numpy as np
from scipy import sparse
from scipy.optimize import linprog, nnls


@dataclass(frozen=True)
class ReferenceSet:
    """{a in [-1, 1]^d: rows a <= bounds, a' matrix a <= matrix_bound} with numpy arrays (m, d), (m,) and (d, d)."""

    rows: np.ndarray
    bounds: np.ndarray
    matrix: np.ndarray | None = None
    matrix_bound: float = 0.0

    @property
    def dim(self) -> int:
        return self.rows.shape[1]

    def penalty(self, action: np.ndarray) -> float:
        excess = np.maximum(self._row_excess(action), 0.0)
        return float(np.linalg.norm(excess) + max(self._matrix_excess(action), 0.0))

    def violation(self, action: np.ndarray) -> float:
        excess = [np.abs(action).max() - 1.0, *self._row_excess(action)]
        if self.matrix is not None:
            excess.append(self._matrix_excess(action))
        return float(max(excess))

    def project(self, action: np.ndarray) -> np.ndarray:
        return self._solve(np.eye(self.dim), -action)

    def linear_oracle(self, gradient: np.ndarray) -> np.ndarray:
        return self._solve(np.zeros((self.dim, self.dim)), -gradient)

    def normal_cone_residual(self, point: np.ndarray, outward: np.ndarray, near: float = 1e-10) -> float:
        """Distance of `outward` to the normal cone at the feasible `point`; constraints within `near` are active.

        A point is the projection of x if x - point is in the normal cone at the point, and it maximises <g, .> if g is.
        With a residual vector r, the point is the projection of x - r. Projections do not expand distances, so it is
        within |r| of the projection of x.
        """
        return float(np.linalg.norm(self._normal_cone_remainder(point, outward, near)))

    def oracle_gap(self, point: np.ndarray, gradient: np.ndarray, near: float = 1e-10) -> float:
        """Upper bound of <gradient, a - point> over all feasible a, for a feasible `point`.

        The gradient is a normal plus a remainder. The remainder gains at most its entries times the widths of the set.
        """
        widths = np.full(self.dim, 2.0)
        if self.matrix is not None:
            # The half-width of a diagonal ellipse along an axis; for other ellipses, that of the box.
            diagonal = np.diag(self.matrix)
            if np.array_equal(self.matrix, np.diag(diagonal)):
                widths = 2.0 * np.minimum(1.0, np.sqrt(self.matrix_bound / np.maximum(diagonal, self.matrix_bound)))
        return float(np.abs(self._normal_cone_remainder(point, gradient, near)) @ widths)

    def _normal_cone_remainder(self, point: np.ndarray, outward: np.ndarray, near: float) -> np.ndarray:
        rows = np.vstack((self._unit_rows(), np.eye(self.dim), -np.eye(self.dim)))
        excess = np.concatenate((self._row_excess(point), point - 1.0, -point - 1.0))
        normals = rows[excess > -near]
        if self.matrix is not None and self._matrix_excess(point) > -near:
            normal = self.matrix @ point
            normals = np.vstack((normals, normal / np.linalg.norm(normal)))
        size = np.linalg.norm(outward)
        if len(normals) == 0 or size == 0.0:
            return outward
        share, _ = nnls(normals.T, outward / size)
        return outward - size * (normals.T @ share)

    def chebyshev_radius(self) -> float:
        """Radius of the largest ball inside the linear rows and the box, by linear programming."""
        norms = np.linalg.norm(self.rows, axis=1)
        faces = np.vstack((np.eye(self.dim), -np.eye(self.dim)))
        result = linprog(
            np.append(np.zeros(self.dim), -1.0),
            A_ub=np.vstack((np.column_stack((self.rows, norms)), np.column_stack((faces, np.ones(2 * self.dim))))),
            b_ub=np.concatenate((self.bounds, np.ones(2 * self.dim))),
            bounds=[(None, None)] * (self.dim + 1),
        )
        assert result.status == 0, result.message
        return -result.fun

    def _norms(self) -> np.ndarray:
        norms = np.linalg.norm(self.rows, axis=1)
        return np.where(norms > 0.0, norms, 1.0)

    def _unit_rows(self) -> np.ndarray:
        return self.rows / self._norms()[:, None]

    def _row_excess(self, action: np.ndarray) -> np.ndarray:
        return (self.rows @ action - self.bounds) / self._norms()

    def _matrix_excess(self, action: np.ndarray) -> float:
        if self.matrix is None:
            return 0.0
        trace = np.trace(self.matrix)
        factor = self.dim / trace if trace > 0.0 else 1.0
        value = max(action @ self.matrix @ action, 0.0)
        return np.sqrt(factor * value) - np.sqrt(factor * self.matrix_bound)

    def _solve(self, hessian: np.ndarray, linear: np.ndarray) -> np.ndarray:
        """argmin of a' hessian a / 2 + linear a over the set."""
        scale = np.maximum(np.abs(self.rows).max(axis=1), 1.0) if len(self.rows) else np.ones(0)
        blocks = [np.eye(self.dim), -np.eye(self.dim), self.rows / scale[:, None]]
        sides = [np.ones(2 * self.dim), self.bounds / scale]
        cones = [clarabel.NonnegativeConeT(2 * self.dim + len(self.rows))]
        if self.matrix is not None:
            values, vectors = np.linalg.eigh(self.matrix)
            root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
            blocks += [np.zeros((1, self.dim)), -root]
            sides += [np.array([np.sqrt(self.matrix_bound)]), np.zeros(self.dim)]
            cones.append(clarabel.SecondOrderConeT(self.dim + 1))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
        solver = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(hessian)),
            linear,
            sparse.csc_matrix(np.vstack(blocks)),
            np.concatenate(sides),
            cones,
            settings,
        )
        solution = solver.solve()
        assert solution.status in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved), solution.status
        return np.array(solution.x)


def sign_rows(weight: np.ndarray) -> np.ndarray:
    """The 2^d rows of sum |w_i a_i|."""
    return np.array(list(itertools.product((-1.0, 1.0), repeat=len(weight)))) * weight


def subset_rows(weight: np.ndarray) -> np.ndarray:
    """The 2^d - 1 rows of sum max(w_i a_i, 0)."""
    return np.array(list(itertools.product((0.0, 1.0), repeat=len(weight)))[1:]) * weight
