"""Checks an algorithm against its contracts (`core.agent.Agent`), as Gymnasium's check_env checks an environment.

`algos.check_algorithm` trains small networks on a small environment, whose constraint depends on the observation.
"""

from __future__ import annotations

import json
import random
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from constraints import WeightedPositivePart
from core.agent import Agent
from core.config import Config
from core.replay import Batch
from core.seed import Seed
from core.snapshot import parameters_of
from core.trainer import Trainer
from store.checkpoint import CheckpointFolder
from store.interrupt import Interrupted
from store.writer import RunWriter

SEEDS = (3, 5, 8)
OBS, DIM = 4, 2
CONSTRAINT = WeightedPositivePart(lambda obs: 2.0 * obs[..., :DIM] + 3.0, 0.8, DIM)  # its centre is not the origin
SMALL: dict[str, Any] = {
    "hidden": [8, 8], "batch_size": 8, "buffer_size": 200, "steps": 60, "learning_starts": 24,
    "eval_every": 20, "eval_episodes": 2, "final_episodes": 2, "checkpoint_every": 1000, "device": "cpu", "threads": 1,
}  # fmt: skip
TOLERANCE = 1e-6  # of executed actions, as in the environments of the tasks
ROUNDING = 1e-3  # the largest rounding error of a parameter or a transition after so few steps


class ContractError(Exception):
    """An algorithm breaks a contract of `core.agent.Agent`. The message names the contract and the remedy."""


def check(name: str, algorithm: Any) -> None:
    """Raise ContractError if `algorithm`, the row `name` of `algos.ALGORITHMS`, breaks a contract.

    The settings are those of each group of robots in its `paper`, with smaller networks and fewer steps.
    """
    checked: list[Config] = []
    for group in algorithm.agent.paper:
        config = replace(algorithm.paper_config(name, "check", group, steps=1), **SMALL)
        if config not in checked:
            checked.append(config)
            _Check(name, algorithm, config).run()


def check_parameters(name: str, alone: Agent, among: Agent) -> None:
    """Raise ContractError if seeds share parameters or if a seed's initial values depend on other seeds.

    `alone` has one seed, `among` the same seed after others.
    """
    one, several = ({key: tuple(p.shape) for key, p in _parameters(agent).items()} for agent in (alone, among))
    if one.keys() != several.keys():
        raise ContractError(f"{name}: the names of parameters depend on the number of seeds: {one} and {several}")
    for key, shape in one.items():
        if not shape or several[key] != (len(among.seeds) * shape[0], *shape[1:]):
            raise ContractError(
                f"{name}: parameter {key} has shape {shape} for one seed and {several[key]} for {len(among.seeds)}, so"
                " seeds would share it; its first axis must have k rows per seed: give core.networks.MLP one generator"
                " of `init` per row"
            )
    for key, values in alone.state(0).items():
        if not torch.equal(values, among.state(len(among.seeds) - 1)[key]):
            raise ContractError(
                f"{name}: the initial values of {key} differ for a seed alone and among others; draw the rows of seed i"
                " from the generator init[i]"
            )


class _Check:
    def __init__(self, name: str, algorithm: Any, config: Config):
        self.name, self.algorithm, self.config = name, algorithm, config

    def run(self) -> None:
        with self._own_randomness("while it is built"):
            alone, among = self._build(SEEDS[-1:]), self._build(SEEDS)
            check_parameters(self.name, alone, among)
        self._check_registered(among)
        self._check_acting(self._build(SEEDS))
        self._check_learning(self._build(SEEDS))
        self._check_training()

    def _fail(self, message: str) -> None:
        raise ContractError(f"{self.name}: {message}")

    def _build(self, seeds: Sequence[int]) -> Agent:
        agent = self.algorithm.build(self.config, CONSTRAINT, OBS, list(seeds))
        agent.map.use_untrained(CONSTRAINT, torch.zeros(1, OBS))
        return agent

    @contextmanager
    def _own_randomness(self, when: str) -> Iterator[None]:
        """Fail if the block draws from a global random generator."""
        generators: dict[str, Callable[[], Any]] = {
            "PyTorch's global generator": lambda: torch.get_rng_state().tolist(),
            "NumPy's global generator": lambda: str(np.random.get_state(legacy=False)),
            "Python's module random": random.getstate,
        }
        before = {name: state() for name, state in generators.items()}
        yield
        for name, state in generators.items():
            if state() != before[name]:
                self._fail(
                    f"it draws random numbers from {name} {when}, so the same command would not give the same numbers;"
                    " draw from self.exploration when acting, from self.update_noise in gradient steps, and from `init`"
                    " in build"
                )

    # ---------------------------------------------------------------- networks, optimisers and memory

    def _check_registered(self, agent: Agent) -> None:
        known = {id(parameter): name for name, parameter in _parameters(agent).items()}
        trained = {}
        for name, optimizer in agent.optimizers().items():
            for number, parameter in enumerate(parameters_of(optimizer)):
                trained[id(parameter)] = name
                if id(parameter) not in known:
                    self._fail(
                        f"parameter {number} of the optimiser {name!r} is not in networks(), so checkpoints would lack"
                        " it; add its module to networks()"
                    )
        for name, parameter in _parameters(agent).items():
            if parameter.requires_grad and id(parameter) not in trained:
                self._fail(
                    f"no optimiser in optimizers() trains parameter {name}; add its optimiser, or freeze the parameter"
                    " as core.networks.frozen_copy does"
                )
        for name, value in vars(agent).items():
            if isinstance(value, Optimizer) and not any(value is other for other in agent.optimizers().values()):
                self._fail(f"the optimiser self.{name} is not in optimizers(), so checkpoints would lack it; add it")
            if isinstance(value, nn.Module) and any(id(parameter) not in known for parameter in value.parameters()):
                self._fail(f"the module self.{name} is not in networks(), so checkpoints would lack it; add it")
        memory = agent.memory()
        for name, tensor in memory.items():
            if tensor.shape[:1] != (len(SEEDS),):
                self._fail(f"memory()[{name!r}] has shape {tuple(tensor.shape)}, expected (seeds, ...)")
            if tensor.data_ptr() != agent.memory()[name].data_ptr():
                self._fail(f"memory()[{name!r}] is a copy; return the tensor itself, because resuming writes into it")

    # ---------------------------------------------------------------- acting

    def _check_acting(self, agent: Agent) -> None:
        obs = torch.randn(len(SEEDS), OBS, generator=torch.Generator().manual_seed(0))
        which = [0, 2]
        for begin in (agent.start_episode, agent.start_rollout):  # so that its memory is not zero
            begin(range(len(SEEDS)))
        agent.explore(obs, range(len(SEEDS)))
        before, remembered = _stream_states(agent), {name: rows[1].clone() for name, rows in agent.memory().items()}
        agent.start_episode(which)
        agent.start_rollout(which)
        suggested = agent.explore(obs, which)
        if suggested.shape != (len(SEEDS), DIM):
            self._fail(f"explore() returns shape {tuple(suggested.shape)}, expected (seeds, d)")
        if suggested.dtype != torch.float32:
            self._fail(f"explore() returns {suggested.dtype}, expected torch.float32")
        agent.warm_up(which)
        if any(not torch.equal(state[1], _stream_states(agent)[name][1]) for name, state in before.items()):
            self._fail(
                "a call for the seeds at positions [0, 2] draws from the stream of position 1; pass which=which to the"
                " streams in explore, warm_up, start_rollout and start_episode"
            )
        for name, row in remembered.items():
            if not torch.equal(row, agent.memory()[name][1]):
                self._fail(
                    f"a call for the seeds at positions [0, 2] changes memory()[{name!r}] of position 1; explore,"
                    " start_rollout and start_episode may change only the rows `which`"
                )
        before, batch = _stream_states(agent), obs[which].unsqueeze(1).repeat(1, 3, 1)
        policy = agent.policy(which)
        action = policy(batch)
        if action.shape != (2, 3, DIM):
            self._fail(f"policy() returns actions of shape {tuple(action.shape)} for obs (2, 3, n), expected (2, 3, d)")
        for i in which:
            agent.clear(i)
        if not torch.equal(action, policy(batch)):
            self._fail(
                "a policy is random, or it changes when the parameters change; policy() must return a deterministic"
                " function with its own copy of the parameters, as core.networks.rows_of makes"
            )
        if any(not torch.equal(a, b) for name, states in before.items() for a, b in _pairs(states, agent, name)):
            self._fail("a policy draws random numbers; policy() must return a deterministic function")

    # ---------------------------------------------------------------- learning

    def _check_learning(self, agent: Agent) -> None:
        names: list[str] | None = None
        for number in range(2 * agent.cycle):
            updates = agent.updates
            agent.update(_batch(agent, number))
            if agent.cycle > 1 and agent.updates != updates + 1:
                self._fail(f"cycle is {agent.cycle}, but update() does not add 1 to self.updates in every call")
            statistics = agent.statistics()
            names = list(statistics) if names is None else names
            if list(statistics) != names:
                self._fail(
                    f"statistics() returns the names {list(statistics)} now and {names} before; keep the same names"
                )
            for name, values in statistics.items():
                if values.shape != (len(SEEDS),):
                    self._fail(f"statistics()[{name!r}] has shape {tuple(values.shape)}, expected (seeds,)")
        if unseen := [name for name in agent.optimizers() if name not in agent.losses]:
            self._fail(f"update() never calls self.descend({unseen[0]!r}, losses), so a divergence would go unnoticed")
        try:
            state = agent.training_state(1)
            agent.load_training_state(1, state)
        except Exception as error:
            raise ContractError(f"{self.name}: the state of a seed cannot be saved and restored: {error}") from error

    # ---------------------------------------------------------------- whole trainings

    def _check_training(self) -> None:
        first = self._train(SEEDS)
        self._compare(
            first,
            self._train(SEEDS),
            "two trainings of the same seeds differ",
            "all randomness must come from self.exploration, self.update_noise and `init`, and nothing may remain"
            " from an earlier training",
        )
        self._compare(
            first,
            self._train(SEEDS, interrupted=True),
            "a training that was interrupted and resumed differs from an uninterrupted one",
            "everything that later steps depend on must be in networks(), optimizers(), streams() or memory()",
        )
        self._compare(
            {SEEDS[1]: first[SEEDS[1]]},
            self._train(SEEDS[1:2]),
            f"seed {SEEDS[1]} learns something different alone than among others",
            "a loss must be the mean over the batch, never over seeds; acting may change only the rows `which`, and"
            " seeds may share nothing",
            ROUNDING,
        )

    def _train(self, seeds: Sequence[int], interrupted: bool = False) -> dict[int, dict[str, Any]]:
        """Train `seeds` and return the outcome of each. If `interrupted`, stop at `MOMENTS` and resume each time."""
        with tempfile.TemporaryDirectory() as root, self._own_randomness("in training"):
            folders = [Path(root, f"seed={seed}") for seed in seeds]
            writers = [RunWriter(folder, {}, {}, self.config.eval_episodes) for folder in folders]
            moments = list(MOMENTS) if interrupted else []
            trainer = self._trainer(seeds, writers, moments)
            resumed = False
            while True:
                try:
                    trainer.run()
                    break
                except Interrupted:
                    writers = [RunWriter.resume(folder, {}, {}, self.config.eval_episodes) for folder in folders]
                    trainer, resumed = self._trainer(seeds, writers, moments), True
                    trainer.restore([CheckpointFolder(folder).read()[0][0] for folder in folders])
                except Exception as error:
                    if not resumed:
                        raise
                    raise ContractError(
                        f"{self.name}: a training that was interrupted and resumed fails, an uninterrupted one runs:"
                        f" {error!r}; everything that later steps depend on must be in networks(), optimizers(),"
                        " streams() or memory()"
                    ) from error
            return {seed.number: self._outcome(trainer, seed) for seed in trainer.seeds}

    def _trainer(self, seeds: Sequence[int], writers: Sequence[RunWriter], moments: list[Callable]) -> Trainer:
        def stop_if_asked() -> None:
            for moment in moments:
                if moment(trainer.seeds[0], self.config):
                    moments.remove(moment)
                    raise Interrupted(15)

        envs = [_Drift() for _ in seeds]
        agent = self._build(seeds)
        trainer = Trainer(self.config, agent, envs, _Drift, _step_together, writers, False, stop_if_asked)
        return trainer

    def _outcome(self, trainer: Trainer, seed: Seed) -> dict[str, Any]:
        if seed.failure:
            self._fail(f"a seed fails at step {seed.failure['step']}: {seed.failure['quantity']}")
        i, tables = seed.position, seed.writer.tables()
        rows = torch.cat(trainer.replay.stretch(i, 0, trainer.replay.added[i]))
        # (in the agent, the parameters of a seed that has ended still change while others train)
        last = torch.load(seed.writer.folder / "last.pt", weights_only=True)
        numbers = {"transitions": rows} | {f"parameter {name}": values for name, values in last.items()}
        for name, text in tables.items():
            lines = [line.split(",") for line in text.splitlines()[1:]]
            numbers[name] = torch.tensor([[float(x) for x in line] for line in lines])
        numbers["evaluations.csv"] = numbers["evaluations.csv"][:, :-1]  # without seconds
        return numbers

    def _compare(
        self, one: Mapping[int, dict], other: Mapping[int, dict], said: str, remedy: str, tolerance: float = 0.0
    ) -> None:
        for seed in one:
            for name, numbers in one[seed].items():
                found = other[seed].get(name)
                same = found is not None and found.shape == numbers.shape
                if not same or not torch.allclose(numbers, found, rtol=tolerance, atol=tolerance, equal_nan=True):
                    self._fail(f"{said}, first in {name} (of seed {seed}); {remedy}")


MOMENTS: tuple[Callable[[Seed, Config], bool], ...] = (
    lambda seed, config: seed.steps == 7,  # in warm-up, within an episode
    lambda seed, config: seed.owed > 0 and seed.gradient_steps > 1,  # between gradient steps
    lambda seed, config: seed.gradient_steps > 1 and seed.steps % config.eval_every == 0,  # before an evaluation
    lambda seed, config: seed.steps == config.steps - 5,
)
"""The moments at which a training is interrupted to check that it resumes."""


def _parameters(agent: Agent) -> dict[str, nn.Parameter]:
    return {
        f"{module}.{name}": parameter
        for module, network in agent.networks().items()
        for name, parameter in network.named_parameters()
    }


def _stream_states(agent: Agent) -> dict[str, list[Tensor]]:
    return {name: [g.get_state() for g in streams.generators] for name, streams in agent.streams().items()}


def _pairs(states: list[Tensor], agent: Agent, name: str) -> Iterator[tuple[Tensor, Tensor]]:
    return zip(states, _stream_states(agent)[name], strict=True)


def _batch(agent: Agent, number: int) -> Batch:
    """A batch of random transitions."""
    generator = torch.Generator().manual_seed(number)
    obs, next_obs = (torch.randn(len(SEEDS), 8, OBS, generator=generator) for _ in range(2))
    action = CONSTRAINT.project(obs, torch.rand(len(SEEDS), 8, DIM, generator=generator) * 2 - 1)
    reward = torch.randn(len(SEEDS), 8, generator=generator)
    terminated = (torch.arange(8) % 3 == 0).float().expand(len(SEEDS), -1)
    return Batch(obs, action, reward, terminated, next_obs, agent.centers(obs), agent.centers(next_obs))


class _Drift(gymnasium.Env):
    """A drifting point, pushed by actions. Episodes of 5, 7 or 9 steps terminate, those of 6 or 8 are truncated."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBS,), np.float64)
    largest_violation, executed_actions = -np.inf, 0
    robot = SimpleNamespace(max_episode_steps=9)  # for the evaluation's progress bar

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.obs, self.left = self.np_random.uniform(-1, 1, OBS), int(self.np_random.integers(5, 10))
        self.length = self.left
        return self.obs.copy(), {}

    def step(self, action: np.ndarray) -> Any:
        exact = torch.from_numpy(action.astype(np.float64))
        violation = float(CONSTRAINT.violation(torch.from_numpy(self.obs), exact))
        if not violation <= TOLERANCE:
            return ValueError(
                f"action {action.tolist()} violates the constraint by {violation:.3g}; executed actions must come from"
                " the map: call self.feasible in acting and at the end of the policy"
            )
        self.largest_violation, self.executed_actions = (
            max(self.largest_violation, violation),
            self.executed_actions + 1,
        )
        self.obs = 0.9 * self.obs + 0.3 * np.concatenate((action, action[::-1] ** 2))
        self.left -= 1
        over = self.left == 0
        reward = float(action[0] - np.square(self.obs).sum())
        return self.obs.copy(), reward, over and self.length % 2 == 1, over and self.length % 2 == 0, {}

    def get_state(self) -> dict[str, Any]:
        return {
            "random": json.dumps(self.np_random.bit_generator.state),
            "obs": torch.from_numpy(self.obs.copy()),
            "lengths": [self.left, self.length],
            "counts": [self.largest_violation, self.executed_actions],
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        self.np_random.bit_generator.state = json.loads(state["random"])
        self.obs = state["obs"].numpy().copy()
        self.left, self.length = state["lengths"]
        self.largest_violation, self.executed_actions = state["counts"]


def _step_together(envs: Sequence[Any], actions: np.ndarray) -> list[Any]:
    return [env.step(action) for env, action in zip(envs, actions, strict=True)]
