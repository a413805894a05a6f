"""How far a training has come, for the person who watches it, and where its time goes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from tqdm import tqdm

from core.config import Config


class PhaseTimer:
    """Seconds of a training, in all and by phase. The time between a stop and the resumption does not count."""

    def __init__(self, phases: Sequence[str]):
        self.phases = dict.fromkeys(phases, 0.0)
        self.started = time.perf_counter()

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        """Count the time of the block for `phase`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.phases[phase] += time.perf_counter() - start

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of each phase, and in "total" those since the start."""
        return self.phases | {"total": time.perf_counter() - self.started}

    def restore(self, seconds: dict[str, float]) -> None:
        """Go on from what `seconds` was."""
        self.phases = {phase: seconds[phase] for phase in self.phases}
        self.started = time.perf_counter() - seconds["total"]


class Progress:
    """A bar over all seeds' environment steps. Warm-up has its own bar, as it is much faster than training."""

    def __init__(self, config: Config, steps: Sequence[int], shown: bool):
        self.warm_up = min(config.learning_starts, config.steps)
        self.name, self.shown = f"{config.algo} {config.env}", shown
        done = sum(min(n, self.warm_up) for n in steps)
        self.bars = [
            ("warm-up", self.warm_up * len(steps), done),
            ("training", (config.steps - self.warm_up) * len(steps), sum(steps) - done),
        ]
        self.bar = self._next_bar()

    def _next_bar(self) -> tqdm:
        label, total, done = self.bars.pop(0)
        interval = 0.5 if sys.stderr.isatty() else 60.0  # seconds; a log file needs few lines
        return tqdm(
            total=total,
            initial=done,
            desc=f"{self.name} {label}",
            unit="step",
            disable=not self.shown,
            smoothing=0.1,
            mininterval=interval,
            maxinterval=interval,
        )

    def advance(self, count: int, step: int) -> None:
        """Count `count` environment steps; `step` is how far the seed furthest behind had come."""
        if self.bars and step >= self.warm_up:
            self.bar.close()
            self.bar = self._next_bar()
        self.bar.update(count)

    def show_evaluation(self, last: float, best: Sequence[float]) -> None:
        mean = sum(best) / max(len(best), 1)
        self.bar.set_postfix(last=f"{last:.2f}", best=f"{mean:.2f}", refresh=False)

    def show_final_evaluation(self) -> None:
        self.bar.set_description(f"{self.name} final evaluation")

    def close(self) -> None:
        self.bar.close()
