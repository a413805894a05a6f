"""The cost of `envs.Constrained`: microseconds of a step with and without it.

    python bench/wrapper.py
    python bench/wrapper.py steps=2000

Prints a row for each environment and set. Suggested actions are uniform in the box. Their share outside the set is
printed too, because feasible ones need no projection. The variants take turns; a number is the median CPU time over
rounds.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[0] = str(Path(__file__).resolve().parents[1])

import gymnasium
import torch

import envs
from bench.pendulum import SpeedLimit
from constraints import Constraint, InUnits
from core.words import ConfigError, parse_words, whole_number
from envs.wrapper import MAPPINGS, Constrained

ROUNDS = 3
PENDULUM = InUnits(SpeedLimit(dim=1), -2.0, 2.0)
ROWS: dict[str, tuple[Callable[[], gymnasium.Env], Constraint]] = {
    "Pendulum-v1, barrier function (rows of your own)": (lambda: gymnasium.make("Pendulum-v1", g=3.0), PENDULUM),
    "HalfCheetah-v5, HC+O (closed form)": (lambda: gymnasium.make("HalfCheetah-v5"), envs.constraint("HC+O")),
    "Walker2d-v5, W+M (closed form)": (lambda: gymnasium.make("Walker2d-v5"), envs.constraint("W+M")),
}


def round_of(env: gymnasium.Env, steps: int) -> tuple[float, float]:
    """CPU microseconds of a step, and the share of infeasible suggestions."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(steps)]
    spent, outside = 0.0, 0
    for action in actions:
        start = time.process_time()
        *_, terminated, truncated, info = env.step(action)
        spent += time.process_time() - start
        outside += info.get("violation", 0.0) > 0.0
        if terminated or truncated:
            env.reset()
    return 1e6 * spent / steps, outside / steps


def measure(make: Callable[[], gymnasium.Env], constraint: Constraint, steps: int) -> tuple[list[float], float]:
    """Microseconds of a step without the wrapper and with each mapping, and the share of infeasible suggestions."""
    variants = [make(), *(Constrained(make(), constraint, mapping) for mapping in MAPPINGS)]
    rounds = [[round_of(env, steps) for env in variants] for _ in range(ROUNDS)]
    return [median(each[k][0] for each in rounds) for k in range(len(variants))], rounds[0][1][1]


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    options = {"steps": "300"}
    try:
        steps = whole_number("steps", (options | parse_words(arguments, options))["steps"])
    except ConfigError as error:
        print(f"bench/wrapper.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    print(f"| environment and set | outside | without | {' | '.join(MAPPINGS)} |")
    print("|---" * (3 + len(MAPPINGS)) + "|")
    for name, (make, constraint) in ROWS.items():
        times, outside = measure(make, constraint, steps)
        print(f"| {name} | {100 * outside:.0f} % | {' | '.join(f'{value:.0f}' for value in times)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
