"""The time of a training run by phase.

`sweep.train.make_trainer` makes the run, with the paper's settings on HC+O and 10,000 steps. Gradient steps begin after
9,500 steps. TD3 takes 100 of them every 100 steps, instead of 1,000 after each episode of 1,000 steps. The run has two
evaluations, a final one of the same length, and two checkpoints: one of all 10,000 transitions, and one at the end.

The time of each phase is scaled to the protocol's million steps: gradient steps and exploration to the 9e5 steps after
the protocol's warm-up; evaluations to its number of episodes, without this run's first evaluation, which makes the
environments; logging to its number of evaluations; checkpoints to one every 10,000 steps, where the two of this run
count as one; everything else in proportion to the environment steps.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any
from unittest.mock import patch

import algos.sac
import algos.td3
from bench.common import make_config
from core.config import Config, saved_settings
from core.trainer import Trainer
from store.writer import RunWriter
from sweep.train import make_trainer

STEPS, WARM_UP = 10_000, 9_500
"""Environment steps of each seed, in all and before the first gradient step."""
EPISODES = 5
"""Episodes of an evaluation."""

UPDATE = ("replay sampling", "forward and backward", "optimiser", "target update")
OUTSIDE = ("exploration", "map", "environment", "storing", "evaluation", "checkpoint", "logging", "everything else")


@dataclass(frozen=True)
class Phases:
    """Seconds of each phase, all seeds together: as measured, and scaled to the protocol's million steps a seed."""

    measured: dict[str, float]
    scaled: dict[str, float]

    def share(self, phase: str) -> float:
        return self.scaled[phase] / sum(self.scaled.values())


class Stopwatch:
    """Measures the seconds of every single call of watched functions and methods, on `clock`."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self.calls: dict[str, list[float]] = defaultdict(list)

    def watch(self, owner: Any, name: str, phase: str) -> Any:
        """A context manager that times the calls of `owner.name` and assigns them to `phase`."""
        inner = getattr(owner, name)

        def timed(*arguments, **options):
            start = self.clock()
            try:
                return inner(*arguments, **options)
            finally:
                self.calls[phase].append(self.clock() - start)

        return patch.object(owner, name, timed)

    def seconds(self, phase: str) -> float:
        return sum(self.calls[phase])


@contextmanager
def new_trainer(
    config: Config, seeds: Sequence[int], stop_if_asked: Callable[[], None] = lambda: None
) -> Iterator[Trainer]:
    """Yield a trainer as run.py makes it, but without a progress bar; its folders are deleted afterwards.

    A map that is learned before the training stays untrained, because speed does not depend on it.
    """
    with tempfile.TemporaryDirectory() as folder:
        writers = [
            RunWriter(Path(folder) / str(seed), saved_settings(config, seed), {}, config.eval_episodes)
            for seed in seeds
        ]
        trainer = make_trainer(config, seeds, writers, False, stop_if_asked)
        trainer.agent.map.use_untrained(trainer.agent.constraint, trainer.obs)
        yield trainer


def measure_phases(algo: str, seeds: Sequence[int]) -> Phases:
    """Train `seeds` in lockstep and time the phases, in wall-clock seconds."""
    settings = {"steps": STEPS, "learning_starts": WARM_UP, "checkpoint_every": STEPS}
    settings |= {"eval_every": STEPS // 2, "eval_episodes": EPISODES, "final_episodes": EPISODES}
    if algo.startswith("D"):
        settings["train_freq"] = 100
    watch = Stopwatch()
    with new_trainer(make_config(algo, **settings), seeds) as trainer, ExitStack() as watched:
        agent = trainer.agent
        watches = [
            (trainer.replay, "sample", "replay sampling"),
            (trainer.replay, "add", "storing"),
            (trainer.replay, "flush", "storing"),
            (agent, "update", "update"),
            (agent, "explore", "exploration"),
            (trainer.evaluator, "run", "evaluation"),
            *((optimizer, "step", "optimiser") for optimizer in agent.optimizers().values()),
            *((module, "soft_update", "target update") for module in (algos.td3, algos.sac)),
            *(
                (RunWriter, name, "logging")
                for name in ("append_evaluation", "append_statistics", "save_parameters", "finish")
            ),
        ]
        for owner, name, phase in watches:
            watched.enter_context(watch.watch(owner, name, phase))
        start = time.perf_counter()
        results = trainer.run()
        total = time.perf_counter() - start

    measured = {phase: trainer.timer.phases[phase] for phase in ("environment", "checkpoint")}
    measured["map"] = trainer.timer.phases["acting"] - watch.seconds("exploration")
    measured |= {phase: watch.seconds(phase) for phase in (*UPDATE, *OUTSIDE) if phase not in measured}
    measured["forward and backward"] = sum(
        sign * watch.seconds(phase) for phase, sign in (("update", 1), ("optimiser", -1), ("target update", -1))
    )
    measured["everything else"] = 0.0
    measured["everything else"] = total - sum(measured.values())
    protocol = make_config(algo)
    learning_steps = protocol.steps - protocol.learning_starts
    factors = dict.fromkeys(OUTSIDE, protocol.steps / STEPS)
    factors |= dict.fromkeys(UPDATE, learning_steps / results[0]["gradient_steps"])
    factors["exploration"] = learning_steps / (STEPS - WARM_UP)
    factors["checkpoint"] = protocol.steps / protocol.checkpoint_every
    evaluations = protocol.steps / protocol.eval_every
    factors["logging"] = evaluations / 2
    scaled = {phase: factor * measured[phase] for phase, factor in factors.items()}
    episodes = evaluations * protocol.eval_episodes + protocol.final_episodes
    scaled["evaluation"] = episodes / EPISODES * mean(watch.calls["evaluation"][1:])
    return Phases(measured, scaled)
