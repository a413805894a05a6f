"""The training loop: S seeds of one (algorithm, task) cell in one process.

Each seed follows its own schedule of rollouts and gradient steps, exactly as it would alone. What is shared is only
the arithmetic: seeds that owe gradient steps wait until all do, and then take them in one batch of matrix products.
"""

from __future__ import annotations

import math
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from tqdm import tqdm

from core.agent import Agent
from core.config import Config
from core.cuda_graph import GradientSteps
from core.evaluation import Evaluator
from core.random import stream_seed
from core.replay import Batch, Replay
from envs import InfeasibleActionError, step_together
from store.checkpoint import Checkpoint, CheckpointFolder
from store.files import one_line
from store.folder import RunWriter, has_failed, is_finished
from store.interrupt import Interrupted

COUNTERS = ("steps", "rollout_steps", "owed", "gradient_steps", "evaluated")


class Trainer:
    """Trains `agent` on its seeds and writes one run folder a seed.

    `check` is called between any two steps; it raises Interrupted to end the training there, with a checkpoint.
    """

    def __init__(
        self,
        config: Config,
        agent: Agent,
        envs: Sequence[Any],
        make_env: Callable[[], gymnasium.Env],
        writers: Sequence[RunWriter],
        progress: bool = True,
        check: Callable[[], None] = lambda: None,
    ):
        self.config, self.agent, self.writers, self.check = config, agent, writers, check
        self.seeds = agent.seeds
        self.envs = envs
        self.evaluator = Evaluator(make_env, self.seeds, config.eval_episodes, check)
        self.replay = Replay(
            self.seeds,
            min(config.buffer_size, config.steps),
            agent.obs_dim,
            agent.action_dim,
            agent.stores_centers,
            agent.device,
        )
        self.take_gradient_step = GradientSteps(agent, self.replay, config.batch_size)
        count = len(self.seeds)
        # Each seed's counters:
        self.steps = [0] * count
        self.rollout_steps = [0] * count
        self.owed = [0] * count  # gradient steps that a seed must take before it goes on collecting
        self.gradient_steps = [0] * count
        self.evaluated = [0] * count  # the step of the last evaluation
        self.best: list[tuple[float, int, dict] | None] = [None] * count  # mean return, step, parameters
        # How seeds have ended, by position. They ride along in the batch, without an effect on their neighbours.
        self.results: dict[int, dict] = {}
        self.failures: dict[int, dict] = {}
        self.recorded: set[int] = set()  # those of them whose folder says so
        self.obs = torch.zeros(count, agent.obs_dim)
        self.center = torch.zeros(count, agent.action_dim) if agent.stores_centers else None
        self.checkpoints = [CheckpointFolder(writer.folder) for writer in writers]
        self.began = False
        self.steps_at_checkpoint = 0  # of all seeds together
        self.seconds = dict.fromkeys(("environment", "acting", "update", "evaluation", "checkpoint"), 0.0)
        self.started = time.perf_counter()
        self.show_progress = progress

    def run(self) -> list[dict | None]:
        """Train every seed to the end; the results, one dict a seed, None for those in `failures`.

        After an Interrupted, everything is in a checkpoint; whatever ends it early, the last parameters are saved.
        """
        self.progress = Progress(self.config, self.steps, self.show_progress)
        try:
            if not self.began:
                self._begin()
            while live := self._live():
                self.check()
                if sum(self.steps) - self.steps_at_checkpoint >= self.config.checkpoint_every * len(live):
                    self._checkpoint()
                self._advance(live)
        except BaseException as error:
            if isinstance(error, Interrupted):
                self._checkpoint()
            self._save_last()
            raise
        finally:
            self.progress.close()
            self.evaluator.close()
            for env in self.envs:
                env.close()
        for folder in self.checkpoints:
            folder.remove()
        return [self.results.get(i) for i in range(len(self.seeds))]

    def _live(self) -> list[int]:
        """The positions of the seeds that have not ended; the folders of the others say so from here on."""
        if not self._ended() <= self.recorded:
            self._record_ends()
        return [i for i in range(len(self.seeds)) if i not in self._ended()]

    def _ended(self) -> set[int]:
        return self.results.keys() | self.failures.keys()

    def _begin(self) -> None:
        self.began = True
        for i, (env, seed) in enumerate(zip(self.envs, self.seeds, strict=True)):
            self.obs[i] = self._tensor(env.reset(seed=stream_seed(seed, "environment"))[0])
        self.center = self.agent.centers(self.obs)
        self.agent.start_rollout(range(len(self.seeds)))

    def _advance(self, live: Sequence[int]) -> None:
        """Do what comes next for the seeds that have not ended.

        It depends on the state alone, so that training goes on from a checkpoint between any two calls as it would
        have without.
        """
        config = self.config
        due = [
            i
            for i in live
            if self.steps[i] > self.evaluated[i]
            and (self.steps[i] % config.eval_every == 0 or self.steps[i] == config.steps)
        ]
        if due:
            self._evaluate(due)
        elif finished := [i for i in live if self.steps[i] == config.steps]:
            self._finish(finished)
        elif collecting := [i for i in live if not self.owed[i]]:
            self._step(collecting)
        else:
            self._update(live)

    def _update(self, live: Sequence[int]) -> None:
        """One gradient step: all seeds that have not ended owe some."""
        with self._timed("update"):
            self.take_gradient_step()
            for i in live:
                self.owed[i] -= 1
                self.gradient_steps[i] += 1
            # To ask a GPU is to wait for it, so it is asked at the end of a block; what is not finite stays so.
            if self.agent.device.type == "cpu" or not all(self.owed[i] for i in live):
                for i, quantity in self.agent.diverged().items():
                    self._fail(i, f"{quantity} is not finite")
        if done := [i for i in live if not self.owed[i]]:
            self.agent.start_rollout(done)

    def _step(self, which: Sequence[int]) -> None:
        """One environment step of the seeds `which`."""
        with self._timed("acting"):
            starts = self.config.learning_starts
            warming_up = [i for i in which if self.steps[i] < starts]
            exploring = [i for i in which if self.steps[i] >= starts]
            action = self.agent.act(self.obs, self.center, warming_up, exploring)
        actions = action.executed.numpy()
        arrived, reset_obs = self.obs.numpy().copy(), {}
        reward, terminated, ended = (np.zeros((len(self.seeds), 1), dtype=np.float32) for _ in range(3))
        with self._timed("environment"):
            finite = np.isfinite(action.stored.numpy()).all(-1)
            for i in which:
                if not finite[i]:
                    self._fail(i, f"action {action.stored[i].tolist()} is not finite")
            which = [i for i in which if finite[i]]
            outcomes = step_together([self.envs[i] for i in which], actions[which])
            for i, outcome in zip(which, outcomes, strict=True):
                if isinstance(outcome, InfeasibleActionError):
                    self._fail(i, str(outcome))
                    continue
                obs, reward[i], terminated[i], truncated, _ = outcome
                if not (np.isfinite(obs).all() and np.isfinite(reward[i])):
                    self._fail(i, "observation or reward is not finite")
                    continue
                arrived[i] = obs
                if terminated[i] or truncated:
                    ended[i] = True
                    reset_obs[i] = self.envs[i].reset()[0]
        which = [i for i in which if i not in self.failures]
        if not which:
            return

        next_obs = self._tensor(arrived)
        with self._timed("acting"):
            next_center = self.agent.centers(next_obs)
        rewards, ends = self._tensor(reward), self._tensor(terminated)
        self.replay.add(which, Batch(self.obs, action.stored, rewards, ends, next_obs, self.center, next_center))

        self.obs = next_obs
        for i, obs in reset_obs.items():
            self.obs[i] = self._tensor(obs)
        self.center = self.agent.centers(self.obs) if reset_obs else next_center
        self._count_step(which, ended[:, 0])

    def _count_step(self, which: Sequence[int], ended: np.ndarray) -> None:
        """Advance the counters of `which`: rollouts that end, evaluations and ends of training that are due."""
        config = self.config
        self.progress.advance(len(which), min(self.steps[i] for i in which))
        new_rollout = []
        for i in which:
            self.steps[i] += 1
            self.rollout_steps[i] += 1
            over = ended[i] if config.train_freq == "episode" else self.rollout_steps[i] == config.train_freq
            if over:
                if self.steps[i] > config.learning_starts:
                    every_step = config.gradient_steps == -1
                    self.owed[i] = self.rollout_steps[i] if every_step else config.gradient_steps
                else:
                    new_rollout.append(i)
                self.rollout_steps[i] = 0
        if new_rollout:
            self.agent.start_rollout(new_rollout)

    def _evaluate(self, which: Sequence[int]) -> None:
        """Evaluate the seeds `which`, those apart whose parameters or actions are not finite."""
        which = [i for i in which if not self._fail_if_infinite(i)]
        if not which:
            return
        with self._timed("evaluation"):
            returns = self.evaluator.run(self._policy(which), which, self.config.eval_episodes)
        statistics = self.agent.statistics()
        for i, seed_returns in zip(which, returns, strict=True):
            if i in self.evaluator.refused:
                self._fail(i, f"evaluation: {self.evaluator.refused[i]}")
                continue
            self.evaluated[i] = self.steps[i]
            self.writers[i].append_evaluation(self.steps[i], seed_returns, self._elapsed())
            if statistics and self.gradient_steps[i]:
                self.writers[i].append_statistics(
                    self.steps[i], {name: float(values[i]) for name, values in statistics.items()}
                )
            mean = float(seed_returns.mean())
            if self.best[i] is None or mean > self.best[i][0] or math.isnan(self.best[i][0]):
                self.best[i] = mean, self.steps[i], self.agent.state(i)
                self.writers[i].save_parameters("best", self.best[i][2])
        self.progress.show_evaluation(float(returns.mean()), [best[0] for best in self.best if best])

    def _policy(self, which: Sequence[int]) -> Callable[[torch.Tensor], torch.Tensor]:
        """The present deterministic policy of the seeds `which`, from and to the CPU."""
        policy = self.agent.policy(which)
        return lambda obs: policy(obs.to(self.agent.device)).cpu()

    def _finish(self, which: Sequence[int]) -> None:
        """Save the last parameters and evaluate the best ones at length, for the result."""
        last = {i: self.agent.state(i) for i in which}
        try:
            for i in which:
                self.agent.load_state(i, self.best[i][2])
            policy = self._policy(which)  # a copy of the best parameters
        finally:
            for i in which:
                self.agent.load_state(i, last[i])
        self.progress.show_final_evaluation()
        with self._timed("evaluation"):
            returns = self.evaluator.run(policy, which, self.config.final_episodes)
        for i, seed_returns in zip(which, returns, strict=True):
            if i in self.evaluator.refused:
                self._fail(i, f"final evaluation: {self.evaluator.refused[i]}")
                continue
            self.results[i] = {
                "return_mean": float(seed_returns.mean()),
                "returns": seed_returns.tolist(),
                "best_step": self.best[i][1],
                **self._counts(i),
                "seeds_in_lockstep": len(self.seeds),
            }

    def _counts(self, i: int) -> dict[str, Any]:
        envs = [env.unwrapped for env in (self.envs[i], *self.evaluator.of_seed(i))]
        return {
            "steps": self.steps[i],
            "gradient_steps": self.gradient_steps[i],
            "executed_actions": sum(env.executed_actions for env in envs),
            # (no number before the first action: JSON has no infinity)
            "largest_violation": max((env.largest_violation for env in envs if env.executed_actions), default=None),
            "seconds": self.seconds | {"total": self._elapsed()},
        }

    def _fail_if_infinite(self, i: int) -> bool:
        name = self.agent.infinite_parameter(i)
        if name is not None:
            self._fail(i, f"parameter {name} is not finite")
        return name is not None

    def _fail(self, i: int, reason: str) -> None:
        """End the seed in position i, which diverged; its neighbours notice nothing."""
        if i not in self._ended():
            self.writers[i].save_parameters("last", self.agent.state(i))
            last = self.best[i] and self.writers[i].last_finite_evaluation()
            self.failures[i] = {"step": self.steps[i], "quantity": reason, "last_evaluation": last, **self._counts(i)}
        self.agent.clear(i)

    def _record_ends(self) -> None:
        """Tell the folders of the seeds that have ended. A checkpoint knows it first: until all seeds have ended, each
        may be needed once more, for the batch to be the same."""
        self._checkpoint()
        for i in self._ended() - self.recorded:
            if i in self.results:
                self.writers[i].save_parameters("last", self.agent.state(i))
                self.writers[i].finish(self.results[i])
            else:
                self.writers[i].fail(self.failures[i])
            self.recorded.add(i)

    def _save_last(self) -> None:
        """Save the last parameters of every seed that has not ended; what cannot be written is said and left."""
        for i in set(range(len(self.seeds))) - self._ended():
            try:
                self.writers[i].save_parameters("last", self.agent.state(i))
            except OSError as error:
                print(f"{error.filename}: last parameters not saved: {one_line(error)}", file=sys.stderr)

    def _checkpoint(self) -> None:
        """Write a checkpoint of every seed. Where that fails, the one before stays, and training goes on."""
        self.steps_at_checkpoint = sum(self.steps)
        with self._timed("checkpoint"):
            for i in range(len(self.seeds)):
                if i not in self._ended():
                    self._fail_if_infinite(i)
            moment = uuid.uuid4().hex
            try:
                for i, folder in enumerate(self.checkpoints):
                    settings = self.writers[i].config
                    stored = partial(self.replay.stretch, i), self._oldest(i), self.replay.added[i]
                    folder.write(moment, self.seeds, self.steps[i], settings, self._state(i), *stored)
                for folder in self.checkpoints:
                    folder.keep()
            except OSError as error:
                print(f"no checkpoint at step {max(self.steps)}: {one_line(error)}", file=sys.stderr)
                for folder in self.checkpoints:
                    with suppress(OSError):
                        folder.discard()

    def _state(self, i: int) -> dict[str, Any]:
        """Everything about the seed in position i but its transitions."""
        return {
            "counters": {name: getattr(self, name)[i] for name in COUNTERS},
            "best": self.best[i],
            "result": self.results.get(i),
            "failure": self.failures.get(i),
            "obs": self.obs[i].clone(),
            "center": None if self.center is None else self.center[i].clone(),
            "agent": self.agent.training_state(i),
            "environment": self.envs[i].unwrapped.get_state(),
            "evaluator": self.evaluator.get_state(i),
            "added": self.replay.added[i],
            "sampling": self.replay.streams.generators[i].get_state(),
            "tables": self.writers[i].tables(),
            "seconds": self.seconds | {"total": self._elapsed()},
        }

    def restore(self, checkpoints: Sequence[Checkpoint]) -> None:
        """Take up the training where `checkpoints`, one of each seed and all of one moment, were written."""
        for i, checkpoint in enumerate(checkpoints):
            state = checkpoint.state()
            for name in COUNTERS:
                getattr(self, name)[i] = state["counters"][name]
            self.best[i] = state["best"]
            for ends, end in ((self.results, state["result"]), (self.failures, state["failure"])):
                if end is not None:
                    ends[i] = end
            self.obs[i] = state["obs"]
            if self.center is not None:
                self.center[i] = state["center"]
            self.agent.load_training_state(i, state["agent"])
            self.envs[i].unwrapped.set_state(state["environment"])
            self.evaluator.set_state(i, state["evaluator"])
            self.replay.added[i] = state["added"]
            self.replay.streams.generators[i].set_state(state["sampling"])
            checkpoint.fill(partial(self.replay.stretch, i), self._oldest(i))
            self.checkpoints[i].resume(checkpoint)
            self.writers[i].restore_tables(state["tables"])
            if self.best[i]:
                self.writers[i].save_parameters("best", self.best[i][2])
            folder = self.writers[i].folder
            if (i in self.results and is_finished(folder)) or (i in self.failures and has_failed(folder)):
                self.recorded.add(i)
        total = state["seconds"].pop("total")
        self.seconds, self.started = state["seconds"], time.perf_counter() - total
        self.steps_at_checkpoint = sum(self.steps)
        self.began = True

    def _oldest(self, i: int) -> int:
        """The first transition of the seed in position i that the replay buffer still holds."""
        return max(0, self.replay.added[i] - self.replay.capacity)

    def _elapsed(self) -> float:
        """Seconds of training so far, without the time between an end and a resumption."""
        return time.perf_counter() - self.started

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

    def __init__(self, config: Config, steps: Sequence[int], shown: bool):
        self.warm_up = min(config.learning_starts, config.steps)
        self.name, self.shown = f"{config.algo} {config.env}", shown
        done = sum(min(n, self.warm_up) for n in steps)
        self.bars = [
            ("warm-up", self.warm_up * len(steps), done),
            ("training", (config.steps - self.warm_up) * len(steps), sum(steps) - done),
        ]
        self.bar = self._next_bar()

    def _next_bar(self) -> tqdm:
        label, total, done = self.bars.pop(0)
        interval = 0.5 if sys.stderr.isatty() else 60.0  # seconds; a log file needs few lines
        return tqdm(
            total=total,
            initial=done,
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
        mean = sum(best) / max(len(best), 1)
        self.bar.set_postfix(last=f"{last:.2f}", best=f"{mean:.2f}", refresh=False)

    def show_final_evaluation(self) -> None:
        self.bar.set_description(f"{self.name} final evaluation")

    def close(self) -> None:
        self.bar.close()
