"""The closed form of Reacher beside PyBullet: equality of bits, speed of a step, and share of the training time.

    python bench/reacher.py                       # needs PyBullet, that is, Python up to 3.11
    python bench/reacher.py steps=20000 seeds=1

Three tables:

- equality: among `steps` steps in seven kinds of episodes, the number with a differing bit in a joint angle or speed,
  the largest speed, and the share of steps at the limit of joint 1;
- microseconds of a step of one arm, and of many arms that step together;
- training of DRad on R+L2 for each number of `seeds` in lockstep: seconds in the environment and environment steps a
  second, with 10,000 random steps and 500 gradient steps a seed on one thread. The two simulators take turns.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import numpy as np

import envs
from core.words import ConfigError, parse_words, whole_number, whole_numbers
from envs.reacher import FLOATS, LIMIT, TORQUE, advance

EPISODE = 150
KINDS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "uniform": lambda rng: rng.uniform(-1, 1, (EPISODE, 2)),
    "constant": lambda rng: rng.choice([-1.0, 1.0], (1, 2)).repeat(EPISODE, 0),
    "bang-bang": lambda rng: rng.choice([-1.0, 1.0], (EPISODE, 2)),
    "bang-bang, held 20 steps": lambda rng: rng.choice([-1.0, 1.0], (8, 2)).repeat(20, 0)[:EPISODE],
    "none": lambda rng: np.zeros((EPISODE, 2)),
    "20-fold": lambda rng: 20 * rng.uniform(-1, 1, (EPISODE, 2)),
    "20-fold, held 20 steps": lambda rng: 20 * rng.choice([-1.0, 1.0], (8, 2)).repeat(20, 0)[:EPISODE],
}
"""Torques of an episode, in units of the task's largest torque."""
TRAINING = "algo=DRad env=R+L2 steps=10500 learning_starts=10000 eval_every=10500 final_episodes=5 threads=1"


def equality(steps: int) -> None:
    from envs.pybullet_reacher import PyBulletReacher

    bullet, rng = PyBulletReacher(), np.random.default_rng(0)
    print("torques                    steps   differing   largest speed   at the limit")
    for kind, torques in KINDS.items():
        differing = limited = count = 0
        fastest = 0.0
        while count < steps / len(KINDS):
            # Every second episode starts near the limit and spinning.
            near = count // EPISODE % 2
            state = (
                rng.uniform(-3.14, 3.14),
                rng.uniform(2.9, 3.14) if near else rng.uniform(-3.14, 3.14),
                *rng.uniform(-30, 30, 2) * near,
            )
            bullet.place(*state)
            for t1, t2 in (TORQUE * torques(rng)).tolist():
                limited += abs(state[1]) >= LIMIT
                state, wanted = advance(*state, t1, t2, FLOATS), bullet.advance(t1, t2)
                differing += state != wanted
                fastest = max(fastest, *map(abs, wanted[2:]))
                state = wanted
                count += 1
        print(f"{kind:24s} {count:7d} {differing:11d} {fastest:9.1f} rad/s {limited / count:13.1%}")
    bullet.close()


def speed() -> None:
    print("\nsimulator     arms   us a step and arm (a call for all; observation and reward included)")
    for simulator, counts in (("pybullet", (1,)), ("closed-form", (1, 10, 16, 60, 1000))):
        for count in counts:
            arms = [envs.make("R+N", simulator=simulator).robot for _ in range(count)]
            rng = np.random.default_rng(0)
            for arm in arms:
                arm.reset(rng)
            actions = rng.uniform(-1, 1, (count, 2))
            times = []
            for _ in range(10):
                repeats = max(1, 1000 // count)
                start = time.process_time()
                for _ in range(repeats):
                    type(arms[0]).step_together(arms, actions)
                times.append((time.process_time() - start) / repeats / count)
            print(f"{simulator:12s} {count:5d}   {1e6 * median(times):.1f}")
            for arm in arms:
                arm.close()


def training(seeds: list[int]) -> None:
    print("\nsimulator    seeds   environment, s   share of all   environment steps/s of all seeds   total, s")
    for count in seeds:
        for simulator in ("pybullet", "closed-form"):
            with tempfile.TemporaryDirectory() as folder:
                words = f"{TRAINING} seed=0-{count - 1} simulator={simulator} results={folder}".split()
                done = subprocess.run(
                    [sys.executable, "run.py", *words], cwd=sys.path[0], capture_output=True, text=True
                )
                if done.returncode:
                    raise SystemExit(done.stderr)
                result = json.loads(next(Path(folder).rglob("result.json")).read_text())
            seconds = result["seconds"]
            rate = count * result["steps"] / seconds["environment"]
            share = seconds["environment"] / seconds["total"]
            print(
                f"{simulator:12s} {count:5d} {seconds['environment']:16.2f} {share:14.1%} {rate:35.0f}"
                f" {seconds['total']:10.1f}"
            )


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    options = {"steps": "140000", "seeds": "1,10"}
    try:
        options |= parse_words(arguments, options)
        steps, seeds = whole_number("steps", options["steps"]), whole_numbers("seeds", options["seeds"])
    except ConfigError as error:
        print(f"bench/reacher.py: {error}", file=sys.stderr)
        return 2
    equality(steps)
    speed()
    training(seeds)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
