"""A pendulum whose speed a control barrier function limits, beside the same agent without it.

    python bench/pendulum.py                        # needs Stable-Baselines3 (pip install -e '.[bench]')
    python bench/pendulum.py steps=1000 out=here.png

Trains SAC of Stable-Baselines3 for `steps` environment steps with and without `envs.Constrained`. Prints for both the
number of steps above the limit. The picture (docs/pendulum.png) shows the speed and return of each episode.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])

import gymnasium
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from constraints import InUnits, LinearConstraint
from core.words import ConfigError, parse_words, whole_number
from envs import Constrained
from plots.style import plain

LIMIT = 2.0  # rad/s
ROUNDING = 1e-6  # rad/s; actions and observations are float32
STEP = 0.05  # seconds
GRAVITY, MOTOR = 4.5 * STEP, 3.0 * STEP  # a step adds GRAVITY sin(angle) + MOTOR torque to the speed


class SpeedLimit(LinearConstraint):
    """In each step, the speed may cover at most half of the distance that is left to LIMIT or to -LIMIT."""

    def A(self, obs: Tensor) -> Tensor:
        return obs.new_tensor([[MOTOR], [-MOTOR]])

    def b(self, obs: Tensor) -> Tensor:
        fall, speed = GRAVITY * obs[..., 1], obs[..., 2]
        return torch.stack((0.5 * (LIMIT - speed) - fall, 0.5 * (LIMIT + speed) + fall), -1)


class Record(gymnasium.Wrapper):
    """Keeps the largest speed and the return of each episode, and counts the steps above the limit."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.speeds: list[float] = []
        self.returns: list[float] = []
        self.too_fast = 0

    def reset(self, **options):
        self.speeds.append(0.0)
        self.returns.append(0.0)
        return self.env.reset(**options)

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        speed = abs(float(obs[2]))
        self.too_fast += speed > LIMIT + ROUNDING
        self.speeds[-1] = max(self.speeds[-1], speed)
        self.returns[-1] += float(reward)
        return obs, reward, terminated, truncated, info


def make(limited: bool) -> Record:
    """A pendulum with so little gravity that the motor can hold it in any position."""
    env = gymnasium.make("Pendulum-v1", g=3.0)
    if limited:
        env = Constrained(env, InUnits(SpeedLimit(dim=1), env.action_space.low, env.action_space.high))
    return Record(env)


def train(limited: bool, steps: int) -> Record:
    """The record of a whole training, the random steps at its start included."""
    from stable_baselines3 import SAC

    env = make(limited)
    agent = SAC("MlpPolicy", env, learning_starts=500, policy_kwargs={"net_arch": [64, 64]}, seed=0, device="cpu")
    agent.learn(total_timesteps=steps)
    return env


def draw(records: dict[str, Record], path: Path) -> None:
    figure = Figure((8, 3), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (name, record), color in zip(records.items(), ("#1b6f3a", "#999999"), strict=True):
        ended = len(record.speeds) - 1  # the last episode has not ended
        episodes = np.arange(1, ended + 1)
        left.plot(episodes, record.speeds[:ended], color=color, label=name)
        right.plot(episodes, record.returns[:ended], color=color, label=name)
    left.axhline(LIMIT, color="#c8503c", linestyle="dashed", linewidth=1.0)
    left.set(xlabel="episode of the training", ylabel="largest speed (rad/s)", ylim=(0, None))
    right.set(xlabel="episode of the training", ylabel="return")
    plain(left)
    plain(right)
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(path, dpi=150)


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    options = {"steps": "8000", "out": "docs/pendulum.png"}
    try:
        options |= parse_words(arguments, options)
        steps = whole_number("steps", options["steps"], 400)
    except ConfigError as error:
        print(f"bench/pendulum.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    records = {name: train(limited, steps) for name, limited in (("speed limit", True), ("no limit", False))}
    for name, record in records.items():
        mean = np.mean(record.returns[-6:-1])
        print(
            f"{name}: {record.too_fast} of {steps} steps above {LIMIT} rad/s (largest speed {max(record.speeds):.6f});"
            f" return {mean:.1f} (mean of the last five episodes)"
        )
    draw(records, Path(options["out"]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
