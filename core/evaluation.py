"""Deterministic evaluation episodes in environments of their own, stepped together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gymnasium
import numpy as np
import torch
from torch import Tensor

from core.random import stream_seed


class Evaluator:
    """Owns `parallel` environments a seed, made when first needed; their random streams belong to the seed."""

    def __init__(self, make_env: Callable[[], gymnasium.Env], seeds: Sequence[int], parallel: int):
        self.make_env, self.seeds, self.parallel = make_env, seeds, parallel
        self.envs: dict[int, list[gymnasium.Env]] = {}

    def run(self, policy: Callable[[Tensor], Tensor], which: Sequence[int], episodes: int) -> np.ndarray:
        """Returns (len(which), episodes) of `policy`, which maps obs (len(which), m, n) to feasible actions."""
        returns = []
        for start in range(0, episodes, self.parallel):
            returns.append(self._together(policy, which, min(self.parallel, episodes - start)))
        return np.concatenate(returns, axis=1)

    def _together(self, policy: Callable[[Tensor], Tensor], which: Sequence[int], count: int) -> np.ndarray:
        envs = [self._envs_of(i)[:count] for i in which]
        obs = np.stack([[env.reset()[0] for env in row] for row in envs]).astype(np.float32)
        returns = np.zeros((len(which), count))
        running = [(i, j) for i in range(len(which)) for j in range(count)]
        while running:
            actions = policy(torch.from_numpy(obs)).numpy()
            still_running = []
            for i, j in running:
                obs[i, j], reward, terminated, truncated, _ = envs[i][j].step(actions[i, j])
                returns[i, j] += reward
                if not (terminated or truncated):
                    still_running.append((i, j))
            running = still_running
        return returns

    def _envs_of(self, i: int) -> list[gymnasium.Env]:
        if i not in self.envs:
            self.envs[i] = [self.make_env() for _ in range(self.parallel)]
            for index, env in enumerate(self.envs[i]):
                env.reset(seed=stream_seed(self.seeds[i], "evaluation", index))
        return self.envs[i]

    def of_seed(self, i: int) -> list[gymnasium.Env]:
        """The environments that the seed in position i has used so far."""
        return self.envs.get(i, [])

    def close(self) -> None:
        for env in (env for envs in self.envs.values() for env in envs):
            env.close()
