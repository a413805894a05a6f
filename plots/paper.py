"""Order and colours of the paper's algorithms and of later methods, and the paper's table of rewards."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

# A version with penalty has a darker shade. The TD3 family is drawn solid, the SAC family dashed.
COLORS = {
    "DPro": "#7fb2e5",
    "DPro+": "#1f4fa8",
    "DPre": "#86c96b",
    "DPre+": "#1e6b26",
    "DOpt": "#f7a93b",
    "DOpt+": "#b8520a",
    "NFW": "#d62728",
    "DAlpha": "#9467bd",
    "DRad": "#7a4a2b",
    "SPre": "#35c4c4",
    "SPre+": "#0b6275",
    "SAlpha": "#e056b0",
    "SRad": "#222222",
}
FAMILIES = {"TD3 family": list(COLORS)[:9], "SAC family": list(COLORS)[9:]}
LATER = {"DGauge": "#b5a100", "SGauge": "#ff6f61", "DFlow": "#4b6cb7", "SFlow": "#2e8b57", "ARAM": "#7f00ff"}
"""Colours of this project's methods that are not in the paper. Tables and figures show them after the paper's."""
BEYOND = "beyond the paper"
"""The heading above all algorithms that are not the paper's: `LATER` and the user's own."""
# Without constraints, penalties are zero and projections the identity. These algorithms coincide, and the paper trains
# one of each family.
UNCONSTRAINED = "R+N"
SAME_WITHOUT_CONSTRAINT = dict.fromkeys(("DPro+", "DPre", "DPre+", "DOpt", "DOpt+"), "DPro") | {"SPre+": "SPre"}
PAPER_SEEDS = 10
DEFAULT_BATCH = "default"


class Statistic(NamedTuple):
    """Mean of n values with its standard error (NaN for n = 1)."""

    mean: float
    se: float
    n: int


@cache
def read_paper() -> dict[tuple[str, str, str], Statistic]:
    """The paper's Table "Average Rewards" by (task, batch, algorithm); batch is "16" or DEFAULT_BATCH."""
    with open(Path(__file__).parent / "paper_table.csv", newline="") as file:
        return {
            (row["task"], row["batch"], row["algo"]): Statistic(float(row["mean"]), float(row["se"]), PAPER_SEEDS)
            for row in csv.DictReader(file)
        }


def order_tasks(names: Iterable[str]) -> list[str]:
    """The tasks in the paper's order, other tasks last."""
    return _order(names, dict.fromkeys(task for task, _, _ in read_paper()))


def order_algos(names: Iterable[str]) -> list[str]:
    """The algorithms in the paper's order, then `LATER`, then others; a labelled name follows the unlabelled one."""
    return _order(names, [*COLORS, *LATER])


def first_beyond(ordered: Sequence[str]) -> int | None:
    """The index in `ordered` (from `order_algos`) of the first algorithm that is not the paper's.

    None if all or none of them are the paper's, because there are no two groups to separate.
    """
    papers = sum(unlabelled(name) in COLORS for name in ordered)
    return papers if 0 < papers < len(ordered) else None


def _order(names: Iterable[str], known: Iterable[str]) -> list[str]:
    place = {name: i for i, name in enumerate(known)}
    return sorted(set(names), key=lambda name: (place.get(unlabelled(name), len(place)), name))


def labelled(algo: str, label: str) -> str:
    """The name of `algo` in results of a source with this label (plots/others.py); unchanged if `label` is empty."""
    return f"{algo} ({label})" if label else algo


def unlabelled(algo: str) -> str:
    """The name of an algorithm without its label."""
    return algo.partition(" (")[0]


def same_without_constraint(algo: str) -> str | None:
    """The algorithm, with the same label, whose runs stand for `algo` on R+N; None if `algo` trains there itself."""
    name = unlabelled(algo)
    same = SAME_WITHOUT_CONSTRAINT.get(name)
    return same and same + algo.removeprefix(name)
