"""The moments from which a training can resume: checkpoints of all seeds, written and restored together."""

from __future__ import annotations

import sys
import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from torch import Tensor

from core.agent import Agent
from core.evaluation import Evaluator
from core.progress import PhaseTimer
from core.replay import Replay
from core.seed import Seed
from store.checkpoint import Checkpoint
from store.files import one_line


class Moments:
    """Writes and restores everything that the future of `seeds` depends on."""

    def __init__(self, seeds: Sequence[Seed], agent: Agent, replay: Replay, evaluator: Evaluator, timer: PhaseTimer):
        self.seeds, self.agent, self.replay = seeds, agent, replay
        self.evaluator, self.timer = evaluator, timer
        self.step: int | None = None
        """The step of the last moment: the smallest of the seeds that had not ended. None before the first moment."""

    def write(self, obs: Tensor, center: Tensor | None) -> None:
        """Write a checkpoint of every seed. obs (seeds, n) and `center` (seeds, d) are the current ones.

        On an OSError, report it and keep the previous checkpoint.
        """
        moment = uuid.uuid4().hex
        try:
            for seed in self.seeds:
                content = self.agent.seeds, seed.steps, seed.writer.config, self._state(seed, obs, center)
                seed.checkpoints.write(moment, *content, *self._stored(seed), self.replay.added[seed.position])
            for seed in self.seeds:
                seed.checkpoints.keep()
            self._count()
        except OSError as error:
            step = max(seed.steps for seed in self.seeds)
            print(f"no checkpoint at step {step}: {one_line(error)}", file=sys.stderr)
            for seed in self.seeds:
                with suppress(OSError):
                    seed.checkpoints.discard()

    def restore(self, checkpoints: Sequence[Checkpoint], obs: Tensor, center: Tensor | None) -> None:
        """Restore the moment of `checkpoints`, one of each seed.

        Copy its observations and centres into `obs` and `center`.
        """
        states = [checkpoint.state() for checkpoint in checkpoints]
        # Everything is read before anything is written. A read error thus leaves every folder as it is.
        for seed, checkpoint, state in zip(self.seeds, checkpoints, states, strict=True):
            i = seed.position
            obs[i] = state["obs"]
            if center is not None:
                center[i] = state["center"]
            self.agent.load_training_state(i, state["agent"])
            self.evaluator.set_state(i, state["evaluator"])
            self.replay.added[i] = state["added"]
            self.replay.streams.load_state(i, state["sampling"])
            checkpoint.fill(*self._stored(seed))
        for seed, checkpoint, state in zip(self.seeds, checkpoints, states, strict=True):
            seed.restore(state)
            seed.checkpoints.resume(checkpoint)
        self.timer.restore(states[-1]["seconds"])
        self._count()

    def _count(self) -> None:
        steps = [seed.steps for seed in self.seeds if not seed.ended] or [max(seed.steps for seed in self.seeds)]
        self.step = min(steps)

    def _state(self, seed: Seed, obs: Tensor, center: Tensor | None) -> dict[str, Any]:
        """Everything about a seed except its transitions."""
        i = seed.position
        return seed.state() | {
            "obs": obs[i].clone(),
            "center": None if center is None else center[i].clone(),
            "agent": self.agent.training_state(i),
            "evaluator": self.evaluator.get_state(i),
            "added": self.replay.added[i],
            "sampling": self.replay.streams.state(i),
            "seconds": self.timer.seconds,
        }

    def _stored(self, seed: Seed) -> tuple[Callable[[int, int], list[Tensor]], int]:
        """The function that returns views of a seed's transitions, and the number of the oldest one in the buffer."""
        i = seed.position
        return partial(self.replay.stretch, i), max(0, self.replay.added[i] - self.replay.capacity)
