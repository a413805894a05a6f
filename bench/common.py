"""What the benchmarks of training share: options, agents, replay buffers with real transitions, and the machine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch

import envs
import run
from algos import ALGORITHMS
from core.agent import Agent
from core.config import ConfigError, choose
from core.random import stream_seed
from core.replay import Batch, Replay
from store.provenance import processor

TASK = "HC+O"


def parse_options(arguments: Iterable[str], defaults: Mapping[str, str]) -> dict[str, str]:
    """`key=value` words over the `defaults`. Raises ConfigError for a word of another form or an unknown key."""
    options = dict(defaults)
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not value:
            raise ConfigError(f"expected key=value, got {argument!r}")
        options[choose("key", key, defaults)] = value
    return options


def positive(key: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"bad value {text!r} for {key}: expected whole numbers from 1 on")
    return int(text)


def positives(key: str, text: str) -> list[int]:
    """A comma list of whole numbers from 1 on."""
    return [positive(key, part) for part in text.split(",")]


def machine(device: torch.device) -> str:
    """Processor, device and versions."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "no GPU"
    return f"{processor()}, {name}, torch {torch.__version__}"


def make_agent(name: str, batch: int, seeds: Sequence[int], device: torch.device | str = "cpu") -> Agent:
    """A new agent with the paper's settings for the task, the batch size apart."""
    ((config, _),) = run.plan([f"algo={name}", f"env={TASK}", f"batch_size={batch}", f"device={device}"])
    obs_dim = envs.make(TASK).observation_space.shape[0]
    return ALGORITHMS[name].build(config, envs.constraint(TASK), obs_dim, seeds)


def fill_replay(agent: Agent, transitions: int) -> Replay:
    """A buffer with as many steps of the environment of each of the agent's seeds, under its warm-up actions."""
    seeds = agent.seeds
    everyone = range(len(seeds))
    replay = Replay(seeds, transitions, agent.obs_dim, agent.action_dim, agent.stores_centers, agent.device)
    robots = [envs.make(TASK) for _ in seeds]
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
