"""Writes a folder of results like that of the whole benchmark, with the real writer and invented returns.

python tests/synthetic.py DIR        13 algorithms x 16 conditions x 10 seeds, to measure the time of plot.py
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from tqdm import tqdm

from core.config import saved_settings
from plots.paper import COLORS, DEFAULT_BATCH, FAMILIES, read_paper
from store.folder import run_folder, variant_name
from store.writer import RunWriter
from sweep.cells import paper_config

CONDITIONS = list(dict.fromkeys((task, batch) for task, batch, _ in read_paper()))


def write_results(root, conditions=CONDITIONS, algos=tuple(COLORS), seeds=10, evaluations=None):
    """Write finished runs of `algos` under `conditions` (task, batch), with normal returns around the paper's mean.

    `evaluations`: the number of evaluations of each run; None for the full number.
    """
    rng = np.random.default_rng(0)
    for task, batch in tqdm(conditions, disable=None):
        paper = {algo: stat for (name, size, algo), stat in read_paper().items() if (name, size) == (task, batch)}
        mean_of_row = np.mean([stat.mean for stat in paper.values()])
        for algo in algos:
            config = paper_config(algo, task)
            overrides = {} if batch == DEFAULT_BATCH else {"batch_size": int(batch)}
            for key, value in overrides.items():
                setattr(config, key, value)
            mean, spread = (paper[algo].mean, paper[algo].se * 10**0.5) if algo in paper else (mean_of_row, 1.0)
            for seed in range(seeds):
                folder = run_folder(root, task, variant_name(algo, overrides), seed)
                writer = RunWriter(folder, saved_settings(config, seed), {"commit": None}, config.eval_episodes)
                final = rng.normal(mean, spread)
                for i in range(1, (evaluations or config.steps // config.eval_every) + 1):
                    step = i * config.eval_every
                    risen = final * (1 - np.exp(-6 * step / config.steps))
                    writer.append_evaluation(step, risen + spread * rng.normal(size=config.eval_episodes), step / 100)
                    if algo in FAMILIES["SAC family"] and step > config.learning_starts:
                        measures = {
                            "temperature": np.exp(-5 * step / config.steps + 0.1 * rng.normal()),
                            "entropy": -2.0,
                        }
                        writer.append_statistics(step, measures)
                writer.finish({"return_mean": final, "returns": final + spread * rng.normal(size=50)})


if __name__ == "__main__":
    write_results(sys.argv[1])
