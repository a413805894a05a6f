"""Our results in the form of the paper's table of rewards, and their comparison with the paper's."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from plots.grouping import (
    DAGGER,
    Condition,
    Groups,
    all_with,
    count_diverged,
    count_failed,
    order_conditions,
    reward_statistics,
    shared_settings,
)
from plots.paper import (
    BEYOND,
    DEFAULT_BATCH,
    FAMILIES,
    PAPER_SEEDS,
    SAME_WITHOUT_CONSTRAINT,
    UNCONSTRAINED,
    Statistic,
    order_algos,
    read_paper,
    same_without_constraint,
    unlabelled,
)
from store.folder import Run
from tables import MISSING, Table, TableCell, text_cells


def best_of_row(means: dict[str, float]) -> set[str]:
    """The names with the three highest means, or of three or fewer names the highest mean; ties are included."""
    ranked = sorted(means.values(), reverse=True)
    return {name for name, mean in means.items() if mean >= ranked[2 if len(ranked) > 3 else 0]}


def decimals(values: Iterable[float]) -> int:
    """Number of decimals, as in the paper: two if all values are below 100 in size (Reacher), otherwise none."""
    return 2 if max(abs(value) for value in values) < 100 else 0


def reward_table(groups: Groups, beside: bool = False) -> Table:
    """The paper's table: mean and standard error, the best of a row bold, the number of seeds unless it is ten.

    It has a column for each algorithm with results and, if `beside`, the paper's own columns too.
    """
    statistics, paper = reward_statistics(groups), read_paper() if beside else {}
    printed = {algo: stat for (*_, algo), stat in paper.items()}
    algos = _columns(statistics, printed)
    shared = shared_settings(condition.settings for condition in statistics)
    ours = {algo for row in statistics.values() for algo in row}
    missing = TableCell((MISSING,), missing=True)
    sections, records = [], []
    for conditions in order_conditions(statistics):
        rows = []
        for condition in conditions:
            row = statistics[condition]
            theirs = {algo: paper.get((condition.task, _batch(condition), algo)) for algo in printed}
            digits = decimals(stat.mean for stat in (*row.values(), *theirs.values()) if stat)
            best = best_of_row({algo: stat.mean for algo, stat in row.items()})
            cells = [TableCell(tuple(condition.label_without(shared).split(", ")))]
            for algo in algos:
                same = same_without_constraint(algo) if condition.task == UNCONSTRAINED else None
                if algo in row:
                    runs = groups[condition][algo]
                    cells.append(TableCell(_our_lines(row[algo], digits, runs), algo in best))
                    record = condition._asdict() | {"algo": algo} | row[algo]._asdict()
                    record |= {"failed": count_failed(runs), "diverged": count_diverged(runs)}
                    record |= {"bold": int(algo in best)}
                    if beside:
                        stat = theirs.get(algo)
                        record |= {"paper_mean": stat and stat.mean, "paper_se": stat and stat.se}
                    records.append(record)
                elif algo in ours or not beside:
                    cells.append(TableCell(("Same as", same), missing=True, merge=True) if same in row else missing)
                if algo in printed:
                    stat = theirs[algo]
                    cells.append(TableCell(describe(stat, digits)) if stat else missing)
            rows.append(cells)
        sections.append(rows)
    title = "Rewards: mean ± standard error over seeds (n where not ten), best three of a row bold"
    title += f" (of three or fewer, the best){all_with(shared)}"
    header, spans = ["Condition"], {}
    for algo in algos:
        own = [algo] if algo in ours or not beside else []
        header += [*own, *([f"{algo} (paper)"] if algo in printed else [])]
    for name, family in FAMILIES.items():
        if count := sum(unlabelled(head) in family for head in header):
            spans[name] = count
    # The other algorithms come last (order_algos). They need a heading too: they are in neither family.
    if others := len(header) - 1 - sum(spans.values()):
        spans[BEYOND] = others
    return Table("rewards", title, header, 1, sections, records, spans)


def _columns(statistics: Mapping[Condition, Mapping[str, Statistic]], printed: Iterable[str]) -> list[str]:
    """The algorithms with a column: those with results and those in `printed`.

    If `printed` is empty, algorithms that coincide with one of these on R+N have a column too.
    """
    algos = {*printed, *(algo for row in statistics.values() for algo in row)}
    for condition, row in statistics.items():
        if condition.task == UNCONSTRAINED and not printed:
            algos |= {algo for algo, same in SAME_WITHOUT_CONSTRAINT.items() if same in row}
    return order_algos(algos)


def describe(stat: Statistic, digits: int) -> tuple[str, ...]:
    """Mean, standard error, and the number of seeds unless it is the paper's."""
    error = f"± {stat.se:.{digits}f}" if stat.n > 1 else ""
    count = f"n={stat.n}" if stat.n != PAPER_SEEDS else ""
    return tuple(filter(None, (f"{stat.mean:.{digits}f}", error, count)))


def _our_lines(stat: Statistic, digits: int, runs: Sequence[Run]) -> tuple[str, ...]:
    """The lines of our cell, with a dagger and a note if seeds diverged, and a note if seeds have no finite result."""
    value, *others = describe(stat, digits)
    failed, diverged = count_failed(runs), count_diverged(runs)
    if diverged:
        value, others = f"{value}{DAGGER}", [*others, f"{diverged} of {len(runs)} diverged"]
    return (value, *others, *([f"{failed} failed"] if failed else []))


def comparison_table(groups: Groups) -> Table:
    """Our results beside the paper's. The table is empty if the paper has none of the cells.

    Only the batch size selects the paper's row. Runs with other changed settings are compared too; the row's label or
    the title names these settings.
    """
    statistics, paper = reward_statistics(groups), read_paper()
    shared = shared_settings(condition.settings for condition in statistics)
    sections, records = [], []
    for conditions in order_conditions(statistics):
        rows = []
        for condition in conditions:
            for algo in order_algos(statistics[condition]):
                ours, theirs = (
                    statistics[condition][algo],
                    paper.get((condition.task, _batch(condition), unlabelled(algo))),
                )
                digits = decimals((ours.mean, theirs.mean if theirs else ours.mean))
                texts = [
                    condition.label_without(shared),
                    algo,
                    " ".join(_our_lines(ours, digits, groups[condition][algo])),
                ]
                record = condition._asdict() | {"algo": algo} | ours._asdict()
                if theirs is None:
                    texts += [MISSING] * 3
                    record |= dict.fromkeys(("paper_mean", "paper_se", "difference", "joint_errors"))
                else:
                    difference = ours.mean - theirs.mean
                    joint = difference / math.hypot(ours.se, theirs.se)
                    texts += [" ".join(describe(theirs, digits)), f"{difference:+.{digits}f}"]
                    texts.append(f"{joint:+.1f}" if ours.n > 1 else MISSING)
                    record |= {"paper_mean": theirs.mean, "paper_se": theirs.se}
                    record |= {"difference": difference, "joint_errors": joint}
                rows.append(text_cells(*texts))
                records.append(record)
        if rows:
            sections.append(rows)
    title = "Comparison with the paper; differences are not adjusted for starts (last column: in joint standard errors)"
    title += all_with(shared)
    if all(record["paper_mean"] is None for record in records):
        sections, records = [], []
    header = ["Condition", "Algorithm", "Ours", "Paper", "Difference", "In joint s.e."]
    return Table("comparison", title, header, 2, sections, records)


def _batch(condition: Condition) -> str:
    override = re.search(r"(?:^|, )batch_size=(\w+)", condition.settings)
    return override[1] if override else DEFAULT_BATCH
