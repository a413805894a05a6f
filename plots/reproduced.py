"""README's table of the cells that were trained at full length: `python -m plots.reproduced docs/full-runs`."""

from __future__ import annotations

import sys
from pathlib import Path

from plots.grouping import Condition, group_runs, reward_statistics
from plots.paper import DEFAULT_BATCH, Statistic, order_algos, order_tasks, read_paper
from plots.rewards import decimals
from store.folder import read_results
from tables import MISSING

README = Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- python -m plots.reproduced docs/full-runs -->\n", "<!-- end -->\n"


def reproduced_table(root: str | Path) -> str:
    """The finished runs below `root` at the paper's own settings, beside the paper's means, as a Markdown table.

    A row an algorithm, a column a task. Raises ValueError if a run cannot be read or repeats another.
    """
    runs, problems = read_results(root)
    groups, repeated = group_runs(run for run in runs if not run.overrides)
    if problems or repeated:
        raise ValueError("; ".join(problems + repeated))
    by_condition = reward_statistics(groups)
    ours = {task: by_condition[Condition(task, "")] for task, settings in by_condition if not settings}
    tasks = order_tasks(ours)
    rows = [["", *tasks], ["---", *["---"] * len(tasks)]]
    for algo in order_algos({algo for row in ours.values() for algo in row}):
        rows.append([algo, *(_cell(ours[task].get(algo), task, algo) for task in tasks)])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _cell(ours: Statistic | None, task: str, algo: str) -> str:
    if ours is None:
        return MISSING
    theirs = read_paper().get((task, DEFAULT_BATCH, algo))
    digits = decimals([ours.mean] if theirs is None else [ours.mean, theirs.mean])
    paper = MISSING if theirs is None else f"{theirs.mean:.{digits}f} ± {theirs.se:.{digits}f}"
    error = f" ± {ours.se:.{digits}f}" if ours.n > 1 else ""
    return f"**{ours.mean:.{digits}f}**{error} (n={ours.n}) / {paper}"


def replace_table(text: str, table: str) -> str:
    """`text` with `table` between its two marks. Raises ValueError if it does not have them."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"no table between {BEGIN.strip()!r} and {END.strip()!r}")
    return f"{before}{begin}{table}{end}{after}"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m plots.reproduced FOLDER")
    README.write_text(replace_table(README.read_text(), reproduced_table(sys.argv[1])))
