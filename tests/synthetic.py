"""A folder of results as the whole benchmark leaves it, written by the real writer with invented returns.

python tests/synthetic.py DIR        13 algorithms x 16 conditions x 10 seeds, to measure plot.py on
"""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from tqdm import tqdm

from core.config import defaults, saved_settings
from plots.paper import COLORS, DEFAULT_BATCH, FAMILIES, read_paper
from store.folder import RunWriter, run_folder, variant_name

CONDITIONS = list(dict.fromkeys((task, batch) for task, batch, _ in read_paper()))
MAPPINGS = {"Alpha": "alpha", "Rad": "radial"}
ROBOTS = {"R": "Reacher", "HC": "HalfCheetah", "H": "Hopper", "W": "Walker2d"}


def write_results(root, conditions=CONDITIONS, algos=tuple(COLORS), seeds=10, evaluations=None):
    """Finished runs of `algos` under `conditions` (task, batch), returns normal around the paper's mean.

    `evaluations`: so many a run instead of all.
    """
    rng = np.random.default_rng(0)
    for task, batch in tqdm(conditions, disable=None):
        robot = ROBOTS[task.split("+")[0]]
        paper = {algo: stat for (name, size, algo), stat in read_paper().items() if (name, size) == (task, batch)}
        mean_of_row = np.mean([stat.mean for stat in paper.values()])
        for algo in algos:
            base = "SAC" if algo in FAMILIES["SAC family"] else "TD3"
            steps = 300_000 if robot == "Reacher" else 1_000_000
            mapping = MAPPINGS.get(algo[1:], "project")
            config = defaults(algo, task, robot, base, mapping, algo == "NFW", algo.endswith("+"), steps)
            overrides = {} if batch == DEFAULT_BATCH else {"batch_size": int(batch)}
            for key, value in overrides.items():
                setattr(config, key, value)
            mean, spread = (paper[algo].mean, paper[algo].se * 10**0.5) if algo in paper else (mean_of_row, 1.0)
            for seed in range(seeds):
                folder = run_folder(root, task, variant_name(algo, overrides), seed)
                writer = RunWriter(folder, saved_settings(config, seed), {"commit": None}, config.eval_episodes)
                final = rng.normal(mean, spread)
                for i in range(1, (evaluations or steps // config.eval_every) + 1):
                    step = i * config.eval_every
                    risen = final * (1 - np.exp(-6 * step / steps))
                    writer.append_evaluation(step, risen + spread * rng.normal(size=config.eval_episodes), step / 100)
                    if base == "SAC" and step > config.learning_starts:
                        measures = {"temperature": np.exp(-5 * step / steps + 0.1 * rng.normal()), "entropy": -2.0}
                        writer.append_statistics(step, measures)
                writer.finish({"return_mean": final, "returns": final + spread * rng.normal(size=50)})


if __name__ == "__main__":
    write_results(sys.argv[1])
