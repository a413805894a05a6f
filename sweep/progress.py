"""The progress of a sweep on this machine: bars on a terminal, few lines in a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tqdm import tqdm

from sweep.estimates import in_words, makespan
from sweep.exit import Exit
from sweep.plan import Entry
from sweep.states import Stage

BAR = "{desc} {percentage:3.0f}%|{bar}|"
INTERVALS = (2.0, 60.0)
"""Seconds between two checks of the run folders: for a terminal, and for a file."""


class End(NamedTuple):
    """How the process of a cell ended."""

    code: int
    seconds: float
    reason: str


class Display:
    """Shows which cells are done, running and failed, and the time left: a bar for all and one for each process."""

    def __init__(self, entries: Sequence[Entry], jobs: int):
        self.entries, self.jobs = entries, jobs
        self.done = [entry for entry in entries if entry.state.stage is Stage.FINISHED]
        self.diverged = [entry for entry in self.done if entry.state.detail]
        self.failed: dict[Entry, End] = {}
        self.seconds = self.estimated = 0.0  # of processes that ended well: actual time and estimate
        self.terminal = sys.stderr.isatty()
        self.next_look = 0.0 if self.terminal else time.monotonic() + INTERVALS[1]

    def __enter__(self) -> Display:
        count = 1 + min(self.jobs, len(self.entries) - len(self.done)) if self.terminal else 0
        self.bars = [tqdm(total=1.0, position=i, bar_format=BAR, leave=False) for i in range(count)]
        self.say(f"cells: {len(self.entries)}, finished already: {len(self.done)}, at a time: {self.jobs}")
        return self

    def __exit__(self, *_: object) -> None:
        for bar in reversed(self.bars):  # the first is the only one that leaves the cursor at the start of its line
            bar.close()

    def say(self, line: str) -> None:
        """Print a line that stays."""
        tqdm.write(line, file=sys.stderr)

    def end(self, entry: Entry, end: End) -> None:
        """Count a cell whose process has ended."""
        if end.code not in (Exit.DONE, Exit.DIVERGED):
            self.failed[entry] = end
            self.say(f"{entry.cell.name}: failed after {in_words(end.seconds)}: {end.reason}")
            return
        self.done.append(entry)
        self.seconds, self.estimated = self.seconds + end.seconds, self.estimated + entry.remaining
        if end.code == Exit.DIVERGED:
            self.diverged.append(entry)
        how = "finished (a seed diverged)" if end.code == Exit.DIVERGED else "finished"
        self.say(f"{entry.cell.name}: {how} after {in_words(end.seconds)} ({len(self.done)} of {len(self.entries)})")

    def show(self, running: Mapping[Entry, float]) -> None:
        """Show how far the `running` cells are; each comes with the seconds since its start."""
        if time.monotonic() < self.next_look:
            return
        self.next_look = time.monotonic() + INTERVALS[0 if self.terminal else 1]
        shares = {entry: entry.progress() for entry in running}
        line = f"{self._done()}, {len(running)} running"
        if self.failed:
            line += f", {len(self.failed)} failed"
        line += f", ETA {in_words(self._eta(running, shares))}"
        if not self.terminal:
            cells = ", ".join(f"{entry.cell.name} {share:.0%}" for entry, share in shares.items())
            self.say(f"{line} ({cells})")
            return
        total = sum(entry.seconds(0) for entry in self.entries)
        over = sum(entry.seconds(0) for entry in (*self.done, *self.failed))
        self._set(self.bars[0], line, (over + sum(e.seconds(0) * share for e, share in shares.items())) / total)
        for bar, entry in zip(self.bars[1:], [*running, None][: len(self.bars) - 1], strict=False):
            self._set(bar, f"  {entry.cell.name}" if entry else "", shares[entry] if entry else 0.0)

    def _set(self, bar: tqdm, text: str, share: float) -> None:
        bar.n = min(max(share, 0.0), 1.0)
        bar.set_description_str(text, refresh=False)
        bar.refresh()

    def _eta(self, running: Mapping[Entry, float], shares: Mapping[Entry, float]) -> float:
        """Seconds until the end, if the rest takes longer or shorter than estimated by the same factor as so far."""
        left = {entry: entry.seconds(0) * (1.0 - share) for entry, share in shares.items()}
        done = sum(max(0.0, entry.remaining - left[entry]) for entry in running)
        took, estimated = self.seconds + sum(running.values()), self.estimated + done
        pace = took / estimated if done or self.estimated else 1.0
        over = {*self.done, *self.failed, *running}
        waiting = [entry.remaining for entry in self.entries if entry not in over]
        return makespan([pace * seconds for seconds in (*left.values(), *waiting)], self.jobs)

    def _done(self) -> str:
        return f"{len(self.done)} of {len(self.entries)} cell{'s' * (len(self.entries) != 1)} done"

    def summary(self) -> str:
        """The last line: the numbers of cells that are done, diverged, failed and not done."""
        open_cells = len(self.entries) - len(self.done) - len(self.failed)
        parts = [self._done()]
        parts += [f"{len(self.diverged)} of them with a seed that diverged"] if self.diverged else []
        parts += [f"{len(self.failed)} failed"] if self.failed else []
        parts += [f"{open_cells} not done"] if open_cells else []
        return ", ".join(parts)
