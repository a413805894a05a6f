"""Measures how long the cells of the table take, and writes sweep/rates.csv for the time estimates of sweeps.

    python bench/rates.py                                  # all cells: some 15 minutes on one core
    python bench/rates.py algo=SRad env=W+M out=rates.csv  # one cell, to another file

Each cell trains through 100 environment steps of warm-up and then 20 with one gradient step each, at the paper's batch
size, on one thread. The columns are the milliseconds of a gradient step and of an environment step of all ten seeds
together: CPU time, so that other load on the machine does not count.
"""

from __future__ import annotations

import csv
import os
import sys
import time
from contextlib import suppress
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from tqdm import tqdm

from bench.phases import Stopwatch, new_trainer
from core.config import Config
from core.words import ConfigError, parse_words
from sweep.cells import make_cells
from sweep.estimates import COLUMNS, RATES, SEEDS

WARM_UP, UPDATES = 100, 20
FIXED = {"steps": "10000", "learning_starts": str(WARM_UP), "train_freq": "1", "gradient_steps": "1"}


class _Enough(Exception):
    """Ends a training loop from within."""


def measure(config: Config) -> dict[str, object]:
    """Measure a cell; return its row of the file."""
    watch, ends = Stopwatch(time.process_time), []

    def stop_if_asked() -> None:  # the loop calls it between any two steps
        if len(watch.calls["update"]) == UPDATES:
            ends.append(watch.clock())
            raise _Enough

    with new_trainer(config, range(SEEDS), stop_if_asked) as trainer:
        start = watch.clock()
        with watch.watch(trainer, "take_gradient_step", "update"), suppress(_Enough):
            trainer.run()
    update = watch.seconds("update")
    return {
        "task": config.env,
        "algo": config.algo,
        "update_ms": f"{1e3 * update / UPDATES:.2f}",
        "step_ms": f"{1e3 * (ends[0] - start - update) / (WARM_UP + UPDATES):.2f}",
    }


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    options = {"algo": "paper", "env": "all", "out": str(RATES)}
    try:
        options |= parse_words(arguments, options)
        cells = make_cells({"algo": options["algo"], "env": options["env"]} | FIXED)
    except ConfigError as error:
        print(f"bench/rates.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    rows = [measure(cell.config) for cell in tqdm(cells, unit="cell")]
    with open(options["out"], "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
