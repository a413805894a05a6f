"""Shows how much the starts of the final episodes change a return on Reacher, and that adjusting keeps its mean.

    python bench/starts.py results/R+L2/DPre/seed=0                  # the policy of a run
    python bench/starts.py results/R+L2/DPre/seed=0 seeds=0-99 episodes=20000

The run's best policy plays the final episodes of each of `seeds` (default 0-9) and `episodes` other episodes (default
5,000), whose mean return estimates the true mean. Prints a row for each seed: the difference of its mean return from
the true mean, plain and adjusted (`plots/starts.py`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import numpy as np

import envs
from algos import load_policy
from core.config import parse_seeds
from core.random import stream_seed
from core.words import ConfigError, parse_words, whole_number
from plots.starts import final_gains, mean_gain
from store.folder import read_run
from tables import Table, print_table, text_cells


def play(policy, environments: Sequence[envs.ActionConstrainedEnv]) -> np.ndarray:
    """The returns (k,) of one episode in each of k environments, after a reset. All episodes have the same length."""
    obs = np.stack([env.reset()[0] for env in environments])
    returns = np.zeros(len(environments))
    for _ in range(environments[0].robot.max_episode_steps):
        outcomes = envs.step_together(environments, policy(obs))
        obs = np.stack([outcome[0] for outcome in outcomes])
        returns += [outcome[1] for outcome in outcomes]
    return returns


def final_returns(policy, task: str, seed: int, evaluations: int, parallel: int, episodes: int) -> np.ndarray:
    """The returns (episodes,) of the policy in the final episodes of a run with `seed`."""
    environments = [envs.make(task) for _ in range(parallel)]
    for k, env in enumerate(environments):
        env.reset(seed=stream_seed(seed, "evaluation", k))
        for _ in range(evaluations):
            env.reset()
    rounds = [play(policy, environments[: min(parallel, episodes - i)]) for i in range(0, episodes, parallel)]
    return np.concatenate(rounds)


def main(argv: Sequence[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if argv else 2
    try:
        words = parse_words(argv[1:], ("seeds", "episodes"))
        seeds = parse_seeds(words.get("seeds", "0-9"))
        others = whole_number("episodes", words.get("episodes", "5000"))
        run = read_run(argv[0])
        if not run.task.startswith("R+") or run.result is None:
            raise ConfigError(f"{argv[0]} is no finished run on Reacher")
        policy = load_policy(argv[0])
    except (ConfigError, ValueError) as error:
        print(f"starts.py: {error}", file=sys.stderr)
        return 2
    (evaluations, parallel), episodes = run.evaluations.returns.shape, len(run.result["returns"])
    many = [envs.make(run.task) for _ in range(others)]
    for number, env in enumerate(many):
        env.reset(seed=stream_seed(number, "environment", 1))
    returns = play(policy, many)
    truth, error = returns.mean(), returns.std(ddof=1) / others**0.5
    rows, records = [], []
    for seed in seeds:
        plain = final_returns(policy, run.task, seed, evaluations, parallel, episodes)
        adjusted = plain - final_gains(run.task, seed, evaluations, parallel, episodes) + mean_gain()
        records.append({"seed": seed, "plain": plain.mean(), "adjusted": adjusted.mean()})
        rows.append(text_cells(str(seed), *(f"{values.mean() - truth:+.2f}" for values in (plain, adjusted))))
    title = f"{run.task} {run.algo}: mean of {episodes} episodes less the true mean, {truth:.2f} ± {error:.2f}"
    print_table(Table("starts", title, ["Seed", "Return", "Adjusted"], 1, [rows], records))
    for name in ("plain", "adjusted"):
        off = np.array([record[name] - truth for record in records])
        spread = off.std(ddof=1)
        print(f"{name}: mean {off.mean():+.2f} ± {spread / len(off) ** 0.5:.2f}, standard deviation {spread:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
