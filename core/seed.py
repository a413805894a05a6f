"""One seed of a training: its environment, files, counters and result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from torch import Tensor

from core.config import Config
from core.suggestions import EVERY, Suggestions
from store.checkpoint import CheckpointFolder
from store.folder import has_failed, is_finished
from store.writer import RunWriter

COUNTERS = ("steps", "rollout_steps", "owed", "gradient_steps", "evaluated")


class Best(NamedTuple):
    """The parameters of the best evaluation so far, its mean return and its environment step."""

    mean: float
    step: int
    parameters: dict[str, Tensor]


@dataclass(eq=False)
class Seed:
    """The state of one seed. A seed that has ended stays in the batch and does not affect the other seeds."""

    number: int  # determines its random streams
    position: int  # its row in the learning tensors
    env: Any
    writer: RunWriter
    checkpoints: CheckpointFolder = field(init=False)
    steps: int = 0  # environment steps
    rollout_steps: int = 0  # in the current rollout
    owed: int = 0  # gradient steps that it must take before its next environment step
    gradient_steps: int = 0
    evaluated: int = 0  # the step of its last evaluation
    suggestions: Suggestions = field(default_factory=Suggestions)  # since its last evaluation
    best: Best | None = None
    result: dict[str, Any] | None = None  # if it has finished
    failure: dict[str, Any] | None = None  # if it has diverged
    recorded: bool = False  # whether its folder has the result or the failure

    def __post_init__(self) -> None:
        self.checkpoints = CheckpointFolder(self.writer.folder)

    @property
    def ended(self) -> bool:
        return self.result is not None or self.failure is not None

    @property
    def result_due(self) -> bool:
        """Whether the seed has diverged and its best parameters still need their final evaluation."""
        has_best = self.best is not None and math.isfinite(self.best.mean)
        return self.failure is not None and "result" not in self.failure and has_best

    @property
    def is_measured(self) -> bool:
        """Whether `suggestions` measures the seed's next suggestion."""
        return self.steps % EVERY == 0

    def count_step(self, config: Config, episode_over: bool) -> bool:
        """Count an environment step. Return True if a rollout ends here and no gradient steps follow it."""
        self.steps += 1
        self.rollout_steps += 1
        if not (episode_over if config.train_freq == "episode" else self.rollout_steps == config.train_freq):
            return False
        warming_up = self.steps <= config.learning_starts
        if not warming_up:
            self.owed = self.rollout_steps if config.gradient_steps == -1 else config.gradient_steps
        self.rollout_steps = 0
        return warming_up

    def is_best(self, mean: float) -> bool:
        """Whether an evaluation with this mean return is the best so far."""
        return self.best is None or mean > self.best.mean or math.isnan(self.best.mean)

    def keep_best(self, best: Best) -> None:
        self.best = best
        self.writer.save_parameters("best", best.parameters)

    def record_end(self, parameters: Mapping[str, Tensor]) -> None:
        """Write the result and the last `parameters`, or the failure, to the seed's folder."""
        if self.result is not None:
            self.writer.save_parameters("last", parameters)
            self.writer.finish(self.result)
        else:
            self.writer.fail(self.failure)
        self.recorded = True

    def state(self) -> dict[str, Any]:
        """This object's part of a checkpoint."""
        return {
            "counters": {name: getattr(self, name) for name in COUNTERS},
            "suggestions": asdict(self.suggestions),
            "best": self.best and tuple(self.best),
            "result": self.result,
            "failure": self.failure,
            "environment": self.env.unwrapped.get_state(),
            "tables": self.writer.tables(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore what `state` returned."""
        for name in COUNTERS:
            setattr(self, name, state["counters"][name])
        self.suggestions = Suggestions(**state["suggestions"])
        self.result, self.failure = state["result"], state["failure"]
        self.env.unwrapped.set_state(state["environment"])
        self.writer.restore_tables(state["tables"])
        if state["best"]:
            self.keep_best(Best(*state["best"]))
        folder = self.writer.folder
        self.recorded = is_finished(folder) if self.result is not None else self.ended and has_failed(folder)
