"""Checks that no infeasible action ever reaches a robot: every task, every map, the worst suggestions.

    python bench/soak.py                                   # a million steps of the simulators, ten million checks
    python bench/soak.py env=W+M,R+T steps=1e4 checks=1e5 seed=1

Suggestions come from random networks with exploding weights, from a list of extreme numbers (up to 3e38, denormal,
-0.0, infinite, NaN) and from the boundary of the set. In the simulators each is mapped and executed in float32, as in
training, and the environment checks it in float64. The checks without a simulator use observations that no robot
reaches: velocities that are zero, denormal or as large as 1e30, angles up to 7. (A map sees float32, which is too
coarse for the sine of larger angles, such as 1e5; the check in float64 would fail.) A suggestion that is not finite
must be refused with a clear message; every other one must be executed with a violation of at most 1e-6.

Prints the largest violation of each task and map. If one is too large, prints how to reproduce it and exits with 1.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path[0] = str(Path(__file__).resolve().parents[1])

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import envs
from core.networks import MLP
from core.words import ConfigError, parse_words, split_names, whole_number
from envs import TASKS, TOLERANCE, InfeasibleActionError

MAPS = ("project", "alpha_map", "radial_map", "gauge_map")
NETWORK_STEPS = 25  # steps between new networks
EXTREMES = [0.0, -0.0, 1e-45, -1e-45, 1e-38, 1e-20, -1e-8, 0.5, 1.0, -1.0, 1.0 + 1e-6, 3.0, -20.0, 1e5, 1e10, -1e30]
EXTREMES += [1e30, 3e38, -3e38]
ANGLES = {"Reacher": slice(7, 8), "Hopper": slice(2, 5), "HalfCheetah": slice(2, 8), "Walker2d": slice(2, 8)}
NOT_FINITE = [float("inf"), float("-inf"), float("nan")]


class Soak:
    """Runs and counts the checks of one task. `problems` has a line for each failure, with what reproduces it."""

    def __init__(self, task: str, seed: int, parallel: int):
        self.task, self.parallel, self.constraint = task, parallel, envs.constraint(task)
        self.robot, self.dim = TASKS[task].robot, TASKS[task].constraint.dim
        self.generator = torch.Generator().manual_seed(seed)
        self.executed = self.checked = self.refused = 0
        self.largest = dict.fromkeys(MAPS, -np.inf)
        self.problems: list[str] = []

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator)

    def pick(self, values: list[float], *shape: int) -> Tensor:
        return torch.tensor(values)[torch.randint(len(values), shape, generator=self.generator)]

    def chance(self, probability: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator) < probability

    def networks(self) -> MLP:
        """Actors side by side whose weights are between a hundredth and a million times the usual size."""
        actor = MLP([self.robot.obs_dim, 32, 32, self.dim], [self.generator] * self.parallel)
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter *= 10.0 ** (8 * torch.rand(self.parallel, 1, 1, generator=self.generator) - 2)
        return actor

    def spoil(self, obs: Tensor, suggested: Tensor) -> Tensor:
        """Suggestions (n, d), some of them replaced by extreme numbers and by points on or near the boundary."""
        n = len(suggested)
        suggested = torch.where(self.chance(0.5, n, 1), suggested, suggested.tanh())
        suggested = torch.where(self.chance(0.2, n, 1), self.pick(EXTREMES, n, self.dim), suggested)
        suggested = torch.where(self.chance(0.02, n, self.dim), self.pick(EXTREMES, n, self.dim), suggested)
        center = self.constraint.center(obs)
        direction = self.normal(n, self.dim)
        on_boundary = center + direction / self.constraint.gauge(obs, direction, center).unsqueeze(-1)
        beside = on_boundary * (1 + self.pick([0.0, 1e-7, -1e-7, 1e-6, 1e-3], n, 1))
        return torch.where(self.chance(0.1, n, 1) & beside.isfinite(), beside, suggested)

    def mapped(self, name: str, obs: Tensor, suggested: Tensor) -> Tensor:
        """Apply the map `name` to suggestions (n, d). For the gauge map, clamp them to the box first, as agents do."""
        if name == "gauge_map":
            suggested = suggested.clamp(-1.0, 1.0)
        return getattr(self.constraint, name)(obs, suggested)

    @torch.no_grad()
    def simulate(self, name: str, steps: int, progress: tqdm) -> None:
        """Take at least `steps` simulator steps in all, with the map `name`."""
        robots = [envs.make(self.task) for _ in range(self.parallel)]
        seeds = torch.randint(2**31, (self.parallel,), generator=self.generator).tolist()
        obs = np.stack([env.reset(seed=seed)[0] for env, seed in zip(robots, seeds, strict=True)])
        for step in range(-(-steps // self.parallel)):
            if step % NETWORK_STEPS == 0:
                actor = self.networks()
            seen = torch.from_numpy(obs).float()
            suggested = self.spoil(seen, actor(seen.unsqueeze(1)).squeeze(1))
            suggested[self.chance(0.01, self.parallel)] = self.pick(NOT_FINITE, 1)
            sound = suggested.isfinite().all(-1)
            executed = self.mapped(name, seen, torch.where(sound.unsqueeze(-1), suggested, 0.0)).numpy()
            for i, env in enumerate(robots):
                if not sound[i]:
                    self._expect_refusal(env, suggested[i].numpy())
                try:
                    obs[i], _, terminated, truncated, _ = env.step(executed[i])
                except InfeasibleActionError as error:
                    self._report(name, str(error), torch.from_numpy(obs[i]), suggested[i])
                    terminated = True
                if terminated or truncated or not np.isfinite(obs[i]).all():
                    obs[i] = env.reset()[0]
            progress.update(self.parallel)
        for env in robots:
            self.executed += env.executed_actions
            self.largest[name] = max(self.largest[name], env.largest_violation)
            env.close()

    def _expect_refusal(self, env: envs.ActionConstrainedEnv, action: np.ndarray) -> None:
        try:
            env.step(action)
            self.problems.append(f"{self.task}: {action} was executed")
        except InfeasibleActionError as error:
            if "is not finite" not in str(error):
                self.problems.append(f"{self.task}: {action} was refused for another reason: {error}")
            self.refused += 1

    @torch.no_grad()
    def check(self, name: str, count: int, progress: tqdm, batch: int = 2000) -> None:
        """Check the map `name` with `count` suggestions in all, at observations that no robot reaches."""
        for start in range(0, count, batch):
            n = min(batch, count - start)
            obs = self._observations(n)
            seen = obs.float()
            size = 10.0 ** (10 * torch.rand(n, 1, generator=self.generator) - 3)
            suggested = self.spoil(seen, size * self.normal(n, self.dim))
            mapped = self.mapped(name, seen, suggested)
            violation = self.constraint.violation(obs, mapped.double())
            self.checked += n
            self.largest[name] = max(self.largest[name], violation.max().item())
            for i in (~(violation <= TOLERANCE)).nonzero().flatten().tolist():
                self._report(name, f"violation {violation[i].item():.3g}", obs[i], suggested[i])
            progress.update(n)

    def _observations(self, n: int) -> Tensor:
        """Observations (n, obs_dim) in float64 with ordinary entries, extreme entries, or both."""
        width = self.robot.obs_dim
        size = 10.0 ** (3 * torch.rand(n, 1, generator=self.generator) - 2)
        ordinary = (size * self.normal(n, width)).double() * (1 + 1e-9)  # not representable in float32
        extreme = self.pick(EXTREMES, n, width).double().clamp(-1e30, 1e30)
        share = self.pick([0.0, 0.2, 1.0], n, 1)
        obs = torch.where(torch.rand(n, width, generator=self.generator) < share, extreme, ordinary)
        angles = ANGLES[self.robot.__name__]
        obs[:, angles] = obs[:, angles].clamp(-7.0, 7.0)
        return obs

    def _report(self, name: str, what: str, obs: Tensor, suggested: Tensor) -> None:
        self.problems.append(f"{self.task} {name}: {what}; obs={obs.tolist()} suggested={suggested.tolist()}")


def soak(tasks: list[str], steps: int, checks: int, seed: int, parallel: int = 50, progress: bool = True) -> list[Soak]:
    """Check `steps` simulated and `checks` unsimulated actions, shared among the tasks and maps.

    `parallel` environments of a task step together, each with its own network."""
    share = len(tasks) * len(MAPS)
    soaks = []
    torch.set_flush_denormal(True)  # as run.py does
    with tqdm(total=steps + checks, unit="action", smoothing=0.01, disable=not progress) as bar:
        for task in tasks:
            soaks.append(Soak(task, seed, parallel))
            for name in MAPS:
                bar.set_description(f"{task} {name}")
                soaks[-1].simulate(name, -(-steps // share), bar)
                soaks[-1].check(name, -(-checks // share), bar)
    return soaks


def parse_arguments(arguments: list[str]) -> tuple[list[str], int, int, int]:
    """Tasks, steps, checks and seed that the `key=value` words ask for. Raises ConfigError for a wrong one."""
    options = {"env": "all", "steps": "1e6", "checks": "1e7", "seed": "0"}
    options |= parse_words(arguments, options)
    steps, checks, seed = (whole_number(key, options[key], least=0) for key in ("steps", "checks", "seed"))
    return split_names("task", options["env"], TASKS), steps, checks, seed


def main(arguments: list[str]) -> int:
    """Exit code: 0 no violation, 1 violations, 2 bad input."""
    try:
        tasks, steps, checks, seed = parse_arguments(arguments)
    except ConfigError as error:
        print(f"bench/soak.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    soaks = soak(tasks, steps, checks, seed)
    print(f"{'largest violation':17s} " + " ".join(f"{name:>12s}" for name in MAPS))
    for result in soaks:
        print(f"{result.task:17s} " + " ".join(f"{result.largest[name]:12.1e}" for name in MAPS))
    counts = {what: sum(getattr(result, what) for result in soaks) for what in ("executed", "checked", "refused")}
    print(", ".join(f"{count:,} {what}" for what, count in counts.items()))
    problems = [problem for result in soaks for problem in result.problems]
    for result in soaks:
        for problem in result.problems[:10]:
            print(problem)
    print(f"{len(problems)} problems")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
