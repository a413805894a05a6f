"""The training loop: S seeds of one (algorithm, task) cell in one process.

Each seed follows its own schedule of rollouts and gradient steps, exactly as it would alone. Only the arithmetic is
shared: a seed that owes gradient steps waits until all do. They take these steps in one batch of matrix products.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch

from constraints import ConstraintError
from core.agent import Agent
from core.config import Config
from core.cuda_graph import GradientSteps
from core.evaluation import Evaluator, StepTogether, refusal
from core.guard import Guard, step_apart
from core.moments import Moments
from core.progress import PhaseTimer, Progress
from core.random import stream_seed
from core.replay import Batch, Replay
from core.seed import Best, Seed
from store.checkpoint import Checkpoint
from store.files import one_line
from store.interrupt import Interrupted
from store.writer import RunWriter


class Trainer:
    """Trains `agent` on its seeds and writes one run folder per seed.

    `stop_if_asked` is called between any two steps. It raises Interrupted to stop the training with a checkpoint.
    """

    def __init__(
        self,
        config: Config,
        agent: Agent,
        envs: Sequence[Any],
        make_env: Callable[[], gymnasium.Env],
        step_together: StepTogether,
        writers: Sequence[RunWriter],
        progress: bool = True,
        stop_if_asked: Callable[[], None] = lambda: None,
    ):
        self.config, self.agent = config, agent
        self.guard = Guard(agent.constraint, len(agent.seeds))
        agent.constraint = self.guard.constraint
        self.step_together, self.stop_if_asked = step_apart(step_together), stop_if_asked
        rows = zip(agent.seeds, envs, writers, strict=True)
        self.seeds = [Seed(number, i, env, writer) for i, (number, env, writer) in enumerate(rows)]
        self.evaluator = Evaluator(make_env, agent.seeds, config.eval_episodes, self.step_together, stop_if_asked)
        self.replay = Replay(
            agent.seeds,
            min(config.buffer_size, config.steps),
            agent.obs_dim,
            agent.action_dim,
            agent.stores_centers,
            agent.device,
        )
        self.take_gradient_step = GradientSteps(agent, self.replay, config.batch_size)
        self.obs = torch.zeros(len(self.seeds), agent.obs_dim)
        self.center = torch.zeros(len(self.seeds), agent.action_dim) if agent.stores_centers else None
        self.began = False
        self.steps_at_checkpoint = 0  # of all seeds together
        self.timer = PhaseTimer(("environment", "acting", "update", "evaluation", "checkpoint"))
        self.moments = Moments(self.seeds, agent, self.replay, self.evaluator, self.timer)
        self.show_progress = progress

    def run(self) -> list[dict | None]:
        """Train every seed to the end. Returns one result per seed, None for a seed that diverged.

        If `stop_if_asked` raises Interrupted, a checkpoint is written before it is raised again. Any exception saves
        the last parameters. An error that belongs to one seed ends that seed alone (`failed.json` has step and reason).
        Any other error is raised after a line on stderr that names algorithm, task and step.
        """
        self.progress = Progress(self.config, [seed.steps for seed in self.seeds], self.show_progress)
        self.evaluator.watch = self.progress.evaluation
        try:
            if not self.began:
                self._sparing(self._begin)
            while live := self._live():
                self.stop_if_asked()
                if self._all_steps() - self.steps_at_checkpoint >= self.config.checkpoint_every * len(live):
                    self._checkpoint()
                    continue  # a checkpoint may end seeds
                self._sparing(self._advance, live)
        except BaseException as error:
            if isinstance(error, Interrupted):
                self._checkpoint()
            elif isinstance(error, Exception):
                self._report(error)
            self._save_last()
            raise
        finally:
            self.progress.close()
            self.evaluator.close()
            for seed in self.seeds:
                seed.env.close()
                seed.writer.loggers.close()
        for seed in self.seeds:
            seed.checkpoints.remove()
        return [seed.result for seed in self.seeds]

    def _sparing(self, part: Callable[..., None], *arguments: Any) -> None:
        """Call `part`. A seed ends if the constraint fails at one of its observations. The other seeds continue."""
        try:
            part(*arguments)
        except ConstraintError:
            self._fail_refused()
            if not all(seed.ended for seed in self.seeds):  # the error belongs to no single seed
                raise
        self._fail_refused()

    def _fail_refused(self) -> None:
        for i, reason in self.guard.refused.items():
            if not self.seeds[i].ended:
                self._fail(self.seeds[i], self._of_constraint(reason))

    def _of_constraint(self, reason: str) -> str:
        return f"the constraint of {self.config.env}: {reason}"

    def _report(self, error: Exception) -> None:
        """Print where the error occurred and from which step training can resume.

        There is no new checkpoint: training could not resume exactly from the middle of a step.
        """
        from_step = self.moments.step
        rest = "no checkpoint yet" if from_step is None else f"the same command resumes from step {from_step}"
        step = max(seed.steps for seed in self.seeds)
        where = f"{self.config.algo} on {self.config.env}, seeds {', '.join(map(str, self.agent.seeds))}, step {step}"
        print(f"{where}: {type(error).__name__} ({rest})", file=sys.stderr)

    def _live(self) -> list[Seed]:
        """Return the seeds that have not ended, after writing the results of those that have."""
        while ended := [seed for seed in self.seeds if seed.ended and not seed.recorded]:
            if due := [seed for seed in ended if seed.result_due]:
                self._evaluate_failed(due)
            self._record_ends()
        return [seed for seed in self.seeds if not seed.ended]

    def _all_steps(self) -> int:
        return sum(seed.steps for seed in self.seeds)

    def _begin(self) -> None:
        self.began = True
        for seed in self.seeds:
            self.obs[seed.position] = _tensor(seed.env.reset(seed=stream_seed(seed.number, "environment"))[0])
        self.center = self.agent.centers(self.obs)
        self.agent.start_episode(range(len(self.seeds)))
        self.agent.start_rollout(range(len(self.seeds)))

    def _advance(self, live: Sequence[Seed]) -> None:
        """Take the next step of the seeds that have not ended.

        The step depends on the state alone. A training that resumes between two calls is thus the same training.
        """
        every, last = self.config.eval_every, self.config.steps
        due = [s for s in live if s.steps > s.evaluated and (s.steps % every == 0 or s.steps == last)]
        if due:
            self._evaluate(due)
        elif finished := [seed for seed in live if seed.steps == last]:
            self._finish(finished)
        elif collecting := [seed for seed in live if not seed.owed]:
            self._step(collecting)
        else:
            self._update(live)

    # ---------------------------------------------------------------- learning

    def _update(self, live: Sequence[Seed]) -> None:
        """Take one gradient step of the seeds `live`, which all owe one."""
        with self.timer.timed("update"):
            self.take_gradient_step()
            for seed in live:
                seed.owed -= 1
                seed.gradient_steps += 1
            # Reading losses waits for the GPU: do it only if a seed owes no more. An infinite loss stays infinite.
            if self.agent.device.type == "cpu" or not all(seed.owed for seed in live):
                for i, quantity in self.agent.diverged().items():
                    self._fail(self.seeds[i], f"{quantity} is not finite")
        if done := [seed.position for seed in live if not seed.owed]:
            self.agent.start_rollout(done)

    # ---------------------------------------------------------------- collecting

    def _step(self, seeds: Sequence[Seed]) -> None:
        """One environment step of `seeds`."""
        starts = self.config.learning_starts
        with self.timer.timed("acting"):
            warming_up = [seed.position for seed in seeds if seed.steps < starts]
            exploring = [seed.position for seed in seeds if seed.steps >= starts]
            action = self.agent.act(self.obs, self.center, warming_up, exploring)
            if measured := [seed for seed in seeds if seed.position in exploring and seed.is_measured]:
                proposed = self.agent.proposed(self.obs, action.suggested)
                violations = self.agent.constraint.violation(self.obs, proposed)
                for seed in measured:
                    seed.suggestions.add(violations[seed.position].item())
            self._fail_refused()
        arrived, reset_obs = self.obs.numpy().copy(), {}
        reward, terminated, ended = (np.zeros((len(self.seeds), 1), dtype=np.float32) for _ in range(3))
        with self.timer.timed("environment"):
            stepped = []
            acting = [seed for seed in seeds if not seed.ended]
            for seed, outcome in self._outcomes(acting, action.suggested.numpy(), action.executed.numpy()):
                i = seed.position
                obs, reward[i], terminated[i], truncated, _ = outcome
                stepped.append(seed)
                arrived[i] = obs
                if terminated[i] or truncated:
                    ended[i] = True
                    reset_obs[i] = seed.env.reset()[0]
        if not stepped:
            return
        next_obs = _tensor(arrived)
        with self.timer.timed("acting"):
            next_center = self.agent.centers(next_obs)
            self._fail_refused()
        stepped = [seed for seed in stepped if not seed.ended]
        if not stepped:
            return
        ends = _tensor(terminated)
        transitions = Batch(self.obs, action.stored, _tensor(reward), ends, next_obs, self.center, next_center)
        self.replay.add([seed.position for seed in stepped], transitions)

        self.obs = next_obs
        for i, obs in reset_obs.items():
            self.obs[i] = _tensor(obs)
        self.center = self.agent.centers(self.obs) if reset_obs else next_center
        if reset_obs:
            self.agent.start_episode(list(reset_obs))
        self.progress.advance(len(stepped), min(seed.steps for seed in stepped))
        new_rollout = [s.position for s in stepped if s.count_step(self.config, bool(ended[s.position]))]
        if new_rollout:
            self.agent.start_rollout(new_rollout)

    def _outcomes(self, seeds: Sequence[Seed], suggested: np.ndarray, executed: np.ndarray) -> list[tuple[Seed, tuple]]:
        """Step the environments of `seeds`. Return the result of `step` for each seed that does not fail here."""
        finite = np.isfinite(suggested).all(-1)
        sound = []
        for seed in seeds:
            if finite[seed.position]:
                sound.append(seed)
            else:
                self._fail(seed, f"suggested action {suggested[seed.position].tolist()} is not finite")
        outcomes = self.step_together([seed.env for seed in sound], executed[[seed.position for seed in sound]])
        taken = []
        for seed, outcome in zip(sound, outcomes, strict=True):
            if isinstance(outcome, Exception):
                self._fail(seed, refusal(outcome, self.obs[seed.position]))
            else:
                taken.append((seed, outcome))
        if taken:
            obs, rewards = (np.array([outcome[k] for _, outcome in taken], np.float32) for k in (0, 1))
            for k in np.flatnonzero(~(np.isfinite(obs).all(-1) & np.isfinite(rewards))):
                self._fail(taken[k][0], "observation or reward is not finite")
        return [(seed, outcome) for seed, outcome in taken if not seed.ended]

    # ---------------------------------------------------------------- evaluations and ends

    def _evaluate(self, seeds: Sequence[Seed]) -> None:
        """Evaluate `seeds`. A seed with a parameter or an action that is not finite fails."""
        seeds = [seed for seed in seeds if not self._fail_if_infinite(seed)]
        if not seeds:
            return
        which = [seed.position for seed in seeds]
        with self.timer.timed("evaluation"):
            returns = self._play(self.agent.policy(which), which, self.config.eval_episodes)
        statistics = self.agent.statistics() if any(seed.gradient_steps for seed in seeds) else {}
        for seed, seed_returns in zip(seeds, returns, strict=True):
            i = seed.position
            if i in self.evaluator.refused:
                self._fail(seed, f"evaluation: {self.evaluator.refused[i]}")
                continue
            seed.evaluated = seed.steps
            seed.writer.append_evaluation(seed.steps, seed_returns, self.timer.seconds["total"])
            measures = {name: float(values[i]) for name, values in statistics.items()} | seed.suggestions.take()
            if seed.gradient_steps:
                seed.writer.append_statistics(seed.steps, measures)
            mean = float(seed_returns.mean())
            if seed.is_best(mean):
                seed.keep_best(Best(mean, seed.steps, self.agent.state(i)))
        best = [seed.best.mean for seed in self.seeds if seed.best]
        self.progress.show_evaluation(float(returns.mean()), best)

    def _play(self, policy: Callable[[torch.Tensor], torch.Tensor], which: Sequence[int], episodes: int) -> np.ndarray:
        """The returns (len(which), episodes) of `policy` for the seeds in the positions `which`."""
        with self.guard.of(which) as refused:
            apart = self.guard.apart(lambda obs: policy(obs.to(self.agent.device)).cpu())
            returns = self.evaluator.run(apart, which, episodes)
        self.evaluator.refused |= {i: self._of_constraint(reason) for i, reason in refused.items()}
        return returns

    def _finish(self, seeds: Sequence[Seed]) -> None:
        """Run the final evaluation of the best parameters of `seeds`, which gives their results."""
        self.progress.show_final_evaluation()
        for seed, result in zip(seeds, self._final_results(seeds), strict=True):
            if isinstance(result, str):
                self._fail(seed, result)
                seed.failure["result"] = None  # the best parameters have just failed
            else:
                seed.result = result | self._counts(seed) | {"seeds_in_lockstep": len(self.seeds)}

    def _evaluate_failed(self, seeds: Sequence[Seed]) -> None:
        """Run the final evaluation of the best parameters of diverged `seeds`, for the result in their failures."""
        for seed, result in zip(seeds, self._final_results(seeds), strict=True):
            seed.failure |= self._counts(seed) | {"result": result}

    def _final_results(self, seeds: Sequence[Seed]) -> list[dict[str, Any] | str]:
        """The result of the final evaluation of each of `seeds`, or the reason why an action was refused."""
        which = [seed.position for seed in seeds]
        last = {i: self.agent.state(i) for i in which}
        try:
            for seed in seeds:
                self.agent.load_state(seed.position, seed.best.parameters)
            policy = self.agent.policy(which)  # a copy of the best parameters
        finally:
            for i in which:
                self.agent.load_state(i, last[i])
        with self.timer.timed("evaluation"):
            returns = self._play(policy, which, self.config.final_episodes)
        results: list[dict[str, Any] | str] = []
        for seed, seed_returns in zip(seeds, returns, strict=True):
            if seed.position in self.evaluator.refused:
                results.append(f"final evaluation: {self.evaluator.refused[seed.position]}")
            else:
                mean = float(seed_returns.mean())
                results.append({"return_mean": mean, "returns": seed_returns.tolist(), "best_step": seed.best.step})
        return results

    def _counts(self, seed: Seed) -> dict[str, Any]:
        envs = [env.unwrapped for env in (seed.env, *self.evaluator.of_seed(seed.position))]
        return {
            "steps": seed.steps,
            "gradient_steps": seed.gradient_steps,
            "executed_actions": sum(env.executed_actions for env in envs),
            # (None before the first action, because JSON has no infinity)
            "largest_violation": max((env.largest_violation for env in envs if env.executed_actions), default=None),
            "seconds": self.timer.seconds,
        }

    def _fail_if_infinite(self, seed: Seed) -> bool:
        name = self.agent.infinite_parameter(seed.position)
        if name is not None:
            self._fail(seed, f"parameter {name} is not finite")
        return name is not None

    def _fail(self, seed: Seed, reason: str) -> None:
        """End a seed that has diverged, without an effect on the other seeds."""
        if not seed.ended:
            seed.writer.save_parameters("last", self.agent.state(seed.position))
            last = seed.best and seed.writer.last_finite_evaluation()
            seed.failure = {"step": seed.steps, "quantity": reason, "last_evaluation": last, **self._counts(seed)}
        self.agent.clear(seed.position)

    def _record_ends(self) -> None:
        """Write the results and failures of the seeds that have ended to their folders.

        A checkpoint comes first. Until all seeds have ended, a resumption needs every seed for the same batch.
        """
        self._checkpoint()
        for seed in self.seeds:
            if seed.ended and not seed.recorded and not seed.result_due:  # the checkpoint may have ended more
                seed.record_end(self.agent.state(seed.position))

    def _save_last(self) -> None:
        """Save the last parameters of every seed that has not ended. Report an OSError and continue."""
        for seed in self.seeds:
            if seed.ended:
                continue
            try:
                seed.writer.save_parameters("last", self.agent.state(seed.position))
            except OSError as error:
                print(f"{error.filename}: last parameters not saved: {one_line(error)}", file=sys.stderr)

    # ---------------------------------------------------------------- checkpoints

    def _checkpoint(self) -> None:
        """Write a checkpoint of every seed, after ending the seeds with a parameter that is not finite."""
        self.steps_at_checkpoint = self._all_steps()
        with self.timer.timed("checkpoint"):
            for seed in self.seeds:
                if not seed.ended:
                    self._fail_if_infinite(seed)
            self.moments.write(self.obs, self.center)

    def restore(self, checkpoints: Sequence[Checkpoint]) -> None:
        """Resume the training from `checkpoints`, one of each seed and all of the same moment."""
        self.moments.restore(checkpoints, self.obs, self.center)
        self.steps_at_checkpoint = self._all_steps()
        self.began = True


def _tensor(array: Any) -> torch.Tensor:
    return torch.as_tensor(array, dtype=torch.float32)
