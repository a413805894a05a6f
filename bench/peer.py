"""Stable-Baselines3's TD3 and SAC on the task of the benchmark, for comparison (`pip install -e '.[bench]'`)."""

from __future__ import annotations

import importlib.util
from importlib.metadata import version

import numpy as np

import envs
from bench.common import TASK
from core.config import Config

INSTALLED = importlib.util.find_spec("stable_baselines3") is not None


def peer_version() -> str:
    return version("stable-baselines3")


class Peer:
    """A model with the hyperparameters of `config`; its replay buffer holds `transitions` steps under random actions.

    Like our DPre and SPre, it trains on the environment that projects."""

    def __init__(self, base: str, config: Config, transitions: int):
        import stable_baselines3
        from stable_baselines3.common.logger import configure
        from stable_baselines3.common.noise import NormalActionNoise

        env = envs.make(TASK, project=True)
        options = {}
        if base == "TD3":
            width = env.action_space.shape[0]
            options["action_noise"] = NormalActionNoise(np.zeros(width), np.full(width, config.action_noise))
        # `learn` with gradient_steps=0 collects transitions and does nothing else.
        self.model = getattr(stable_baselines3, base)(
            "MlpPolicy",
            env,
            learning_rate=config.learning_rate,
            buffer_size=transitions,
            learning_starts=transitions,
            batch_size=config.batch_size,
            tau=config.tau,
            gamma=config.gamma,
            train_freq=1,
            gradient_steps=0,
            policy_kwargs={"net_arch": list(config.hidden)},
            seed=0,
            device="cpu",
            **options,
        )
        self.model.set_logger(configure(None, []))
        self.model.learn(transitions, log_interval=None)

    def update(self, steps: int) -> None:
        """Take `steps` gradient steps."""
        self.model.train(gradient_steps=steps, batch_size=self.model.batch_size)

    def collect(self, steps: int) -> None:
        """Take `steps` environment steps by `collect_rollouts`: policy, noise, environment and replay buffer."""
        self.model.learn(steps, log_interval=None, reset_num_timesteps=False)
