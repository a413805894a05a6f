"""The paper's table of rewards, and the comparison of ours with it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from plots.grouping import Condition, Groups, count_failed, order_conditions, reward_statistics
from plots.paper import (
    COLORS,
    DEFAULT_BATCH,
    FAMILIES,
    PAPER_SEEDS,
    SAME_WITHOUT_CONSTRAINT,
    UNCONSTRAINED,
    Statistic,
    order_algos,
    read_paper,
)
from tables import MISSING, Table, TableCell, text_cells


def best_three(means: dict[str, float]) -> set[str]:
    """The names with the three highest means, and any that ties with the third."""
    ranked = sorted(means.values(), reverse=True)
    return {name for name, mean in means.items() if mean >= ranked[:3][-1]}


def decimals(values: Iterable[float]) -> int:
    """As in the paper: two for Reacher's returns of some tens, none for returns of hundreds and thousands."""
    return 2 if max(abs(value) for value in values) < 100 else 0


def reward_table(groups: Groups) -> Table:
    """The paper's table: mean and standard error, the best three bold, the number of seeds unless it is ten."""
    statistics = reward_statistics(groups)
    algos = order_algos({*COLORS, *(algo for row in statistics.values() for algo in row)})
    sections, records = [], []
    for conditions in order_conditions(statistics):
        rows = []
        for condition in conditions:
            row = statistics[condition]
            digits = decimals(stat.mean for stat in row.values())
            best = best_three({algo: stat.mean for algo, stat in row.items()})
            cells = [TableCell(tuple(condition.label.split(", ")))]
            for algo in algos:
                same = SAME_WITHOUT_CONSTRAINT.get(algo) if condition.task == UNCONSTRAINED else None
                if algo in row:
                    failed = count_failed(groups[condition][algo])
                    lines = describe(row[algo], digits) + ((f"{failed} failed",) if failed else ())
                    cells.append(TableCell(lines, algo in best))
                    record = condition._asdict() | {"algo": algo} | row[algo]._asdict()
                    records.append(record | {"failed": failed, "best_three": int(algo in best)})
                elif same in row:
                    cells.append(TableCell(("Same as", same), missing=True, merge=True))
                else:
                    cells.append(TableCell((MISSING,), missing=True))
            rows.append(cells)
        sections.append(rows)
    title = "Rewards: mean ± standard error over seeds (n where not ten), best three of a row bold"
    spans = {name: len(family) for name, family in FAMILIES.items()}
    return Table("rewards", title, ["Condition", *algos], 1, sections, records, spans)


def describe(stat: Statistic, digits: int) -> tuple[str, ...]:
    """Mean, standard error, and the number of seeds unless it is the paper's."""
    error = f"± {stat.se:.{digits}f}" if stat.n > 1 else ""
    count = f"n={stat.n}" if stat.n != PAPER_SEEDS else ""
    return tuple(filter(None, (f"{stat.mean:.{digits}f}", error, count)))


def comparison_table(groups: Groups) -> Table:
    """Our results beside the paper's, for the cells that the paper has.

    Only the batch size chooses the paper's row. Runs with other settings are compared too; the label has those.
    """
    statistics, paper = reward_statistics(groups), read_paper()
    sections, records = [], []
    for conditions in order_conditions(statistics):
        rows = []
        for condition in conditions:
            for algo in order_algos(statistics[condition]):
                if (theirs := paper.get((condition.task, _batch(condition), algo))) is None:
                    continue
                ours = statistics[condition][algo]
                difference = ours.mean - theirs.mean
                joint = difference / math.hypot(ours.se, theirs.se)
                digits = decimals((ours.mean, theirs.mean))
                rows.append(
                    text_cells(
                        condition.label,
                        algo,
                        " ".join(describe(ours, digits)),
                        " ".join(describe(theirs, digits)),
                        f"{difference:+.{digits}f}",
                        f"{joint:+.1f}" if ours.n > 1 else MISSING,
                    )
                )
                record = condition._asdict() | {"algo": algo} | ours._asdict()
                record |= {"paper_mean": theirs.mean, "paper_se": theirs.se}
                records.append(record | {"difference": difference, "joint_errors": joint})
        if rows:
            sections.append(rows)
    title = "Comparison with the paper; the difference also in joint standard errors, where there are several seeds"
    header = ["Condition", "Algorithm", "Ours", "Paper", "Difference", "In joint s.e."]
    return Table("comparison", title, header, 2, sections, records)


def _batch(condition: Condition) -> str:
    override = re.search(r"(?:^|, )batch_size=(\w+)", condition.settings)
    return override[1] if override else DEFAULT_BATCH
