"""Evaluation episodes of deterministic policies, in separate environments that step together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from constraints import ConstraintError
from core.random import stream_seed

StepTogether = Callable[[Sequence[Any], np.ndarray], Sequence[Any]]
"""Steps each environment with its row of the actions (environments, d). Returns for each environment the result of its
`step` or, for a refused action, the error that `step` raised."""
Watch = Callable[[int], AbstractContextManager[Callable[[int], Any]]]
"""Called with the largest number of steps of an evaluation. Returns a context manager that yields a function to count
steps."""


def refusal(error: Exception, obs: Any) -> str:
    """Why an action was refused. The observation (n,) is added to a ConstraintError, which does not know it."""
    return f"{error}, at observation {obs.tolist()}" if isinstance(error, ConstraintError) else str(error)


class Evaluator:
    """Owns `parallel` environments per seed, made on first use, with random streams of the seed.

    `stop_if_asked` is called before every step and raises to stop. After any exception, the environments are put back
    into their states before the evaluation, so that it can be repeated.
    """

    def __init__(
        self,
        make_env: Callable[[], gymnasium.Env],
        seeds: Sequence[int],
        parallel: int,
        step_together: StepTogether,
        stop_if_asked: Callable[[], None],
    ):
        self.make_env, self.seeds, self.parallel = make_env, seeds, parallel
        self.step_together, self.ask_to_stop = step_together, stop_if_asked
        self.watch: Watch = lambda steps: nullcontext(lambda count: None)  # the trainer puts a progress bar here
        self.advance: Callable[[int], Any] = lambda count: None
        self.envs: dict[int, list[Any]] = {}
        self.refused: dict[int, str] = {}  # position of a seed -> why its policy's action was refused, in the last run

    def run(self, policy: Callable[[Tensor], Tensor], which: Sequence[int], episodes: int) -> np.ndarray:
        """The returns (len(which), episodes) of `policy` for the seeds in the positions `which`.

        `policy` maps obs (len(which), m, n) to feasible actions. A return is NaN if an action was refused.
        """
        returns, self.refused = [], {}
        before = {i: [env.unwrapped.get_state() for env in self._envs_of(i)] for i in which}
        starts = range(0, episodes, self.parallel)
        longest = max(env.unwrapped.robot.max_episode_steps for i in which for env in self._envs_of(i))
        try:
            with self.watch(len(starts) * longest) as self.advance:
                for start in starts:
                    returns.append(self._together(policy, which, min(self.parallel, episodes - start)))
        except BaseException:
            for i, states in before.items():
                self.set_state(i, states)
            raise
        return np.concatenate(returns, axis=1)

    def stop_if_asked(self) -> None:
        """Called before every step of the environments. Raises to stop, and otherwise advances the progress bar."""
        self.ask_to_stop()
        self.advance(1)

    def _together(self, policy: Callable[[Tensor], Tensor], which: Sequence[int], count: int) -> np.ndarray:
        envs = [env for i in which for env in self._envs_of(i)[:count]]
        obs = np.stack([env.reset()[0] for env in envs]).astype(np.float32)
        seen = torch.from_numpy(obs).unflatten(0, (len(which), count))  # shares memory with obs
        returns = np.zeros(len(envs))
        running = list(range(len(envs)))
        while running:
            self.stop_if_asked()
            actions = policy(seen).flatten(0, 1).numpy()
            still_running = []
            outcomes = self.step_together([envs[k] for k in running], actions[running])
            for k, outcome in zip(running, outcomes, strict=True):
                if isinstance(outcome, Exception):
                    self.refused[which[k // count]] = refusal(outcome, obs[k])
                    returns[k] = np.nan
                    continue
                arrived, reward, terminated, truncated, _ = outcome
                returns[k] += reward
                if not (terminated or truncated):
                    obs[k] = arrived  # no action follows the last observation, where the set may be empty
                    still_running.append(k)
            running = still_running
        return returns.reshape(len(which), count)

    def _envs_of(self, i: int) -> list[Any]:
        if i not in self.envs:
            self.envs[i] = [self.make_env() for _ in range(self.parallel)]
            for index, env in enumerate(self.envs[i]):
                env.reset(seed=stream_seed(self.seeds[i], "evaluation", index))
        return self.envs[i]

    def of_seed(self, i: int) -> list[Any]:
        """The environments that the seed in position i has used so far."""
        return self.envs.get(i, [])

    def get_state(self, i: int) -> list[dict]:
        """The states of the environments that the seed in position i has used so far, between two evaluations."""
        return [env.unwrapped.get_state() for env in self.of_seed(i)]

    def set_state(self, i: int, states: Sequence[dict]) -> None:
        """Put the environments of the seed in position i back into `states`."""
        if states:
            for env, state in zip(self._envs_of(i), states, strict=True):
                env.unwrapped.set_state(state)

    def close(self) -> None:
        for env in (env for envs in self.envs.values() for env in envs):
            env.close()
