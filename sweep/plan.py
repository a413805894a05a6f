"""The plan of a sweep: its cells with their states and what they are expected to take, longest first."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from algos import saved_config
from core.config import Config
from plots.tables import Table, text_cells, to_terminal
from store.folder import Run, read_results
from sweep import estimates
from sweep.cells import Cell, State, cell_of, format_seeds, reached, shorten, state_of


@dataclass(frozen=True, eq=False)
class Entry:
    """One cell of the plan. `base` is the paper's configuration of it, `factor` corrects the estimates of time."""

    cell: Cell
    config: Config
    base: Config
    state: State
    factor: float

    def seconds(self, start: int) -> float:
        """What the training takes from step `start` on, by estimate, on one core."""
        return self.factor * estimates.seconds(self.config, self.base, len(self.cell.seeds), start)

    @property
    def remaining(self) -> float:
        """Seconds that are left to do."""
        return 0.0 if self.state.name == "finished" else self.seconds(self.state.step)

    @property
    def memory(self) -> float:
        return estimates.memory(self.config, len(self.cell.seeds))

    def progress(self) -> float:
        """The share of the cell's time that is done, as far as the run folders tell."""
        steps = self.config.steps
        step = sum(reached(folder, steps) for folder in self.cell.folders) // len(self.cell.seeds)
        return 1.0 - self.seconds(step) / self.seconds(0) if step < steps else 1.0


def make_plan(cells: Sequence[tuple[Config, Config]], jobs: Mapping[str, str]) -> list[Entry]:
    """The plan of `cells`, each (configuration, the paper's of the same cell); `jobs` as `state_of` takes them."""
    bases = {(base.env, base.algo): base for _, base in cells}
    runs, _ = read_results(cell_of(*cells[0]).root, {task for task, _ in bases}, {algo for _, algo in bases})
    factors = estimates.corrections(
        ((run, _config_of(run), bases[run.task, run.algo]) for run in runs if (run.task, run.algo) in bases),
        cells[0][0].device,  # one command has one device
    )
    entries = []
    for config, base in cells:
        cell = cell_of(config, base)
        state = state_of(cell, jobs)
        if config.overwrite and state.name not in ("running", "queued", "unknown"):
            state = State("new", detail="starts again")
        entries.append(Entry(cell, config, base, state, estimates.correct(factors, config.env, config.algo)))
    return sorted(entries, key=lambda entry: -entry.remaining)


def _config_of(run: Run) -> Config:
    return saved_config(run.config | {"env": run.task, "algo": run.algo})


def describe_plan(entries: Sequence[Entry], jobs: int) -> str:
    """The plan as a table, its totals, and when all is done with `jobs` cells at a time."""
    names, shared = shorten([entry.cell for entry in entries])
    rows = [
        text_cells(
            entry.config.env,
            name,
            format_seeds(entry.cell.seeds),
            describe_state(entry.state),
            estimates.in_words(entry.remaining) if entry.remaining else "–",
            f"{entry.memory / 1e9:.1f} GB" if entry.remaining else "–",
        )
        for entry, name in zip(entries, names, strict=True)
    ]
    table = Table(
        name="plan",
        title=f"The plan, longest first{shared and ' (all with '}{shared}{shared and ')'}:",
        header=["task", "algorithm", "seeds", "state", "time left", "memory"],
        labels=4,
        sections=[rows],
        records=[],
    )
    left = [entry for entry in entries if entry.remaining]
    work = [entry.remaining for entry in left]
    states = [entry.state for entry in entries]
    lines = [to_terminal(table, bold=False, width=None), count_states(states)]
    lines += list_details([entry.cell for entry in entries], states)
    if left:
        memory = sum(sorted((entry.memory for entry in left), reverse=True)[:jobs])
        jobs = min(jobs, len(left))
        if left[0].config.device != "cpu":
            lines.append("note: the estimates are for the CPU; GPUs are not measured")
        lines.append(
            f"estimate: {estimates.in_words(sum(work))} on one core in all;"
            f" {estimates.in_words(estimates.makespan(work, jobs))} with {jobs} cell{'s' * (jobs > 1)} at a time,"
            f" on a core each, in up to {memory / 1e9:.1f} GB of memory"
        )
    return "\n".join(lines)


def describe_state(state: State) -> str:
    """A few words: the state, where it would resume, and who has the cell."""
    words = state.name
    if state.step and state.name != "finished":
        words += f", {'at least' if state.name == 'running' else 'resumes from'} step {state.step}"
    return f"{words}: {state.detail}" if state.name in ("queued", "running") else words


def list_details(cells: Sequence[Cell], states: Sequence[State]) -> list[str]:
    """A line for each cell whose state has a reason: failed, diverged, interrupted with its job."""
    return [
        f"{cell.name} seed={format_seeds(cell.seeds)}: {state.detail}"
        for cell, state in zip(cells, states, strict=True)
        if state.detail and state.name not in ("queued", "running")
    ]


def count_states(states: Sequence[State]) -> str:
    """How many cells are in which state."""
    counts = Counter(state.name for state in states)
    return f"{len(states)} cell{'s' * (len(states) > 1)}: " + ", ".join(f"{n} {name}" for name, n in counts.items())


def memory_warning(entries: Sequence[Entry], jobs: int) -> str:
    """A line where the cells at a time may need more memory than this machine has; else empty."""
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    needed = sum(sorted((entry.memory for entry in entries if entry.remaining), reverse=True)[:jobs])
    if needed <= there:
        return ""
    return f"note: {jobs} cells at a time may need {needed / 1e9:.0f} GB of memory, and there are {there / 1e9:.0f}"
