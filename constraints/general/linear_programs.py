"""Linear programs on rows, by HiGHS: a whole batch as one block-diagonal program."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from constraints.errors import ConstraintError
from constraints.general.active_set import project_on_rows
from constraints.general.scaled_sets import ScaledSets

_LARGEST_PROGRAM = 20_000  # rows of one block-diagonal program; a larger batch takes several programs
_TOLERANCE = 1e-10  # HiGHS's smallest; its default is 1e-7


def maximize_on_rows(sets: ScaledSets, slope: Tensor) -> Tensor:
    """Points (n, d) with the largest product with `slope` (n, d), of sets without ellipses."""
    # The projection of the origin names the sample, and often the row, of an empty set. The projection of the solution
    # moves it only by the linear program's tolerance.
    project_on_rows(sets.rows, sets.bounds, torch.zeros_like(slope), sets.name, sets.given_rows)
    solution = solve_linear_programs(slope, sets.rows, sets.bounds)
    return project_on_rows(sets.rows, sets.bounds, solution, sets.name, sets.given_rows)[0]


def solve_linear_programs(objective: Tensor, rows: Tensor, bounds: Tensor) -> Tensor:
    """argmax (n, d) of <objective, y> subject to rows (n, m, d) @ y <= bounds (n, m), feasible and bounded."""
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    count, m, dim = rows.shape
    solution = torch.empty_like(objective)
    size = max(1, _LARGEST_PROGRAM // m)
    for start in range(0, count, size):
        part = slice(start, min(start + size, count))
        blocks = part.stop - start
        columns = np.arange(blocks * dim).reshape(blocks, 1, dim).repeat(m, axis=1)
        matrix = csr_array(
            (rows[part].numpy().ravel(), columns.ravel(), np.arange(blocks * m + 1) * dim), (blocks * m, blocks * dim)
        )
        result = linprog(
            -objective[part].numpy().ravel(),
            matrix,
            bounds[part].numpy().ravel(),
            bounds=(None, None),
            method="highs",
            options={"primal_feasibility_tolerance": _TOLERANCE, "dual_feasibility_tolerance": _TOLERANCE},
        )
        if result.status != 0:
            raise ConstraintError(f"HiGHS failed on a linear program: {result.message}")
        solution[part] = torch.from_numpy(result.x).view(blocks, dim)
    return solution
