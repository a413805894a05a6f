"""Table and bar chart of the paper's runtime experiment, from the file that `bench/runtime.py` writes."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from core.words import ConfigError
from plots.grouping import statistic
from plots.paper import Statistic, order_algos
from plots.style import color_of, own_algos, plain, save
from tables import MISSING, Table, text_cells

COLUMNS = ("task", "algo", "batch", "trial", "seeds", "steps", "machine", "cpu_seconds", "gpu_seconds")
FIXED = ("task", "seeds", "steps", "machine")
"""Columns with one value in the whole file."""
BATCHES = (1, 16, 100)
"""The batch sizes in the paper's figure."""

Seconds = dict[tuple[str, int], list[tuple[float, float]]]
"""(algorithm, batch size) -> CPU and GPU seconds of each trial."""


def read_runtime(path: Path) -> list[dict]:
    """The rows of the file, with numbers parsed. Raises ConfigError if it is of another kind, empty or inconsistent."""
    if not path.is_file():
        raise ConfigError(f"{path} is not a file (bench/runtime.py makes it)")
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise ConfigError(f"{path} is not a file of bench/runtime.py (its columns are {', '.join(COLUMNS)})")
    records: list[dict] = []
    for row in rows:
        try:
            numbers: dict = {key: int(row[key]) for key in ("batch", "trial", "seeds", "steps")}
            numbers |= {key: float(row[key]) for key in ("cpu_seconds", "gpu_seconds")}
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{path}: row {len(records) + 1} lacks a number ({error})") from error
        records.append(row | numbers)
    if not records:
        raise ConfigError(f"{path} has no measurements")
    for key in FIXED:
        if len(values := sorted({str(record[key]) for record in records})) > 1:
            raise ConfigError(f"{path} mixes measurements with different {key}: {', '.join(values)}")
    return records


def _by_cell(records: Sequence[dict]) -> Seconds:
    seconds: Seconds = defaultdict(list)
    for record in records:
        seconds[record["algo"], record["batch"]].append((record["cpu_seconds"], record["gpu_seconds"]))
    return dict(seconds)


def _title(records: Sequence[dict], seconds: Seconds) -> str:
    first = records[0]
    counts = sorted({len(trials) for trials in seconds.values()})
    trials = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) + " trial" + "s" * (counts[-1] > 1)
    lockstep = f" of each of {first['seeds']} seeds in lockstep" if first["seeds"] > 1 else ""
    return f"{first['task']}: the first {first['steps']:,} gradient steps{lockstep}, mean of {trials}"


def runtime_table(path: Path) -> Table:
    """CPU plus GPU seconds of each algorithm and batch size: mean and standard error over trials."""
    records = read_runtime(path)
    seconds = _by_cell(records)
    batches = sorted({batch for _, batch in seconds})
    rows = []
    for algo in order_algos({algo for algo, _ in seconds}):
        totals = [[sum(trial) for trial in seconds.get((algo, batch), [])] for batch in batches]
        rows.append(text_cells(algo, *(_text(statistic(total)) if total else MISSING for total in totals)))
    title = f"Seconds, {_title(records, seconds)}, on {records[0]['machine']}"
    return Table("runtime", title, ["Algorithm", *(f"batch {batch}" for batch in batches)], 1, [rows], records)


def _text(stat: Statistic) -> str:
    return f"{stat.mean:.2f} ± {stat.se:.2f}" if stat.n > 1 else f"{stat.mean:.2f}"


def draw_runtime(path: Path, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw bars of each algorithm for the paper's batch sizes, or for all measured sizes if the paper's are missing."""
    records = read_runtime(path)
    seconds = _by_cell(records)
    measured = sorted({batch for _, batch in seconds})
    batches = [batch for batch in measured if batch in BATCHES] or measured
    algos = order_algos({algo for algo, _ in seconds})
    width = 0.85 / len(batches)
    figure = Figure(figsize=(2.5 + 0.75 * len(algos), 4.2), layout="constrained")
    axes = figure.add_subplot()
    ticks, labels = [], []
    for i, algo in enumerate(algos):
        for j, batch in enumerate(batches):
            if (algo, batch) not in seconds:
                continue
            x = i + (j - (len(batches) - 1) / 2) * width
            trials = seconds[algo, batch]
            cpu, gpu = (statistic(part).mean for part in zip(*trials, strict=True))
            color = color_of(algo, own_algos(algos))
            axes.bar(x, gpu, width * 0.9, color=color)
            axes.bar(x, cpu, width * 0.9, bottom=gpu, color=color, alpha=0.45)
            if len(trials) > 1:
                error = statistic([sum(trial) for trial in trials]).se
                axes.errorbar(x, cpu + gpu, error, color="black", linewidth=0.8)
            ticks.append(x)
            labels.append(str(batch))
    axes.set_xticks(ticks, labels, fontsize="x-small", rotation=90)
    axes.set_xlabel("Batch size and algorithm", labelpad=22)
    names = axes.secondary_xaxis(-0.09)
    names.set_xticks(range(len(algos)), algos, fontsize="small")
    names.tick_params(length=0)
    names.spines["bottom"].set_visible(False)
    axes.set_ylabel("Seconds (mean ± standard error)")
    axes.set_title(_title(records, seconds), fontsize="medium", wrap=True)
    axes.set_xlim(-0.7, len(algos) - 0.3)
    plain(axes)
    axes.grid(visible=False, axis="x")
    if any(record["gpu_seconds"] for record in records):
        handles = [Patch(color="grey", alpha=0.45, label="CPU"), Patch(color="grey", label="GPU")]
        axes.legend(handles=handles, frameon=False)
    return save(figure, folder, "runtime", formats)
