"""How much of a return on Reacher lies in the starting positions: the gain that the best policy could make from them.

    python bench/starts.py                  # seeds 0 to 9
    python bench/starts.py seeds=0,3

A step's reward is 100 times the way that the fingertip comes closer to the target, less small costs. So no episode can
gain more than 100 times (distance at the start - distance at the arm's closest). The evaluation environments of a seed
draw the same positions for every algorithm. Prints, for each seed, the mean possible gain of the final 50 episodes and
of the 100 episodes in the evaluations of the last 1e5 steps of 3e5, at the paper's settings; then the means over seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path

# This folder is first in the path, but the project's packages are looked for.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import numpy as np

import envs
from core.random import stream_seed
from core.words import parse_words
from envs.reacher import LIMIT

UPPER, FORE = 0.1, 0.11
"""Lengths of the upper arm and of the forearm, fingertip included, in metres."""
LONGEST = UPPER + FORE
SHORTEST = float(np.sqrt(UPPER**2 + FORE**2 + 2 * UPPER * FORE * np.cos(LIMIT)))
"""The fingertip's distances from the shoulder, straight and with the elbow at its limit."""
PARALLEL, EVALUATIONS, LAST, FINAL = 5, 60, 20, 50
"""Episodes of an evaluation, which have an environment each; evaluations in all and in the last 1e5 steps; episodes of
the final evaluation."""


def possible_gain(obs: np.ndarray) -> np.ndarray:
    """100 times the way (...) that the fingertip can come closer to the target, for starts obs (..., 9)."""
    target = np.linalg.norm(obs[..., :2], axis=-1)
    out_of_reach = np.maximum(np.maximum(target - LONGEST, SHORTEST - target), 0.0)
    return 100.0 * (np.linalg.norm(obs[..., 2:4], axis=-1) - out_of_reach)


def starts(seed: int) -> np.ndarray:
    """Starts (resets, 5, 9) of the evaluation environments of `seed`, as `core.evaluation.Evaluator` resets them."""
    columns = []
    for index in range(PARALLEL):
        env = envs.make("R+N")
        env.reset(seed=stream_seed(seed, "evaluation", index))
        columns.append([env.reset()[0] for _ in range(EVALUATIONS + FINAL // PARALLEL)])
    return np.swapaxes(np.array(columns), 0, 1)


def main(words: list[str]) -> None:
    seeds = [int(seed) for seed in parse_words(words, ("seeds",)).get("seeds", "0,1,2,3,4,5,6,7,8,9").split(",")]
    print("seed  final 50  last 100")
    rows = []
    for seed in seeds:
        gain = possible_gain(starts(seed))
        rows.append((gain[EVALUATIONS:].mean(), gain[EVALUATIONS - LAST : EVALUATIONS].mean()))
        print(f"{seed:4d}  {rows[-1][0]:8.2f}  {rows[-1][1]:8.2f}")
    print("mean  {:8.2f}  {:8.2f}".format(*np.mean(rows, axis=0)))


if __name__ == "__main__":
    main(sys.argv[1:])
