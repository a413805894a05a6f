"""The plan of a sweep: its cells with their states and their estimated time and memory, longest first."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from store.folder import read_results
from sweep import estimates
from sweep.cells import Cell, format_seeds, shorten
from sweep.definition import find_changed
from sweep.states import CellState, Stage, count_states, list_details, reached, state_of
from tables import Table, text_cells, to_terminal


@dataclass(frozen=True, eq=False)
class Entry:
    """One cell of the plan; `factor` corrects the estimates of its time.

    If `timed` is False, no similar cell was ever measured. The estimate then only serves to order the cells.
    """

    cell: Cell
    state: CellState
    factor: float
    timed: bool

    def seconds(self, start: int) -> float:
        """Estimated time of the training from step `start` on, on one core."""
        return self.factor * estimates.seconds(self.cell.config, self.cell.paper, len(self.cell.seeds), start)

    @property
    def remaining(self) -> float:
        """Estimated time of what is left to do, in seconds."""
        return 0.0 if self.state.stage is Stage.FINISHED else self.seconds(self.state.step)

    @property
    def memory(self) -> float:
        """Estimated memory in bytes."""
        return estimates.memory(self.cell.config, len(self.cell.seeds))

    def progress(self) -> float:
        """The share of the cell's time that has passed, according to its run folders."""
        steps = self.cell.config.steps
        step = sum(reached(folder, steps) for folder in self.cell.folders) // len(self.cell.seeds)
        return 1.0 - self.seconds(step) / self.seconds(0) if step < steps else 1.0


def make_plan(cells: Sequence[Cell], jobs: Mapping[str, str]) -> list[Entry]:
    """The plan of `cells`, longest first; `jobs` comes from `job_states`."""
    first = cells[0].config
    runs, _ = read_results(cells[0].root, {c.config.env for c in cells}, {c.config.algo for c in cells})
    factors = estimates.corrections(runs, first.device)  # one command has one device and one overwrite=
    changed = find_changed(cells) if first.overwrite == "changed" else {}
    entries = []
    for cell in cells:
        state = state_of(cell, jobs)
        again = first.overwrite == "true" or any(folder in changed for folder in cell.folders)
        if again and not state.stage.taken:
            state = CellState(Stage.NEW, detail="starts again")
        name = cell.config.env, cell.config.algo
        timed = name in factors or estimates.is_measured(*name)
        entries.append(Entry(cell, state, estimates.correct(factors, *name), timed))
    return sorted(entries, key=lambda entry: -entry.remaining)


def describe_plan(entries: Sequence[Entry], jobs: int) -> str:
    """The plan as text: a table, its totals, and the time that it takes with `jobs` cells at a time."""
    names, shared = shorten([entry.cell for entry in entries])
    rows = [
        text_cells(
            entry.cell.task,
            name,
            format_seeds(entry.cell.seeds),
            entry.state.describe(),
            _time_left(entry),
            f"{entry.memory / 1e9:.1f} GB" if entry.remaining else "–",
        )
        for entry, name in zip(entries, names, strict=True)
    ]
    table = Table(
        name="plan",
        title=f"The plan, longest first{shared and f' (all with {shared})'}:",
        header=["task", "algorithm", "seeds", "state", "time left", "memory"],
        labels=4,
        sections=[rows],
        records=[],
    )
    left = [entry for entry in entries if entry.remaining]
    work = [entry.remaining for entry in left if entry.timed]
    states = [entry.state for entry in entries]
    lines = [to_terminal(table, bold=False, width=None), count_states(states)]
    lines += list_details([entry.cell for entry in entries], states)
    if left:
        memory = _largest_memory(entries, jobs)
        jobs, unknown = min(jobs, len(left)), len(left) - len(work)
        if unknown:
            lines.append(
                f"note: the time of {unknown} cell{'s' * (unknown > 1)} is unknown: nothing similar was measured;"
                " it is known once such a run has finished in this folder"
            )
        if left[0].cell.config.device != "cpu":
            lines.append("note: the estimates are for the CPU; GPUs are not measured")
        if not work:
            lines.append(f"estimate: up to {memory / 1e9:.1f} GB of memory")
            return "\n".join(lines)
        lines.append(
            f"estimate{' without these' if unknown else ''}: {estimates.in_words(sum(work))} on one core in all;"
            f" {estimates.in_words(estimates.makespan(work, jobs))} with {jobs} cell{'s' * (jobs > 1)} at a time,"
            f" one core each, in up to {memory / 1e9:.1f} GB of memory"
        )
    return "\n".join(lines)


def _time_left(entry: Entry) -> str:
    if not entry.remaining:
        return "–"
    return estimates.in_words(entry.remaining) if entry.timed else "unknown"


def memory_warning(entries: Sequence[Entry], jobs: int) -> str:
    """A warning if `jobs` cells at a time may need more memory than this machine has; otherwise empty."""
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    needed = _largest_memory(entries, jobs)
    if needed <= there:
        return ""
    return f"note: {jobs} cells at a time may need {needed / 1e9:.0f} GB of memory; this machine has {there / 1e9:.0f}"


def _largest_memory(entries: Sequence[Entry], jobs: int) -> float:
    """Memory in bytes of the `jobs` largest cells that are left to do, together."""
    return sum(sorted((entry.memory for entry in entries if entry.remaining), reverse=True)[:jobs])
