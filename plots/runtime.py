"""The paper's figure "Training runtime for HalfCheetah" from what `bench/runtime.py` saved."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from core.config import ConfigError
from plots.grouping import statistic
from plots.paper import order_algos
from plots.style import color_of, plain, save

COLUMNS = ("task", "algo", "batch", "trial", "seeds", "steps", "machine", "cpu_seconds", "gpu_seconds")
FIXED = ("task", "seeds", "steps", "machine")
"""Columns that do not differ within one measurement."""
BATCHES = (1, 16, 100)
"""The paper's bars."""


def read_runtime(path: Path) -> list[dict]:
    """The rows of the file, numbers as such. Raises ConfigError for another kind of file, or an empty one."""
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise ConfigError(f"{path} is not a file of bench/runtime.py (its columns are {', '.join(COLUMNS)})")
    try:
        records: list[dict] = [
            {
                **row,
                **{key: int(row[key]) for key in ("batch", "trial", "seeds", "steps")},
                **{key: float(row[key]) for key in ("cpu_seconds", "gpu_seconds")},
            }
            for row in rows
        ]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: a row without its numbers ({error})") from error
    if not records:
        raise ConfigError(f"{path} has no measurements")
    for key in FIXED:
        if len(values := sorted({str(record[key]) for record in records})) > 1:
            raise ConfigError(f"{path} mixes measurements with different {key}: {', '.join(values)}")
    return records


def draw_runtime(path: Path, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Bars of each algorithm for the paper's batch sizes (for those measured, if none of them is)."""
    records = read_runtime(path)
    seconds: dict[tuple[str, int], list[tuple[float, float]]] = defaultdict(list)
    for record in records:
        seconds[record["algo"], record["batch"]].append((record["cpu_seconds"], record["gpu_seconds"]))
    measured = sorted({batch for _, batch in seconds})
    batches = [batch for batch in measured if batch in BATCHES] or measured
    algos = order_algos({algo for algo, _ in seconds})
    width = 0.85 / len(batches)
    figure = Figure(figsize=(2.0 + 0.75 * len(algos), 4.2), layout="constrained")
    axes = figure.add_subplot()
    ticks, labels = [], []
    for i, algo in enumerate(algos):
        for j, batch in enumerate(batches):
            if not (trials := seconds.get((algo, batch))):
                continue
            x = i + (j - (len(batches) - 1) / 2) * width
            cpu, gpu = (statistic(part).mean for part in zip(*trials, strict=True))
            error = statistic([sum(trial) for trial in trials]).se
            axes.bar(x, gpu, width * 0.9, color=color_of(algo))
            axes.bar(x, cpu, width * 0.9, bottom=gpu, color=color_of(algo), alpha=0.45)
            if len(trials) > 1:
                axes.errorbar(x, cpu + gpu, error, color="black", linewidth=0.8)
            ticks.append(x)
            labels.append(str(batch))
    axes.set_xticks(ticks, labels, fontsize="x-small", rotation=90)
    names = axes.secondary_xaxis(-0.09)
    names.set_xticks(range(len(algos)), algos, fontsize="small")
    names.spines["bottom"].set_visible(False)
    names.tick_params(length=0)
    first = records[0]
    count = {len(trials) for trials in seconds.values()}
    of = " to ".join(str(n) for n in sorted({min(count), max(count)}))
    lockstep = f" of each of {first['seeds']} seeds in lockstep" if first["seeds"] > 1 else ""
    axes.set_title(f"{first['task']}: the first {first['steps']:,} gradient steps{lockstep}, mean of {of} trials")
    axes.set_ylabel("Seconds")
    axes.set_xlabel("Batch size and algorithm", labelpad=24)
    plain(axes)
    axes.grid(visible=False, axis="x")
    if any(record["gpu_seconds"] for record in records):
        handles = [Patch(color="grey", alpha=0.45, label="CPU"), Patch(color="grey", label="GPU")]
        axes.legend(handles=handles, frameon=False)
    return save(figure, folder, "runtime", formats)
