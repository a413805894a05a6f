"""How long the cells of the table take, for the estimates of sweeps: measures them and writes sweep/rates.csv.

    python bench/rates.py                                  # all cells: some 15 minutes on one core
    python bench/rates.py algo=SRad env=W+M out=rates.csv  # only these, elsewhere

Each cell trains through 100 environment steps of warm-up and then 20 with one gradient step each, at the paper's batch
size, on one thread. The columns are the milliseconds of a gradient step and of an environment step of all ten seeds
together: CPU time, so that other load on the machine does not count.
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from tqdm import tqdm

import run
from core.config import Config, ConfigError, choose, saved_settings
from store.folder import RunWriter
from store.interrupt import Interrupted
from sweep.estimates import COLUMNS, RATES, SEEDS

WARM_UP, UPDATES = 100, 20
FIXED = f"steps=10000 learning_starts={WARM_UP} train_freq=1 gradient_steps=1"


def measure(config: Config) -> dict[str, object]:
    """One row of the file."""

    def check() -> None:
        if trainer.seeds[0].gradient_steps == UPDATES:
            raise Interrupted(15)

    seeds = list(range(SEEDS))
    with tempfile.TemporaryDirectory() as folder:
        writers = [RunWriter(Path(folder, str(seed)), saved_settings(config, seed), {}, 1) for seed in seeds]
        trainer = run.make_trainer(config, seeds, writers, progress=False, check=check)
        trainer.stopwatch.clock = time.process_time
        start = time.process_time()
        try:
            trainer.run()
        except Interrupted:
            total = time.process_time() - start
    stepping = total - trainer.stopwatch.phases["update"] - trainer.stopwatch.phases["checkpoint"]
    return {
        "task": config.env,
        "algo": config.algo,
        "update_ms": f"{1e3 * trainer.stopwatch.phases['update'] / UPDATES:.2f}",
        "step_ms": f"{1e3 * stepping / trainer.seeds[0].steps:.2f}",
    }


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    options = {"algo": "all", "env": "all", "out": str(RATES)}
    try:
        for argument in arguments:
            key, _, value = argument.partition("=")
            options[choose("key", key, options)] = value
        cells = run.plan([f"algo={options['algo']}", f"env={options['env']}", *FIXED.split()])
    except ConfigError as error:
        print(f"bench/rates.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    rows = [measure(config) for config, _ in tqdm(cells, unit="cell")]
    with open(options["out"], "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
