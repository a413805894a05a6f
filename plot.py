"""Tables and figures from a folder of results.

    python plot.py results/ [env=W+M,R+L2] [algo=DPre+,SRad] [out=DIR] [format=md,csv,tex,png,pdf]

Reads whatever runs are there, finished or not, and writes
    tables/rewards     mean and standard error of the finished runs, best three of a row bold
    tables/comparison  the same beside the paper's table
    figures/<task>     learning curves, also of runs in progress
below the folder of results, or below `out`. Tables come as Markdown, CSV and LaTeX, figures as PNG and PDF;
`env`, `algo` and `format` restrict to some of them (`all` is the default).
"""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from core.config import RUN_KEYS, ConfigError, choose, split_names
from core.results import Run, find_runs, parse_variant, read_results

# The paper's algorithms in its order. A version with penalty is the darker shade of the one without; the TD3
# family is drawn solid, the SAC family dashed.
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
# Without constraints a penalty is zero and a projection the identity, so the paper trains one of each family.
SAME_WITHOUT_CONSTRAINT = dict.fromkeys(("DPro+", "DPre", "DPre+", "DOpt", "DOpt+"), "DPro") | {"SPre+": "SPre"}
PAPER_SEEDS = 10
FORMATS = ("md", "csv", "tex", "png", "pdf")
MISSING = "–"


class Statistic(NamedTuple):
    """Mean of n values with its standard error (NaN for n = 1)."""

    mean: float
    se: float
    n: int


class Condition(NamedTuple):
    """A row of the tables: a task and the settings that differ from the paper's, as `key=value, ...`."""

    task: str
    settings: str

    @property
    def label(self) -> str:
        return ", ".join(filter(None, self))


Groups = dict[Condition, dict[str, list[Run]]]
"""Runs by condition and algorithm: those of one group differ in nothing but the seed."""


class Cell(NamedTuple):
    lines: tuple[str, ...]
    """The first is the value; the others belong below it or, on one line, after it."""
    bold: bool = False
    missing: bool = False


@dataclass
class Table:
    name: str
    title: str
    header: list[str]
    labels: int
    """How many of the leading columns name the row."""
    sections: list[list[list[Cell]]]
    """Rows of cells; a rule separates the sections."""
    records: list[dict[str, Any]]
    """The same numbers in full, one record a cell, for CSV."""


# ---- grouping and statistics ----


def statistic(values: Sequence[float]) -> Statistic:
    array = np.asarray(values, dtype=np.float64)
    n = len(array)
    return Statistic(float(array.mean()), float(array.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan, n)


def group_runs(runs: Iterable[Run]) -> Groups:
    """Group the runs that differ in nothing but the seed.

    Usually a run's name tells what is special about it. Where the configurations of one name differ all the
    same (defaults that changed between the runs, say), the condition names the settings that do.
    """
    by_name: dict[tuple[str, str], dict[str, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        config = {key: value for key, value in run.config.items() if key not in RUN_KEYS}
        by_name[run.task, run.variant][json.dumps(config, sort_keys=True, default=str)].append(run)
    groups: Groups = defaultdict(dict)
    for (task, _), by_config in by_name.items():
        configs = [json.loads(text) for text in by_config]
        keys = {key for config in configs for key in config}
        differing = [key for key in keys if any(c.get(key) != configs[0].get(key) for c in configs)]
        for config, members in zip(configs, by_config.values(), strict=True):
            settings = members[0].overrides | {key: _text(config.get(key)) for key in differing}
            condition = Condition(task, ", ".join(f"{key}={value}" for key, value in sorted(settings.items())))
            groups[condition][members[0].algo] = sorted(members, key=lambda run: run.seed)
    return groups


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def reward_statistics(groups: Groups) -> dict[Condition, dict[str, Statistic]]:
    """Statistics over the finished seeds of each cell; cells and rows without any are left out."""
    statistics: dict[Condition, dict[str, Statistic]] = {}
    for condition, by_algo in groups.items():
        for algo, runs in by_algo.items():
            if returns := [run.result["return_mean"] for run in runs if run.result is not None]:
                statistics.setdefault(condition, {})[algo] = statistic(returns)
    return statistics


def best_three(means: dict[str, float]) -> set[str]:
    """The names with the three highest finite means, and any that ties with the third."""
    ranked = sorted((mean for mean in means.values() if math.isfinite(mean)), reverse=True)
    return {name for name, mean in means.items() if ranked and mean >= ranked[:3][-1]}


def learning_curve(runs: Sequence[Run]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps, mean over the seeds evaluated there, standard error (NaN with one seed); each of shape (n,)."""
    steps = np.unique(np.concatenate([run.evaluations.step for run in runs]))
    # Masked where a seed has no evaluation (yet); a return of NaN stays NaN and breaks the line.
    values = np.ma.array(np.zeros((len(runs), len(steps))), mask=True)
    for row, run in zip(values, runs, strict=True):
        row[np.searchsorted(steps, run.evaluations.step)] = run.evaluations.return_mean
    error = values.std(axis=0, ddof=1) / np.sqrt(values.count(axis=0))
    return steps, values.mean(axis=0).filled(math.nan), error.filled(math.nan)


def read_paper() -> dict[tuple[str, str, str], Statistic]:
    """The paper's Table "Average Rewards" by (task, batch, algorithm); batch is "16" or "default"."""
    with open(Path(__file__).parent / "core" / "paper_table.csv", newline="") as file:
        return {
            (row["task"], row["batch"], row["algo"]): Statistic(float(row["mean"]), float(row["se"]), PAPER_SEEDS)
            for row in csv.DictReader(file)
        }


def order_tasks(names: Iterable[str]) -> list[str]:
    """In the paper's order, tasks that it does not have after its own."""
    return _order(names, dict.fromkeys(task for task, _, _ in read_paper()))


def order_algos(names: Iterable[str]) -> list[str]:
    return _order(names, COLORS)


def _order(names: Iterable[str], known: Iterable[str]) -> list[str]:
    names = set(names)
    known = [name for name in known if name in names]
    return known + sorted(names.difference(known))


def order_conditions(conditions: Iterable[Condition]) -> list[list[Condition]]:
    """Sections of rows: the paper's own settings first, then one section for each other combination."""
    by_settings: dict[str, list[str]] = defaultdict(list)
    for task, settings in conditions:
        by_settings[settings].append(task)
    return [
        [Condition(task, settings) for task in order_tasks(tasks)] for settings, tasks in sorted(by_settings.items())
    ]


# ---- tables ----


def decimals(values: Iterable[float]) -> int:
    """As in the paper: two for Reacher's returns of some tens, none for those of hundreds and thousands."""
    return 2 if max((abs(value) for value in values if math.isfinite(value)), default=0) < 100 else 0


def reward_table(statistics: dict[Condition, dict[str, Statistic]]) -> Table:
    algos = order_algos({*COLORS, *(algo for row in statistics.values() for algo in row)})
    sections, records = [], []
    for conditions in order_conditions(statistics):
        rows = []
        for condition in conditions:
            row = statistics[condition]
            digits = decimals(stat.mean for stat in row.values())
            best = best_three({algo: stat.mean for algo, stat in row.items()})
            cells = [Cell(tuple(condition.label.split(", ")))]
            for algo in algos:
                same = SAME_WITHOUT_CONSTRAINT.get(algo) if condition.task == "R+N" else None
                if algo in row:
                    cells.append(Cell(_lines(row[algo], digits), algo in best))
                    record = condition._asdict() | {"algo": algo} | row[algo]._asdict()
                    records.append(record | {"best_three": int(algo in best)})
                else:
                    cells.append(Cell((f"as {same}" if same in row else MISSING,), missing=True))
            rows.append(cells)
        sections.append(rows)
    title = "Rewards: mean ± standard error over seeds (n where not ten), best three of a row bold"
    return Table("rewards", title, ["Condition", *algos], 1, sections, records)


def _lines(stat: Statistic, digits: int) -> tuple[str, ...]:
    error = f"± {stat.se:.{digits}f}" if stat.n > 1 else ""
    count = f"n={stat.n}" if stat.n != PAPER_SEEDS else ""
    return tuple(filter(None, (f"{stat.mean:.{digits}f}", error, count)))


def comparison_table(statistics: dict[Condition, dict[str, Statistic]]) -> Table:
    """Ours beside the paper's, for the cells that the paper has.

    Of the settings only the batch size chooses the paper's row; runs with others are compared too, as
    labelled.
    """
    paper = read_paper()
    sections, records = [], []
    for conditions in order_conditions(statistics):
        rows = []
        for condition in conditions:
            override = re.search(r"(?:^|, )batch_size=(\w+)", condition.settings)
            batch = override[1] if override else "default"
            for algo in order_algos(statistics[condition]):
                if (theirs := paper.get((condition.task, batch, algo))) is None:
                    continue
                ours = statistics[condition][algo]
                difference = ours.mean - theirs.mean
                joint = difference / math.hypot(ours.se, theirs.se)
                digits = decimals((ours.mean, theirs.mean))
                texts = [
                    condition.label,
                    algo,
                    " ".join(_lines(ours, digits)),
                    " ".join(_lines(theirs, digits)),
                    f"{difference:+.{digits}f}",
                    f"{joint:+.1f}" if ours.n > 1 else MISSING,
                ]
                rows.append([Cell((text,)) for text in texts])
                record = condition._asdict() | {"algo": algo} | ours._asdict()
                record |= {"paper_mean": theirs.mean, "paper_se": theirs.se}
                records.append(record | {"difference": difference, "joint_errors": joint})
        if rows:
            sections.append(rows)
    title = "Comparison with the paper; the last column is the difference in joint standard errors"
    header = ["Condition", "Algorithm", "Ours", "Paper", "Difference", "In joint s.e."]
    return Table("comparison", title, header, 2, sections, records)


def to_terminal(table: Table, bold: bool, width: int | None) -> str:
    """Plain text without the empty columns; those beyond `width` characters (None: no limit) go below."""
    rows = [row for section in table.sections for row in section]
    widths = [
        max([len(head), *(len(line) for row in rows for line in row[j].lines)]) for j, head in enumerate(table.header)
    ]
    labels = list(range(table.labels))
    blocks: list[list[int]] = [[*labels]]
    for j in range(table.labels, len(table.header)):
        if all(row[j].missing for row in rows):
            continue
        if width and len(blocks[-1]) > table.labels and sum(widths[i] + 2 for i in [*blocks[-1], j]) - 2 > width:
            blocks.append([*labels])
        blocks[-1].append(j)

    def line(block: list[int], texts: list[str], emphasis: list[bool]) -> str:
        padded = [
            text.ljust(widths[j]) if j < table.labels else text.rjust(widths[j])
            for j, text in zip(block, texts, strict=True)
        ]
        styled = [f"\x1b[1m{text}\x1b[0m" if on else text for text, on in zip(padded, emphasis, strict=True)]
        return "  ".join(styled).rstrip()

    output = [table.title]
    for block in blocks:
        rule = "─" * (sum(widths[j] + 2 for j in block) - 2)
        output += ["", line(block, [table.header[j] for j in block], [False] * len(block))]
        for section in table.sections:
            output.append(rule)
            for row in section:
                cells = [row[j] for j in block]
                for i in range(max(len(cell.lines) for cell in cells)):
                    texts = [cell.lines[i] if i < len(cell.lines) else "" for cell in cells]
                    output.append(line(block, texts, [bold and cell.bold and i == 0 for cell in cells]))
    return "\n".join(output) + "\n"


def to_markdown(table: Table) -> str:
    def cell(content: Cell) -> str:
        value, *rest = content.lines
        return " ".join([f"**{value}**" if content.bold else value, *rest])

    lines = [table.header, [":--" if j < table.labels else "--:" for j in range(len(table.header))]]
    lines += [[cell(content) for content in row] for section in table.sections for row in section]
    return f"{table.title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def to_latex(table: Table) -> str:
    """A document of one table that compiles as it stands; with package `standalone`, \\input takes it too."""

    def text(value: str) -> str:
        value = re.sub(r"([&%$#_{}])", r"\\\1", value)
        value = re.sub(r"(?<![\w-])-(?=[\d.])", "$-$", value)
        return value.replace("±", r"$\pm$").replace("–", "--")

    def line(texts: list[str]) -> str:
        return " & ".join(texts) + r" \\"

    alignment = "l" * table.labels + "r" * (len(table.header) - table.labels)
    body = [rf"\begin{{tabular}}{{{alignment}}}", r"\toprule"]
    if all(set(family) <= set(table.header) for family in FAMILIES.values()):
        first, spans, rules = table.labels, [""] * table.labels, ""
        for name, family in FAMILIES.items():
            spans.append(rf"\multicolumn{{{len(family)}}}{{c}}{{{name}}}")
            rules += rf"\cmidrule(lr){{{first + 1}-{first + len(family)}}}"
            first += len(family)
        body += [line(spans), rules]
    body.append(line([text(head) for head in table.header]))
    for section in table.sections:
        body.append(r"\midrule")
        for number, row in enumerate(section):
            height = max(len(cell.lines) for cell in row)
            if number and height > 1:
                body.append(r"\addlinespace")
            for i in range(height):
                texts = [text(cell.lines[i]) if i < len(cell.lines) else "" for cell in row]
                emphasis = [cell.bold and i == 0 for cell in row]
                body.append(line([rf"\textbf{{{t}}}" if on else t for t, on in zip(texts, emphasis, strict=True)]))
    body += [r"\bottomrule", r"\end{tabular}"]
    preamble = ["\\documentclass[border=4pt]{standalone}", "\\usepackage{booktabs}", "\\begin{document}"]
    return "\n".join([f"% {table.title}", *preamble, *body, r"\end{document}"]) + "\n"


def write_csv(path: Path, records: list[dict[str, Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)


def list_unfinished(groups: Groups) -> list[str]:
    """A line for each cell with runs that are in progress or were interrupted."""
    lines = []
    for condition in chain.from_iterable(order_conditions(groups)):
        for algo in order_algos(groups[condition]):
            runs = [run for run in groups[condition][algo] if not run.finished]
            if runs:
                reached = [run.evaluations.step.max(initial=0) for run in runs]
                span = " to ".join(f"{step:,}" for step in sorted({min(reached), max(reached)}))
                seeds = ", ".join(str(run.seed) for run in runs)
                total = runs[0].config.get("steps")
                of = f" of {total:,}" if isinstance(total, int) else ""
                lines.append(f"{condition.label} {algo}: seed {seeds}, evaluated to step {span}{of}")
    return lines


def write_tables(groups: Groups, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Print the tables and write them to `folder`; returns the files."""
    statistics = reward_statistics(groups)
    # On a screen the last lines are those in view, so the main table comes last.
    tables = [table for table in (comparison_table(statistics), reward_table(statistics)) if table.records]
    unfinished = list_unfinished(groups)
    note = "Not in the tables, for they are unfinished:\n" + "".join(f"- {line}\n" for line in unfinished)
    screen = sys.stdout.isatty()
    written = []
    for table in tables:
        print(to_terminal(table, bold=screen, width=shutil.get_terminal_size().columns if screen else None))
        for suffix in formats:
            path = folder / f"{table.name}.{suffix}"
            if suffix == "csv":
                write_csv(path, table.records)
            elif suffix == "md":
                path.write_text(to_markdown(table) + (f"\n{note}" if unfinished else ""), encoding="utf-8")
            else:
                path.write_text(to_latex(table), encoding="utf-8")
            written.append(path)
    if unfinished:
        print(note)
    return written


# ---- figures ----


def write_figures(groups: Groups, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw the learning curves of each condition into `folder`; returns the files."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import EngFormatter

    written = []
    for condition in chain.from_iterable(order_conditions(groups)):
        by_algo = {
            algo: runs for algo, runs in groups[condition].items() if any(len(run.evaluations.step) for run in runs)
        }
        if not by_algo:
            continue
        figure, axes = pyplot.subplots(figsize=(8.0, 4.5), layout="constrained")
        for algo in order_algos(by_algo):
            runs = by_algo[algo]
            steps, mean, error = learning_curve(runs)
            axes.plot(steps, mean, label=_legend(algo, runs), **_style(algo, len(steps)))
            axes.fill_between(steps, mean - error, mean + error, color=_style(algo, 0)["color"], alpha=0.15, lw=0)
        axes.set_title(condition.label)
        axes.set_xlabel("Environment steps")
        axes.set_ylabel("Evaluation return (mean ± standard error)")
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(loc="outside right upper", frameon=False)
        name = re.sub(r"[^\w+,=.\[\]-]+", "_", condition.label.replace(", ", ","))
        for suffix in formats:
            path = folder / f"{name}.{suffix}"
            figure.savefig(path, dpi=150)
            written.append(path)
        pyplot.close(figure)
    return written


def _legend(algo: str, runs: Sequence[Run]) -> str:
    finished = sum(run.finished for run in runs)
    if finished < len(runs):
        return f"{algo} ({finished} of {len(runs)} seed{'s' * (len(runs) > 1)} finished)"
    return algo if len(runs) == PAPER_SEEDS else f"{algo} (n={len(runs)})"


def _style(algo: str, points: int) -> dict[str, Any]:
    # A name that the paper does not have gets a grey that depends on nothing but the name.
    color = COLORS.get(algo) or str(0.3 + 0.4 * (sum(algo.encode()) % 8) / 7)
    line = "dashed" if algo in FAMILIES["SAC family"] else "solid" if algo in COLORS else "dashdot"
    return {"color": color, "linestyle": line, "linewidth": 1.5, "marker": "." if 0 < points < 20 else ""}


# ---- command line ----


def parse_arguments(arguments: Sequence[str]) -> tuple[Path, dict[str, str]]:
    """The folder of results and the options. Raises ConfigError for an unknown or repeated one."""
    folders: list[str] = []
    options: dict[str, str] = {}
    for word in arguments:
        key, equals, value = word.partition("=")
        if not equals or "/" in key:
            folders.append(word)
            continue
        choose("key", key, ("env", "algo", "out", "format"))
        if not value:
            raise ConfigError(f"expected {key}=value, got {word!r}")
        if key in options:
            raise ConfigError(f"key {key!r} given twice: {options[key]!r} and {value!r}")
        options[key] = value
    if len(folders) != 1:
        raise ConfigError(f"expected one folder of results, got {len(folders)}: {' '.join(folders) or 'none'}")
    return Path(folders[0]).expanduser(), options


def run(arguments: Sequence[str]) -> None:
    root, options = parse_arguments(arguments)
    formats = split_names("format", options.get("format", "all"), FORMATS)
    if not root.is_dir():
        raise ConfigError(f"{root} is not a folder")
    found = find_runs(root)
    if not found:
        raise ConfigError(f"no runs in {root} (looked for <task>/<algorithm>/seed=<n> in it)")
    tasks_there = {folder.parent.parent.name for folder in found}
    algos_there = {parse_variant(folder.parent.name)[0] for folder in found}
    # The choices are what there is, so that a new task or algorithm needs no entry here.
    tasks = split_names(f"env in {root}", options.get("env", "all"), order_tasks(tasks_there))
    algos = split_names(f"algo in {root}", options.get("algo", "all"), order_algos(algos_there))
    runs, problems = read_results(root, tasks, algos)
    for problem in problems:
        print(f"skipped {problem}", file=sys.stderr)
    if not runs:
        raise ConfigError(f"no readable runs of these tasks and algorithms in {root}")
    groups = group_runs(runs)
    out = Path(options.get("out", root))
    written = []
    for name, write, suffixes in (
        ("tables", write_tables, ("md", "csv", "tex")),
        ("figures", write_figures, ("png", "pdf")),
    ):
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        files = write(groups, folder, [suffix for suffix in formats if suffix in suffixes])
        if files:
            written.append(f"{len(files)} files in {folder}")
    print("\n".join(written))


def main(arguments: Sequence[str]) -> int:
    if not arguments or "--help" in arguments or "-h" in arguments:
        print(__doc__.strip())
        return 0
    try:
        run(arguments)
    except (ConfigError, OSError) as error:
        print(f"plot.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
