"""Speed of the constraints package beside general solvers, on one thread.

    python bench/constraints.py                                          # all sets, batches and installed solvers
    python bench/constraints.py task=W+M,HC+O batch=1,100 baselines=osqp,linprog out=results/bench
    python bench/constraints.py baselines=none                           # this package alone

Prints a table and saves it in `out` (default bench/results) as constraints.md and, one measurement a row, as
constraints.csv.

Times are CPU time, the least of several repeats. `project + gradient` is the forward and the backward pass. Actions are
uniform in the box. Every entry of an observation is normal with standard deviation 1 on Reacher and 8 elsewhere, so
that a fair share of the actions is infeasible; the table gives this share. `task` accepts the paper's tasks and the
sets of `bench/own_sets.py`, such as 2x6 for two rows in six dimensions.

The baselines get the same observations and actions: `osqp` (a loop; projection on linear sets; tolerance 1e-6),
`gurobi` (a loop; projection), `cvxpylayers` (projection and its gradient on the paper's sets, in their most compact
forms), `qpth` (batched; the same on linear sets), `linprog` (SciPy's HiGHS, a loop; centre and oracle of linear sets).
Those not installed are left out: `pip install -e '.[bench]'` for osqp, gurobi and cvxpylayers,
`pip install --no-deps qpth` (it requires numpy 1).
"""

from __future__ import annotations

import csv
import importlib.util
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# This file would hide the package `constraints`: import from the project root, not from this folder.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import numpy as np
import torch
from scipy import sparse
from scipy.optimize import linprog
from torch import Tensor
from tqdm import tqdm

from bench.own_sets import own_sets
from constraints import (
    Ball,
    Constraint,
    HalfSpace,
    PlanarEllipse,
    WeightedL1,
    WeightedL1AndEllipse,
    WeightedPositivePart,
)
from constraints.general.base import GeneralConstraint
from core.words import ConfigError, parse_words, split_names, whole_numbers
from envs import TASKS
from envs.reacher import Reacher
from store.provenance import processor

Operation = Callable[[Tensor, Tensor], Tensor]
"""(obs (batch, n), action (batch, d)) -> the operation's result (batch, d)."""

SETS = {name: task.constraint for name, task in TASKS.items()} | own_sets()
OURS = "this package"
BASELINES = {"osqp": 64, "gurobi": 16, "cvxpylayers": 16, "qpth": 256, "linprog": 16}
"""The largest batch that each solver is measured on. The time of a larger batch is extrapolated in proportion."""


def graded(project: Operation) -> Operation:
    """`project` forward and backward; returns the gradient."""

    def both(obs: Tensor, action: Tensor) -> Tensor:
        action = action.clone().requires_grad_()
        project(obs, action).sum().backward()
        return action.grad

    return both


def closed_forms(constraint: Constraint) -> dict[str, Operation]:
    return {
        "project": constraint.project,
        "project + gradient": graded(constraint.project),
        "center": lambda obs, action: constraint.center(obs),
        "oracle": constraint.linear_oracle,
    }


# ------------------------------------------------------------------------------------------------------ the baselines


def is_linear(constraint: Constraint) -> bool:
    return not constraint.explicit(torch.zeros(1, 17, dtype=torch.float64)).ellipses


def each_row(constraint: Constraint, obs: Tensor):
    """Rows (m, d) and bounds (m,) of every sample, as arrays."""
    rows, bounds, _ = constraint.explicit(obs)
    m = bounds.shape[-1]
    return zip(rows.expand(len(obs), m, -1).numpy(), bounds.expand(len(obs), m).numpy(), strict=True)


def osqp_loop(constraint: Constraint) -> dict[str, Operation]:
    import osqp

    if not is_linear(constraint):
        return {}

    def project(obs: Tensor, action: Tensor) -> Tensor:
        dim, box = constraint.dim, np.eye(constraint.dim)
        solver, solutions = None, []
        for (rows, bounds), target in zip(each_row(constraint, obs), action.numpy(), strict=True):
            dense = np.vstack((rows, box))
            upper = np.concatenate((bounds, np.ones(dim)))
            if solver is None:
                pattern = sparse.csc_matrix(np.ones_like(dense))  # zeros included, so that all samples share it
                pattern.data = dense.T.ravel()
                lower = np.concatenate((np.full(len(bounds), -np.inf), -np.ones(dim)))
                solver = osqp.OSQP()
                identity = sparse.eye(dim, format="csc")
                solver.setup(identity, -target, pattern, lower, upper, eps_abs=1e-6, eps_rel=1e-6, verbose=False)
            else:
                solver.update(q=-target, u=upper, Ax=dense.T.ravel())
            solutions.append(solver.solve().x)
        return torch.as_tensor(np.array(solutions))

    return {"project": project}


def gurobi_loop(constraint: Constraint) -> dict[str, Operation]:
    import gurobipy

    environment = gurobipy.Env(params={"OutputFlag": 0, "Threads": 1})

    def project(obs: Tensor, action: Tensor) -> Tensor:
        ellipses = [(q.expand(len(obs), -1, -1).numpy(), bound) for q, _, bound in constraint.explicit(obs)[2]]
        solutions = []
        for k, ((rows, bounds), target) in enumerate(zip(each_row(constraint, obs), action.numpy(), strict=True)):
            with gurobipy.Model(env=environment) as model:
                a = model.addMVar(constraint.dim, lb=-1.0, ub=1.0)
                if len(rows):
                    model.addConstr(rows @ a <= bounds)
                for matrix, bound in ellipses:
                    model.addConstr(a @ matrix[k] @ a <= bound)
                model.setObjective(a @ a - 2.0 * target @ a)
                model.optimize()
                solutions.append(a.X)
        return torch.as_tensor(np.array(solutions))

    return {"project": project}


def cvxpy_layer(constraint: Constraint) -> dict[str, Operation]:
    import cvxpy as cp
    from cvxpylayers.torch import CvxpyLayer

    if isinstance(constraint, GeneralConstraint):
        return {}
    action, target = cp.Variable(constraint.dim), cp.Parameter(constraint.dim)
    limits, parameters, values = [action <= 1, action >= -1], [target], []

    def parameter(value: Callable[[Tensor], Tensor], *shape: int) -> cp.Parameter:
        parameters.append(cp.Parameter(shape))
        values.append(value)
        return parameters[-1]

    def l1(part: WeightedL1) -> None:
        weight = parameter(part.weight, part.dim)
        limits.append(cp.norm1(cp.multiply(weight, action)) <= part.bound)

    if isinstance(constraint, Ball):
        limits.append(cp.sum_squares(action) <= constraint.bound)
    elif isinstance(constraint, WeightedL1):
        l1(constraint)
    elif isinstance(constraint, WeightedPositivePart):
        weight = parameter(constraint.weight, constraint.dim)
        limits.append(cp.sum(cp.pos(cp.multiply(weight, action))) <= constraint.bound)
    elif isinstance(constraint, HalfSpace):
        limits.append(parameter(constraint.weight, constraint.dim) @ action <= constraint.bound)
    elif isinstance(constraint, PlanarEllipse):

        def root(obs: Tensor) -> Tensor:
            scale, axes = torch.linalg.eigh(constraint.matrix(obs))
            return scale.clamp(min=0.0).sqrt().unsqueeze(-1) * axes.mT

        limits.append(cp.sum_squares(parameter(root, 2, 2) @ action) <= constraint.bound)
    elif isinstance(constraint, WeightedL1AndEllipse):
        l1(constraint.l1)
        scale = parameter(lambda obs: constraint.ellipse.scale(obs).sqrt(), constraint.dim)
        limits.append(cp.sum_squares(cp.multiply(scale, action)) <= constraint.ellipse.bound)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(action - target)), limits)
    layer = CvxpyLayer(problem, parameters, [action], solver_args={"solve_method": "Clarabel"})

    def project(obs: Tensor, action: Tensor) -> Tensor:
        return layer(action, *(value(obs) for value in values))[0]

    return {"project": project, "project + gradient": graded(project)}


def qpth_batch(constraint: Constraint) -> dict[str, Operation]:
    from qpth.qp import QPFunction

    if not is_linear(constraint):
        return {}
    solve = QPFunction(verbose=-1, check_Q_spd=False)

    def project(obs: Tensor, action: Tensor) -> Tensor:
        rows, bounds, _ = constraint.explicit(obs)
        box = torch.eye(constraint.dim, dtype=obs.dtype)
        lead, m = len(obs), bounds.shape[-1]
        sides = torch.cat((rows.expand(lead, m, -1), torch.cat((box, -box)).expand(lead, -1, -1)), -2)
        limits = torch.cat((bounds.expand(lead, m), torch.ones(lead, 2 * constraint.dim, dtype=obs.dtype)), -1)
        none = obs.new_zeros(0)
        return solve(box.expand(lead, -1, -1), -action, sides, limits, none, none)

    return {"project": project, "project + gradient": graded(project)}


def linprog_loop(constraint: Constraint) -> dict[str, Operation]:
    if not is_linear(constraint):
        return {}

    def center(obs: Tensor, action: Tensor) -> Tensor:
        dim, solutions = constraint.dim, []
        box = np.vstack((np.eye(dim), -np.eye(dim)))
        for rows, bounds in each_row(constraint, obs):
            # The last variable is the radius r of a ball around the centre: A_i c + |A_i| r <= b_i.
            sides = np.vstack((rows, box))
            sides = np.column_stack((sides, np.linalg.norm(sides, axis=1)))
            limits = np.concatenate((bounds, np.ones(2 * dim)))
            best = linprog(np.eye(dim + 1)[-1] * -1.0, sides, limits, bounds=[(None, None)] * dim + [(0, None)])
            solutions.append(best.x[:-1])
        return torch.as_tensor(np.array(solutions))

    def oracle(obs: Tensor, gradient: Tensor) -> Tensor:
        solutions = [
            linprog(-g, rows if len(rows) else None, bounds if len(rows) else None, bounds=(-1.0, 1.0)).x
            for (rows, bounds), g in zip(each_row(constraint, obs), gradient.numpy(), strict=True)
        ]
        return torch.as_tensor(np.array(solutions))

    return {"center": center, "oracle": oracle}


SOLVERS = {
    "osqp": osqp_loop,
    "gurobi": gurobi_loop,
    "cvxpylayers": cvxpy_layer,
    "qpth": qpth_batch,
    "linprog": linprog_loop,
}
MODULES = {"osqp": "osqp", "gurobi": "gurobipy", "cvxpylayers": "cvxpylayers", "qpth": "qpth", "linprog": "scipy"}


# ---------------------------------------------------------------------------------------------------- the measurement


def draw(task: str, batch: int) -> tuple[Tensor, Tensor]:
    """Observations (batch, n) and actions (batch, d)."""
    generator = torch.Generator().manual_seed(0)
    spread = 1.0 if task in TASKS and TASKS[task].robot is Reacher else 8.0
    # No set reads more than the first 17 entries.
    obs = torch.randn(batch, 17, generator=generator, dtype=torch.float64) * spread
    return obs, 2.0 * torch.rand(batch, SETS[task].dim, generator=generator, dtype=torch.float64) - 1.0


def cpu_time(call: Callable[[], Tensor], budget: float = 0.3, repeats: int = 200) -> float:
    """Seconds of CPU time of one call: the least of `repeats`, or of as many as `budget` seconds allow."""
    start = time.process_time()
    call()
    first = time.process_time() - start
    if first > budget:  # the first call may include one-off setup, which must not count
        start = time.process_time()
        call()
        return min(first, time.process_time() - start)
    best, spent = first, 0.0
    for _ in range(repeats):
        start = time.process_time()
        call()
        last = time.process_time() - start
        best, spent = min(best, last), spent + last
        if spent > budget:
            break
    return best


def measure(task: str, batches: list[int], solvers: list[str]) -> list[dict]:
    """A record for each operation, solver and batch size: CPU seconds, and the number of samples actually measured."""
    constraint = SETS[task]
    records = []
    for solver in (OURS, *solvers):
        operations = closed_forms(constraint) if solver == OURS else SOLVERS[solver](constraint)
        for name, operation in operations.items():
            for batch in batches:
                samples = batch if solver == OURS else min(batch, BASELINES[solver])
                obs, action = draw(task, samples)
                seconds = cpu_time(lambda run=operation, o=obs, a=action: run(o, a)) * batch / samples
                record = {"task": task, "operation": name, "solver": solver, "batch": batch, "seconds": seconds}
                records.append({**record, "measured": samples})
    return records


def active_share(task: str) -> float:
    obs, action = draw(task, 2560)
    return (SETS[task].violation(obs, action) > 0.0).double().mean().item()


def machine() -> str:
    return f"{processor()}, torch {torch.__version__}, {torch.get_num_threads()} thread, float64"


def table(records: list[dict], batches: list[int]) -> str:
    """Markdown: a row for each task, operation and solver, milliseconds a batch, and the ratio at the largest batch
    of at most 100."""
    chosen = max((b for b in batches if b <= 100), default=batches[0])
    seconds = {(r["task"], r["operation"], r["solver"], r["batch"]): r for r in records}
    header = ["task", "active", "operation", "solver", *map(str, batches), f"times ours at {chosen}"]
    lines = [" | ".join(header), " | ".join(["---"] * 4 + ["---:"] * (len(batches) + 1))]
    shares = {task: f"{active_share(task):.0%}" for task in dict.fromkeys(r["task"] for r in records)}
    rows = sorted({(r["task"], r["operation"], r["solver"]): None for r in records}, key=lambda r: (r[0], r[1]))
    order = list(SETS)
    rows.sort(key=lambda r: (order.index(r[0]), list(closed_forms(SETS[r[0]])).index(r[1])))
    for task, operation, solver in rows:
        cells = []
        for batch in batches:
            record = seconds[task, operation, solver, batch]
            estimate = "~" if record["measured"] < batch else ""
            cells.append(f"{estimate}{1e3 * record['seconds']:.3g}")
        ratio = seconds[task, operation, solver, chosen]["seconds"] / seconds[task, operation, OURS, chosen]["seconds"]
        cells.append("" if solver == OURS else f"{ratio:.0f}")
        lines.append(" | ".join([task, shares[task], operation, solver, *cells]))
    return "\n".join(f"| {line} |" for line in lines)


def choices(arguments: list[str]) -> tuple[list[str], list[int], list[str], Path]:
    """Parse the `key=value` words into tasks, batch sizes, baselines and folder. Raises ConfigError for a bad word."""
    known = {"task": "all", "batch": "1,16,100,256,2560", "baselines": "all", "out": "bench/results"}
    known |= parse_words(arguments, known)
    solvers = split_names("baseline", known["baselines"], BASELINES, {"none": ()})
    tasks, batches = split_names("task", known["task"], SETS), whole_numbers("batch", known["batch"])
    return tasks, batches, solvers, Path(known["out"])


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    try:
        tasks, batches, wanted, out = choices(arguments)
    except ConfigError as error:
        print(f"bench/constraints.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    solvers = []
    for name in wanted:
        if importlib.util.find_spec(MODULES[name]) is None:
            print(f"{name} is not installed: left out")
        else:
            solvers.append(name)
    records = [record for task in tqdm(tasks, unit="task") for record in measure(task, batches, solvers)]
    text = (
        f"Milliseconds of CPU time per batch, on {machine()}. `~`: measured on fewer samples and extrapolated. "
        "`active`: share of the actions that are infeasible.\n\n" + table(records, batches) + "\n"
    )
    print(text)
    out.mkdir(parents=True, exist_ok=True)
    (out / "constraints.md").write_text(text)
    with open(out / "constraints.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(records[0]))
        writer.writeheader()
        writer.writerows(records)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
