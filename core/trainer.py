"""The training loop: S seeds of one (algorithm, task) cell in one process.

Each seed follows its own schedule of rollouts and gradient steps, exactly as it would alone. What is shared is only
the arithmetic: seeds that owe gradient steps wait until all do, and then take them in one batch of matrix products.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from tqdm import tqdm

from core.agent import Agent
from core.config import Config
from core.evaluation import Evaluator
from core.random import stream_seed
from core.replay import Replay
from core.results import RunWriter


class Trainer:
    """Trains `agent` on its seeds and writes one run folder a seed."""

    def __init__(
        self,
        config: Config,
        agent: Agent,
        envs: Sequence[gymnasium.Env],
        make_env: Callable[[], gymnasium.Env],
        writers: Sequence[RunWriter],
        progress: bool = True,
    ):
        self.config, self.agent, self.writers = config, agent, writers
        self.seeds = agent.seeds
        self.envs = envs
        self.evaluator = Evaluator(make_env, self.seeds, config.eval_episodes)
        self.replay = Replay(
            self.seeds,
            min(config.buffer_size, config.steps),
            agent.obs_dim,
            agent.action_dim,
            agent.stores_centers,
        )
        count = len(self.seeds)
        self.steps = [0] * count
        self.rollout_steps = [0] * count
        self.owed = [0] * count  # gradient steps that a seed must take before it goes on collecting
        self.gradient_steps = [0] * count
        self.best: list[tuple[float, int, dict] | None] = [None] * count  # mean return, step, parameters
        self.results: dict[int, dict] = {}  # finished seeds, by position
        self.seconds = dict.fromkeys(("environment", "map", "update", "evaluation"), 0.0)
        self.started = time.perf_counter()
        self.progress = Progress(config, count, progress)

    def run(self) -> list[dict]:
        """Train every seed to the end; the results, one dict a seed. Whatever ends it early, parameters are saved."""
        try:
            self._begin()
            while len(self.results) < len(self.seeds):
                self._collect()
                self._learn()
        except BaseException:
            for i in set(range(len(self.seeds))) - self.results.keys():
                self.writers[i].save_parameters("last", self.agent.state(i))
            raise
        finally:
            self.progress.close()
            self.evaluator.close()
            for env in self.envs:
                env.close()
        return [self.results[i] for i in range(len(self.seeds))]

    def _begin(self) -> None:
        first = [
            env.reset(seed=stream_seed(seed, "environment"))[0] for env, seed in zip(self.envs, self.seeds, strict=True)
        ]
        self.obs = self._tensor(np.stack(first))
        self.center = self.agent.constraint.center(self.obs) if self.agent.stores_centers else None
        self.agent.start_rollout(range(len(self.seeds)))

    def _collect(self) -> None:
        """Step the environments of every seed that owes no gradient steps, until all unfinished seeds owe some."""
        while which := [i for i, owed in enumerate(self.owed) if not owed and i not in self.results]:
            self._step(which)

    def _learn(self) -> None:
        """Take the gradient steps that all unfinished seeds owe; finished seeds ride along, their result is out."""
        unfinished = [i for i in range(len(self.seeds)) if i not in self.results]
        count = min((self.owed[i] for i in unfinished), default=0)
        with self._timed("update"):
            for _ in range(count):
                self.agent.update(self.replay.sample(self.config.batch_size))
        for i in unfinished:
            self.owed[i] -= count
            self.gradient_steps[i] += count
            if not self.owed[i]:
                self.agent.start_rollout([i])

    def _step(self, which: Sequence[int]) -> None:
        """One environment step of the seeds `which`."""
        suggested, executed = self._act(which)
        actions = executed.numpy()
        arrived, reset_obs = self.obs.numpy().copy(), {}
        reward, terminated, ended = (np.zeros((len(self.seeds), 1), dtype=np.float32) for _ in range(3))
        with self._timed("environment"):
            for i in which:
                arrived[i], reward[i], terminated[i], truncated, _ = self.envs[i].step(actions[i])
                if terminated[i] or truncated:
                    ended[i] = True
                    reset_obs[i] = self.envs[i].reset()[0]

        stored = suggested if self.agent.placement == "environment" else executed
        next_obs = self._tensor(arrived)
        columns = [self.obs, stored, self._tensor(reward), self._tensor(terminated), next_obs]
        if self.agent.stores_centers:
            with self._timed("map"):
                next_center = self.agent.constraint.center(next_obs)
            columns += [self.center, next_center]
        self.replay.add(which, *columns)

        self.obs = next_obs
        for i, obs in reset_obs.items():
            self.obs[i] = self._tensor(obs)
        if self.agent.stores_centers:
            self.center = self.agent.constraint.center(self.obs) if reset_obs else next_center
        self._count_step(which, ended[:, 0])

    @torch.no_grad()
    def _act(self, which: Sequence[int]) -> tuple[torch.Tensor, torch.Tensor]:
        """Suggested and executed actions (seeds, d); only the rows `which` mean anything."""
        warm = [i for i in which if self.steps[i] < self.config.learning_starts]
        trained = [i for i in which if self.steps[i] >= self.config.learning_starts]
        suggested = torch.zeros(len(self.seeds), self.agent.action_dim)
        if warm:
            suggested[warm] = self.agent.warm_up(warm)[warm]
        if trained:
            suggested[trained] = self.agent.explore(self.obs, trained)[trained]
        with self._timed("map"):
            if trained:
                executed = self.agent.feasible(self.obs, suggested, self.center)
            if warm:
                pulled_back = self.agent.pull_back(self.obs, suggested, self.center)
                executed = torch.where(self._rows(warm), pulled_back, executed) if trained else pulled_back
        return suggested, executed

    def _rows(self, which: Sequence[int]) -> torch.Tensor:
        """Mask (seeds, 1) of the seeds `which`."""
        mask = torch.zeros(len(self.seeds), 1, dtype=torch.bool)
        mask[which] = True
        return mask

    def _count_step(self, which: Sequence[int], ended: np.ndarray) -> None:
        """Advance the counters of `which`: rollouts that end, evaluations and ends of training that are due."""
        config = self.config
        self.progress.advance(len(which), min(self.steps[i] for i in which))
        new_rollout = []
        for i in which:
            self.steps[i] += 1
            self.rollout_steps[i] += 1
            over = ended[i] if config.train_freq == "episode" else self.rollout_steps[i] == int(config.train_freq)
            if over:
                if self.steps[i] > config.learning_starts:
                    every_step = config.gradient_steps == -1
                    self.owed[i] = self.rollout_steps[i] if every_step else config.gradient_steps
                else:
                    new_rollout.append(i)
                self.rollout_steps[i] = 0
        if new_rollout:
            self.agent.start_rollout(new_rollout)
        finished = [i for i in which if self.steps[i] == config.steps]
        due = [i for i in which if self.steps[i] % config.eval_every == 0 or i in finished]
        if due:
            self._evaluate(due)
        if finished:
            self._finish(finished)

    def _evaluate(self, which: Sequence[int]) -> None:
        with self._timed("evaluation"):
            returns = self.evaluator.run(self.agent.policy(which), which, self.config.eval_episodes)
        statistics = self.agent.statistics()
        for i, seed_returns in zip(which, returns, strict=True):
            self.writers[i].append_evaluation(self.steps[i], seed_returns, time.perf_counter() - self.started)
            if statistics and self.gradient_steps[i]:
                self.writers[i].append_statistics(
                    self.steps[i], {name: float(values[i]) for name, values in statistics.items()}
                )
            mean = float(seed_returns.mean())
            if self.best[i] is None or mean > self.best[i][0] or math.isnan(self.best[i][0]):
                self.best[i] = mean, self.steps[i], self.agent.state(i)
                self.writers[i].save_parameters("best", self.best[i][2])
        self.progress.show_evaluation(float(returns.mean()), [best[0] for best in self.best if best])

    def _finish(self, which: Sequence[int]) -> None:
        """Write the last parameters, evaluate the best ones at length, and write the result."""
        last = {i: self.agent.state(i) for i in which}
        for i in which:
            self.writers[i].save_parameters("last", last[i])
            self.agent.load_state(i, self.best[i][2])
        policy = self.agent.policy(which)  # a copy of the best parameters
        for i in which:
            self.agent.load_state(i, last[i])
        self.progress.show_final_evaluation()
        with self._timed("evaluation"):
            returns = self.evaluator.run(policy, which, self.config.final_episodes)
        for i, seed_returns in zip(which, returns, strict=True):
            envs: list[Any] = [env.unwrapped for env in (self.envs[i], *self.evaluator.of_seed(i))]
            self.results[i] = {
                "return_mean": float(seed_returns.mean()),
                "returns": seed_returns,
                "best_step": self.best[i][1],
                "steps": self.steps[i],
                "gradient_steps": self.gradient_steps[i],
                "executed_actions": sum(env.executed_actions for env in envs),
                "largest_violation": max(env.largest_violation for env in envs),
                "seconds": self.seconds | {"total": time.perf_counter() - self.started},
                "seeds_in_lockstep": len(self.seeds),
            }
            self.writers[i].finish(self.results[i])

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32)

    @contextmanager
    def _timed(self, phase: str):
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] += time.perf_counter() - start


class Progress:
    """A bar over all seeds' environment steps. Warm-up has a bar of its own: its pace says nothing of training's."""

    def __init__(self, config: Config, seeds: int, shown: bool):
        self.warm_up = min(config.learning_starts, config.steps)
        self.name, self.seeds, self.shown = f"{config.algo} {config.env}", seeds, shown
        self.bars = [("warm-up", self.warm_up * seeds), ("training", (config.steps - self.warm_up) * seeds)]
        self.bar = self._next_bar()

    def _next_bar(self) -> tqdm:
        label, total = self.bars.pop(0)
        interval = 0.5 if sys.stderr.isatty() else 60.0  # seconds; a log file needs few lines
        return tqdm(
            total=total,
            desc=f"{self.name} {label}",
            unit="step",
            disable=not self.shown,
            smoothing=0.1,
            mininterval=interval,
            maxinterval=interval,
        )

    def advance(self, count: int, step: int) -> None:
        """Count `count` environment steps; `step` is how far the seed furthest behind had come."""
        if self.bars and step >= self.warm_up:
            self.bar.close()
            self.bar = self._next_bar()
        self.bar.update(count)

    def show_evaluation(self, last: float, best: Sequence[float]) -> None:
        self.bar.set_postfix(last=f"{last:.2f}", best=f"{np.mean(best):.2f}", refresh=False)

    def show_final_evaluation(self) -> None:
        self.bar.set_description(f"{self.name} final evaluation")

    def close(self) -> None:
        self.bar.close()
