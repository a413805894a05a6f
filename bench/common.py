"""Helpers of the training benchmarks: configurations, agents, replay buffers with real transitions, the machine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

import envs
from algos import ALGORITHMS
from core.agent import Agent
from core.config import Config
from core.random import stream_seed
from core.replay import Batch, Replay
from store.provenance import processor
from sweep.cells import make_cells

TASK = "HC+O"


def machine_name(device: torch.device) -> str:
    """Processor, device and versions."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "no GPU"
    return f"{processor()}, {name}, torch {torch.__version__}"


def make_config(algo: str, **settings: object) -> Config:
    """The paper's configuration of `algo` with changed `settings`. The task is `TASK` unless `env` is among them."""
    words = {key: str(value) for key, value in settings.items()}
    (cell,) = make_cells({"algo": algo, "env": TASK} | words)
    return cell.config


def make_agent(name: str, batch: int, seeds: Sequence[int], device: torch.device | str = "cpu") -> Agent:
    """A new agent with the paper's settings for `TASK`, except for the batch size."""
    return agent_of(make_config(name, batch_size=batch, device=device), seeds)


def agent_of(config: Config, seeds: Sequence[int]) -> Agent:
    """A new agent with these settings."""
    obs_dim, constraint = envs.TASKS[config.env].robot.obs_dim, envs.constraint(config.env)
    agent = ALGORITHMS[config.algo].build(config, constraint, obs_dim, seeds)
    agent.map.use_untrained(constraint, torch.zeros(1, obs_dim))
    return agent


def fill_replay(agent: Agent, transitions: int) -> Replay:
    """A replay buffer with `transitions` steps of each of the agent's seeds, taken with its warm-up actions."""
    seeds = agent.seeds
    everyone = range(len(seeds))
    replay = Replay(seeds, transitions, agent.obs_dim, agent.action_dim, agent.stores_centers, agent.device)
    robots = [envs.make(agent.config.env) for _ in seeds]
    obs = stack([env.reset(seed=stream_seed(seed, "environment"))[0] for env, seed in zip(robots, seeds, strict=True)])
    for _ in range(transitions):
        action = agent.act(obs, agent.centers(obs), everyone, [])
        steps = envs.step_together(robots, action.executed.numpy())
        next_obs, reward, terminated = (stack([step[k] for step in steps]) for k in range(3))
        centers = agent.centers(obs), agent.centers(next_obs)
        replay.add(everyone, Batch(obs, action.stored, reward[:, None], terminated[:, None], next_obs, *centers))
        restarts = {
            i: env.reset()[0] for i, (env, step) in enumerate(zip(robots, steps, strict=True)) if any(step[2:4])
        }
        obs = stack([restarts.get(i, row) for i, row in enumerate(next_obs.numpy())])
    for env in robots:
        env.close()
    return replay


def stack(rows: Sequence) -> torch.Tensor:
    return torch.as_tensor(np.stack(rows), dtype=torch.float32)
