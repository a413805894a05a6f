"""Writes the tables of full-length results in README and docs/results.md: `python -m plots.reproduced`.

It reads docs/data and replaces both tables. A test compares the tables with the data.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from plots.grouping import DAGGER, count_diverged, final_return, group_runs, statistic
from plots.paper import COLORS, DEFAULT_BATCH, Statistic, order_algos, order_tasks, read_paper
from plots.rewards import decimals
from plots.starts import adjusted_returns, is_on_reacher
from store.files import one_line
from store.folder import Run
from store.published import read_published
from tables import MISSING

ROOT = Path(__file__).parents[1]
DATA = ROOT / "docs" / "data"
BEGIN, END = "<!-- made by: python -m plots.reproduced -->\n", "<!-- end -->\n"

Cells = dict[str, dict[str, list[Run]]]
"""Runs by task and algorithm."""


def read_cells(root: str | Path) -> Cells:
    """The runs published in `root` that have the paper's own settings and a final result.

    The result of a diverged run is that of its best parameters before. Raises ValueError if there is no such run, a
    file is corrupt, a run repeats another, or a cell mixes settings.
    """
    runs = [published.run for published in read_published(root)]
    groups, repeated = group_runs(run for run in runs if not run.overrides and _has_result(run))
    mixed = [f"{condition.label}: settings differ within a cell" for condition in groups if condition.settings]
    if repeated or mixed:
        raise ValueError("; ".join(repeated + mixed))
    if not groups:
        raise ValueError(f"no full-length runs in {root}")
    return {condition.task: groups[condition] for condition in groups}


def overview(cells: Cells) -> str:
    """README's table of the paper's algorithms: a row for each map, columns for TD3 and SAC on each task.

    A cell has our mean, then the paper's. The first letter of an algorithm's name is its base (D for TD3, S for SAC),
    the rest is its map. NFW has a row of its own, in TD3's columns.
    """
    found: dict[tuple[str, str], dict[str, str]] = {}
    paper = {algo for by_algo in cells.values() for algo in by_algo if algo in COLORS}
    names = {algo: algo[1:] if algo[0] in "DS" else algo for algo in order_algos(paper)}
    for task in order_tasks(cells):
        for algo in names:
            if runs := cells[task].get(algo):
                ours, theirs = _results(runs), read_paper().get((task, DEFAULT_BATCH, algo))
                digits = decimals(stat.mean for stat in (ours, theirs) if stat)
                column = found.setdefault((task, "SAC" if algo.startswith("S") else "TD3"), {})
                column[names[algo]] = f"**{_text(ours, digits)}**{_mark(runs)} (n={ours.n}) / {_text(theirs, digits)}"
    rows = [["", *(" ".join(key) for key in found)], ["---"] * (len(found) + 1)]
    for name in dict.fromkeys(names.values()):
        rows.append([name, *(column.get(name, MISSING) for column in found.values())])
    return _markdown(rows)


def details(cells: Cells) -> str:
    """The table of docs/results.md: a row for each cell, with results on Reacher also adjusted for their starts.

    The difference from the paper is in joint standard errors. It uses the adjusted result if there is one.
    """
    rows = [
        ["task", "algorithm", "seeds", "final result", "adjusted", "paper", "difference", "largest violation"],
        ["---"] * 3 + ["---:"] * 5,
    ]
    for task in order_tasks(cells):
        for algo in order_algos(cells[task]):
            runs = cells[task][algo]
            ours, theirs = _results(runs), read_paper().get((task, DEFAULT_BATCH, algo))
            digits = decimals(stat.mean for stat in (ours, theirs) if stat)
            adjusted = None
            if is_on_reacher(runs[0]) and not _mark(runs):  # the starts of a run that diverged are not known
                adjusted = statistic([float(np.mean(adjusted_returns(run))) for run in runs])
            seeds = ", ".join(f"{run.seed}{_mark([run])}" for run in runs)
            result = _text(ours, digits) + _mark(runs)
            violation = f"{max((run.result or run.failure)['largest_violation'] for run in runs):.1e}"
            numbers = [result, _text(adjusted, digits), _text(theirs, digits), _difference(adjusted or ours, theirs)]
            rows.append([task, algo, seeds, *numbers, violation])
    return _markdown(rows)


def _has_result(run: Run) -> bool:
    value = final_return(run)
    return value is not None and math.isfinite(value)


def _results(runs: Sequence[Run]) -> Statistic:
    return statistic([final_return(run) for run in runs])


def _mark(runs: Sequence[Run]) -> str:
    """A dagger if seeds diverged."""
    return DAGGER * bool(count_diverged(runs))


def _text(stat: Statistic | None, digits: int) -> str:
    if stat is None:
        return MISSING
    return f"{stat.mean:.{digits}f}" + (f" ± {stat.se:.{digits}f}" if stat.n > 1 else "")


def _difference(ours: Statistic, theirs: Statistic | None) -> str:
    if theirs is None or ours.n == 1:
        return MISSING
    return f"{(ours.mean - theirs.mean) / math.hypot(ours.se, theirs.se):+.1f}"


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


TABLES = {ROOT / "README.md": overview, ROOT / "docs" / "results.md": details}
"""The function that makes the table of each document."""


def replace_table(text: str, table: str, name: str) -> str:
    """The `text` of the page `name` with `table` between the two marks. Raises ValueError if a mark is missing."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{name}: no table between {BEGIN.strip()!r} and {END.strip()!r}")
    return f"{before}{begin}{table}{end}{after}"


def main(argv: Sequence[str]) -> int:
    if argv:
        print(__doc__)
        return 0 if argv[0] in ("-h", "--help") else 2  # it has no arguments
    try:
        cells = read_cells(DATA)
        texts = {path: replace_table(path.read_text(), make(cells), path.name) for path, make in TABLES.items()}
        for path, text in texts.items():
            changed = text != path.read_text()
            if changed:
                path.write_text(text)
            print(f"the table of {path.relative_to(ROOT)} {'is replaced' if changed else 'is up to date'}")
    except (OSError, ValueError) as error:
        print(f"plots.reproduced: {one_line(error)}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
