"""Returns on Reacher without the luck of their starts.

Most of a return on Reacher depends on the distance between fingertip and target at the start. The reward is 100 times
the progress towards the target, minus small costs. The *gain* of a start is 100 times the part of this distance that
the arm can cover. The seed of a run determines the starts of its final episodes, so their gains are known. The mean
gain of all possible starts is known too. The adjusted return, return - gain + mean gain, has the same expectation as
the return and a smaller variance (a control variate with coefficient 1).
"""

from __future__ import annotations

from functools import cache
from itertools import chain

import numpy as np
from scipy.stats import qmc

from core.random import stream_seed
from envs import TASKS, make
from envs.reacher import REACH, Reacher
from plots.grouping import Groups, all_with, count_diverged, order_conditions, shared_settings, statistic
from plots.paper import order_algos
from plots.rewards import describe
from store.folder import Run
from tables import MISSING, Table, text_cells

POINTS = 2**14
"""Number of starts in the mean gain, spread evenly (Sobol). The error of the mean is about 0.001."""


def gains(obs: np.ndarray) -> np.ndarray:
    """The gains (...) of starts with the observations (..., 9) of `Reacher`."""
    target, to_target = obs[..., 0:2], obs[..., 2:4]
    radius = np.linalg.norm(target, axis=-1)
    nearest, farthest = REACH
    rest = np.maximum(np.maximum(radius - farthest, nearest - radius), 0.0)
    return 100.0 * (np.linalg.norm(to_target, axis=-1) - rest)


class _Spread(np.random.Generator):
    """Replaces a random generator: draws the coordinates of evenly spread points, one after the other."""

    def __init__(self, points: np.ndarray):
        super().__init__(np.random.PCG64(0))
        self.coordinates = iter(points.ravel().tolist())

    def uniform(self, low: float = 0.0, high: float = 1.0, size: None = None) -> float:  # type: ignore[override]
        return low + (high - low) * next(self.coordinates)


@cache
def mean_gain(points: int = POINTS) -> float:
    """The mean gain of all possible starts, estimated from `points` starts."""
    robot, draws = Reacher(), _Spread(qmc.Sobol(4, scramble=False).random(points))
    return float(gains(np.array([robot.reset(draws) for _ in range(points)])).mean())


@cache
def final_gains(task: str, seed: int, evaluations: int, parallel: int, episodes: int) -> np.ndarray:
    """The gains (episodes,) of the starts of a run's final episodes, in the order of its returns.

    Before them, the run has evaluated its policy `evaluations` times, in `parallel` environments that reset together.
    """
    starts = []
    for k in range(parallel):
        env = make(task)
        env.reset(seed=stream_seed(seed, "evaluation", k))
        for _ in range(evaluations):
            env.reset()
        starts.append([env.reset()[0] for _ in range(k, episodes, parallel)])
    return gains(np.array([starts[i % parallel][i // parallel] for i in range(episodes)]))


def adjusted_returns(run: Run) -> np.ndarray:
    """The adjusted returns (episodes,) of a finished run on Reacher."""
    returns, (evaluations, parallel) = np.array(run.result["returns"]), run.evaluations.returns.shape
    return returns - final_gains(run.task, run.seed, evaluations, parallel, len(returns)) + mean_gain()


def is_on_reacher(run: Run) -> bool:
    return run.task in TASKS and issubclass(TASKS[run.task].robot, Reacher)


def adjusted_table(groups: Groups) -> Table:
    """Plain and adjusted returns of the cells on Reacher, over seeds, and the standard error of a seed's episodes.

    Diverged seeds are left out because their starts are not known; a note says how many.
    """
    rows_of = {condition for condition, by_algo in groups.items() if any(map(is_on_reacher, chain(*by_algo.values())))}
    shared = shared_settings(condition.settings for condition in rows_of)
    episodes: set[int] = set()
    sections, records = [], []
    for conditions in order_conditions(groups):
        rows = []
        for condition in conditions:
            for algo in order_algos(groups[condition]):
                on_reacher = [run for run in groups[condition][algo] if is_on_reacher(run)]
                diverged = count_diverged(on_reacher)
                note = f" ({diverged} of {len(on_reacher)} diverged, left out)" if diverged else ""
                runs = [run for run in on_reacher if "returns" in (run.result or {})]
                if not runs:
                    if diverged:
                        rows.append(
                            text_cells(condition.label_without(shared), algo, f"{MISSING}{note}", *[MISSING] * 3)
                        )
                    continue
                plain = [np.array(run.result["returns"]) for run in runs]
                episodes |= {len(returns) for returns in plain}
                adjusted = [adjusted_returns(run) for run in runs]
                over_seeds = [statistic([float(values.mean()) for values in returns]) for returns in (plain, adjusted)]
                of_a_seed = [
                    np.mean([statistic(values.tolist()).se for values in returns]) for returns in (plain, adjusted)
                ]
                cells = [" ".join(describe(stat, 2)) for stat in over_seeds] + [f"{error:.2f}" for error in of_a_seed]
                cells[0] += note
                rows.append(text_cells(condition.label_without(shared), algo, *cells))
                names = ("mean", "se", "n", "adjusted_mean", "adjusted_se", "seed_se", "adjusted_seed_se")
                values = (*over_seeds[0], *over_seeds[1][:2], *of_a_seed)
                record = condition._asdict() | {"algo": algo} | dict(zip(names, values, strict=True))
                records.append(record | {"diverged": diverged})
        if rows:
            sections.append(rows)
    title = "Reacher: returns as they are, and adjusted for the luck of their starts"
    title += all_with(shared)
    several = " or ".join(map(str, sorted(episodes))) or "final"
    header = ["Condition", "Algorithm", "Return", "Adjusted", f"s.e. of {several} episodes", "the same, adjusted"]
    return Table("adjusted", title, header, 2, sections, records)
