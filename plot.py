"""Tables and figures of the benchmark.

    python plot.py results/          all runs of a folder of results or of published data (docs/data), finished or not:
                                       tables/rewards       mean and standard error over the finished runs
                                       tables/comparison    the same, beside the paper's values
                                       tables/adjusted      Reacher's returns without the luck of the starts
                                       tables/aggregate     interquartile mean over tasks, with intervals
                                       tables/improvement   probability that one algorithm is better than another
                                       figures/<task>       learning curves, also of runs in progress
                                       figures/<task>-training   return and training measures of all settings
                                       figures/aggregate, figures/improvement
    python plot.py results/ OTHER/=label ...   the same, with the runs of other folders or of CSV files (columns
                                     task,algorithm,seed,step,return) beside them, as "SRad (label)"
    python plot.py tables            tables/tasks and tables/hyperparameters, from the code's definitions
    python plot.py maps              figures/maps: the three feasibility maps, the paper's Figure 1
    python plot.py actions RUN       figures/actions-...: feasible set and executed actions over an episode with
                                     the best parameters of a run, such as results/R+L2/SRad/seed=0
    python plot.py runtime [FILE]    figures/runtime: bars of the times that bench/runtime.py saved
                                     (default bench/results/runtime.csv)

options: env=W+M,R+L2 and algo=DPre+,SRad   only these tasks and algorithms of the results (default all)
         paper=beside                       the paper's columns beside ours in tables/rewards
         out=DIR                            write below DIR (default: the folder of results, or results)
         format=md,csv,tex,png,pdf          only these formats (default all)
         plugin=my.py                       your own files that register tasks and algorithms
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import tables
from core.words import ConfigError, closest, known_name, parse_words, split_names
from plots import style
from plots.aggregates import aggregate, draw_aggregates, improvement_table, mean_table
from plots.conflicts import keep_apart
from plots.figures import draw_curves
from plots.grouping import DAGGER, Groups, group_runs, list_diverged, list_left_out
from plots.others import Source, cells_in, parse_sources, read_source
from plots.paper import COLORS, order_algos, order_tasks
from plots.rewards import comparison_table, reward_table
from plots.style import own_algos
from store.files import user_path
from store.output import forgiving_output
from sweep.plugins import load_plugins

RESULTS = "results"
RUNTIME = "bench/results/runtime.csv"


def plot_results(words: Sequence[str], options: dict[str, str]) -> list[Path]:
    """Plot all runs of one or several folders of results. Returns the files written."""
    if not words:
        raise ConfigError("expected a folder of results, got none")
    sources = parse_sources(words)
    formats = _formats(options, (*tables.FORMATS, *style.FORMATS))
    if "paper" in options:
        known_name("value of paper", options["paper"], ["beside"])
    groups = _read(sources, options)
    first = sources[0].path
    out = user_path(options.get("out", first if first.is_dir() else first.parent))
    aggregates = aggregate(groups)
    left_out = list_left_out(groups)
    diverged = list_diverged(groups)
    note = "Not in the tables:\n" + "".join(f"- {line}\n" for line in left_out) if left_out else ""
    if diverged:
        note += "\n" * bool(note) + f"{DAGGER} In the tables:\n" + "".join(f"- {line}\n" for line in diverged)
    own = own_algos(algo for by_algo in groups.values() for algo in by_algo)
    written = []
    # A screen shows the last lines, so the main table comes last.
    for table in (
        improvement_table(aggregates),
        mean_table(aggregates),
        *_tables_of_reacher(groups),
        comparison_table(groups),
        reward_table(groups, beside="paper" in options),
    ):
        if table.records:
            tables.print_table(table)
            written += tables.write_table(table, out / "tables", formats, note)
    if note:
        print(note)
    written += draw_curves(groups, own, out / "figures", formats)
    return written + draw_aggregates(aggregates, own, out / "figures", formats)


def _read(sources: Sequence[Source], options: dict[str, str]) -> Groups:
    """The runs in `sources` that the options ask for. Names the unusable ones on stderr."""
    found: list[tuple[str, str]] = []
    for root in (source.path for source in sources):
        if not root.is_dir() and root.suffix != ".csv":
            close = closest(str(root), COMMANDS)
            raise ConfigError(f"{root} is not a folder" + (f"; did you mean {close}?" if close else ""))
        found += cells_in(root)
    places = " ".join(str(source.path) for source in sources)
    tasks_there, algos_there = ({names[i] for names in found} for i in range(2))
    # The choices come from the folder, so a new task or algorithm needs no entry here.
    tasks = split_names(f"env in {places}", options.get("env", "all"), order_tasks(tasks_there))
    algos = order_algos(algos_there)
    of_paper = {"paper": [algo for algo in algos if algo in COLORS]}
    algos = split_names(f"algo in {places}", options.get("algo", "all"), algos, of_paper)
    runs, problems = [], []
    for source in sources:
        more, unreadable = read_source(source, tasks, algos)
        runs += more
        problems += unreadable
    runs, conflicts = keep_apart(runs)
    groups, repeated = group_runs(runs)
    for problem in problems + repeated:
        print(f"skipped {problem}", file=sys.stderr)
    for conflict in conflicts:
        print(f"note: {conflict}", file=sys.stderr)
    if not runs:
        raise ConfigError(f"no readable runs of these tasks and algorithms in {places}")
    return groups


# The functions below import late, because PyTorch and the simulators take seconds to load.


def _tables_of_reacher(groups: Groups) -> list[tables.Table]:
    """The table of Reacher's returns without the luck of the starts; an empty list without runs on Reacher."""
    if not any(condition.task.startswith("R+") for condition in groups):
        return []
    from plots.starts import adjusted_table

    return [adjusted_table(groups)]


def plot_tables(words: Sequence[str], options: dict[str, str]) -> list[Path]:
    from plots.definitions import hyperparameter_table, task_table

    _no_more(words)
    formats, out = _formats(options, tables.FORMATS), _out(options) / "tables"
    written = []
    for table in (task_table(), hyperparameter_table()):
        tables.print_table(table)
        written += tables.write_table(table, out, formats)
    return written


def plot_maps(words: Sequence[str], options: dict[str, str]) -> list[Path]:
    from plots.illustrations import draw_maps

    _no_more(words)
    return draw_maps(_out(options) / "figures", _formats(options, style.FORMATS))


def plot_actions(words: Sequence[str], options: dict[str, str]) -> list[Path]:
    from plots.illustrations import draw_actions

    run = _path(words, "folder of a run").absolute()
    out = user_path(options.get("out", run.parent.parent.parent))
    return draw_actions(run, out / "figures", _formats(options, style.FORMATS))


def plot_runtime(words: Sequence[str], options: dict[str, str]) -> list[Path]:
    from plots.runtime import draw_runtime

    file = _path(words or [RUNTIME], "file of bench/runtime.py")
    return draw_runtime(file, _out(options) / "figures", _formats(options, style.FORMATS))


def _out(options: dict[str, str]) -> Path:
    return user_path(options.get("out", RESULTS))


def _formats(options: dict[str, str], choices: Sequence[str]) -> list[str]:
    return split_names("format", options.get("format", "all"), choices)


def parse_arguments(arguments: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Words and options. Raises ConfigError for an unknown option, one given twice or without a value."""
    # The path of a run holds a "=" itself, after a "/".
    words = [a for a in arguments if "=" not in a or "/" in (path := a.partition("=")[0]) or path.endswith(".csv")]
    return words, parse_words((a for a in arguments if a not in words), ("env", "algo", "paper", "out", "format"))


def _path(words: Sequence[str], what: str) -> Path:
    if len(words) != 1:
        raise ConfigError(f"expected one {what}, got {len(words)}: {' '.join(words) or 'none'}")
    return user_path(words[0])


def _no_more(words: Sequence[str]) -> None:
    if words:
        raise ConfigError(f"unexpected {words[0]!r}")


COMMANDS = {"tables": plot_tables, "maps": plot_maps, "actions": plot_actions, "runtime": plot_runtime}


def run(arguments: Sequence[str]) -> list[Path]:
    """Run the command line. Returns the files written."""
    words, options = parse_arguments(load_plugins(arguments))
    if not words or words[0] not in COMMANDS:
        return plot_results(words, options)
    for key in ("env", "algo", "paper"):
        if key in options:
            raise ConfigError(f"{key}= applies to a folder of results, not to {words[0]}")
    return COMMANDS[words[0]](words[1:], options)


NAMED = 4
"""The last lines name the files of a folder if it has at most this many."""


def main(arguments: Sequence[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    with forgiving_output():
        return _carry_out(arguments)


def _carry_out(arguments: Sequence[str]) -> int:
    if not arguments or "--help" in arguments or "-h" in arguments:
        print(__doc__.strip())
        return 0
    try:
        written = run(arguments)
    except (ConfigError, OSError) as error:
        print(f"plot.py: {error}", file=sys.stderr)
        return 2
    for folder, count in Counter(path.parent for path in written).items():
        names = [path.name for path in written if path.parent == folder] if count <= NAMED else []
        print(f"{count} file{'s' * (count > 1)} in {folder}{': ' * bool(names)}{', '.join(names)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
