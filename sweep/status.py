"""How the cells in a folder of results stand: from the run folders, the records of sweeps, and Slurm's queue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from core.config import ConfigError, parse_seeds
from plots.tables import Table, text_cells, to_terminal
from store.folder import find_runs, has_ended, read_settings
from sweep.cells import NO_ANSWER, RECORDS, Cell, State, format_seeds, job_states, reached, shorten, state_of
from sweep.plan import count_states, describe_state, list_details


def find_cells(root: Path) -> list[Cell]:
    """The cells below `root`: as they were submitted or started by a sweep; runs that no sweep knows by the folder."""
    cells: dict[Cell, None] = {}
    for record in sorted((root / RECORDS).glob("*/*/seed=*.*")):
        if record.suffix in (".log", ".job"):
            seeds = tuple(parse_seeds(record.stem.removeprefix("seed=")))
            cells[Cell(root, record.parent.parent.name, record.parent.name, seeds)] = None
    known = {folder for cell in cells for folder in cell.folders}
    others: dict[tuple[str, str], list[int]] = {}
    for folder in find_runs(root):
        if folder not in known:
            key = folder.parent.parent.name, folder.parent.name
            others.setdefault(key, []).append(int(folder.name.removeprefix("seed=")))
    for (task, variant), found in others.items():
        cells[Cell(root, task, variant, tuple(sorted(found)))] = None
    return sorted(cells, key=lambda cell: (cell.task, cell.variant, cell.seeds))


def describe_status(words: Sequence[str]) -> str:
    """The table of `run.py status FOLDER`. ConfigError for another number of folders, or one without any cells."""
    if len(words) != 1:
        raise ConfigError(f"expected one folder of results, as in `run.py status results/`, got {len(words)}")
    root = Path(words[0]).expanduser()
    if not root.is_dir():
        raise ConfigError(f"{root} is not a folder")
    cells = find_cells(root)
    if not cells:
        raise ConfigError(f"no cells in {root} (looked for <task>/<algorithm>/seed=<n> in it)")
    jobs = job_states(cells)
    states = [state_of(cell, jobs) for cell in cells]
    lines = [_table(cells, states), count_states(states), *list_details(cells, states)]
    if NO_ANSWER in jobs.values():
        lines.append("(squeue does not answer: which jobs are queued or running on the cluster is unknown)")
    return "\n".join(lines)


def _table(cells: Sequence[Cell], states: Sequence[State]) -> str:
    names, shared = shorten(cells)
    rows = [
        text_cells(cell.task, name, format_seeds(cell.seeds), _progress(cell, state), describe_state(state))
        for cell, name, state in zip(cells, names, states, strict=True)
    ]
    title = f"Cells{shared and ' (all with '}{shared}{shared and ')'}:"
    header = ["task", "algorithm", "seeds", "steps", "state"]
    table = Table("status", title, header, labels=5, sections=[rows], records=[])
    return to_terminal(table, bold=False, width=None)


def _progress(cell: Cell, state: State) -> str:
    """How far the seeds that have not ended are, of how many steps, and how many have ended."""
    left = [folder for folder in cell.folders if not has_ended(folder)]
    if not left:
        return "all"
    settings: Mapping = next(filter(None, map(read_settings, left)), {})
    if "steps" not in settings:
        return "none"
    ended = f" ({len(cell.seeds) - len(left)} seeds ended)" if len(left) < len(cell.seeds) else ""
    return f"{min(reached(folder, settings['steps']) for folder in left)}/{settings['steps']}{ended}"
