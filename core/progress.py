"""Progress bars of a training, and the time that its phases take."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from core.config import Config

EVALUATION_DELAY = 2.0
"""Seconds after which an evaluation shows its own bar."""


class PhaseTimer:
    """Measures the seconds of a training, in total and by phase, without the time between a stop and the resumption."""

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
        """Seconds of each phase, and "total" seconds since the start."""
        return self.phases | {"total": time.perf_counter() - self.started}

    def restore(self, seconds: dict[str, float]) -> None:
        """Continue from a saved value of `seconds`."""
        self.phases = {phase: seconds[phase] for phase in self.phases}
        self.started = time.perf_counter() - seconds["total"]


class Progress:
    """A bar over all seeds' environment steps. Warm-up has its own bar, as it is much faster than training."""

    def __init__(self, config: Config, steps: Sequence[int], shown: bool):
        self.warm_up = min(config.learning_starts, config.steps)
        together = f" ({len(steps)} seeds together)" if len(steps) > 1 else ""
        self.name, self.shown = f"{config.algo} {config.env}{together}", shown
        done = sum(min(n, self.warm_up) for n in steps)
        self.bars = [
            ("warm-up", self.warm_up * len(steps), done),
            ("training", (config.steps - self.warm_up) * len(steps), sum(steps) - done),
        ]
        self.bar = self._next_bar()

    def _next_bar(self) -> tqdm:
        label, total, done = self.bars.pop(0)
        return self._bar(label, total, initial=done, smoothing=0.1)

    def _bar(self, label: str, total: int, **options: Any) -> tqdm:
        interval = 0.5 if sys.stderr.isatty() else 60.0  # seconds; a log file needs few lines
        intervals = {"mininterval": interval, "maxinterval": interval}
        return tqdm(
            total=total, desc=f"{self.name} {label}", unit="step", disable=not self.shown, **intervals, **options
        )

    @contextmanager
    def evaluation(self, steps: int) -> Iterator[Callable[[int], Any]]:
        """Show a second bar during a long evaluation of at most `steps` steps. Yields a function that counts steps."""
        with self._bar("evaluation", steps, leave=False, delay=EVALUATION_DELAY) as bar:
            yield bar.update

    def advance(self, count: int, step: int) -> None:
        """Count an environment step of `count` seeds. `step` is the smallest step of these seeds before the count."""
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
