"""`run.py status`: the states of the cells in a folder of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from core.config import parse_seeds
from core.words import ConfigError
from store.files import user_path
from store.folder import find_runs, has_ended, read_settings
from sweep.cells import RECORDS, CellFolders, format_seeds, shorten
from sweep.states import NO_ANSWER, CellState, count_states, job_states, list_details, reached, state_of
from tables import Table, text_cells, to_terminal


def find_cells(root: Path) -> list[CellFolders]:
    """The cells below `root`: those of sweeps from their records; other runs of one task and variant form one cell."""
    cells: dict[CellFolders, None] = {}
    for record in sorted((root / RECORDS).glob("*/*/seed=*.*")):
        if record.suffix in (".log", ".job"):
            with suppress(ConfigError):  # a file of the user's own
                seeds = parse_seeds(record.stem.removeprefix("seed="))
                cells[CellFolders(root, record.parent.parent.name, record.parent.name, seeds)] = None
    known = {folder for cell in cells for folder in cell.folders}
    others: dict[tuple[str, str], list[int]] = {}
    for folder in find_runs(root):
        if folder not in known:
            key = folder.parent.parent.name, folder.parent.name
            others.setdefault(key, []).append(int(folder.name.removeprefix("seed=")))
    for (task, variant), found in others.items():
        cells[CellFolders(root, task, variant, tuple(sorted(found)))] = None
    return sorted(cells, key=lambda cell: (cell.task, cell.variant, cell.seeds))


def describe_status(words: Sequence[str]) -> str:
    """The text of `run.py status FOLDER` or `results=FOLDER`. Raises ConfigError if the folder has no cells."""
    if len(words) != 1:
        raise ConfigError(f"expected one folder of results, as in `run.py status results/`, got {len(words)}")
    root = user_path(words[0].removeprefix("results="))
    if not root.is_dir():
        raise ConfigError(f"{root} is not a folder")
    cells = find_cells(root)
    if not cells:
        raise ConfigError(f"no cells in {root} (looked for <task>/<algorithm>/seed=<n> in it)")
    jobs = job_states(cells)
    states = [state_of(cell, jobs) for cell in cells]
    lines = [_table(cells, states), count_states(states), *list_details(cells, states)]
    if NO_ANSWER in jobs.values():
        lines.append("(squeue does not answer: jobs may be queued or running on the cluster)")
    return "\n".join(lines)


def _table(cells: Sequence[CellFolders], states: Sequence[CellState]) -> str:
    names, shared = shorten(cells)
    rows = [
        text_cells(cell.task, name, format_seeds(cell.seeds), _progress(cell, state), state.describe())
        for cell, name, state in zip(cells, names, states, strict=True)
    ]
    title = f"Cells{shared and f' (all with {shared})'}:"
    header = ["task", "algorithm", "seeds", "steps", "state"]
    table = Table("status", title, header, labels=5, sections=[rows], records=[])
    return to_terminal(table, bold=False, width=None)


def _progress(cell: CellFolders, state: CellState) -> str:
    """As text: steps of the unfinished seed furthest behind, steps of the run, and the number of ended seeds."""
    left = [folder for folder in cell.folders if not has_ended(folder)]
    if not left:
        return "all"
    settings: Mapping = next(filter(None, map(read_settings, left)), {})
    if "steps" not in settings:
        return "none"
    ended = f" ({len(cell.seeds) - len(left)} seeds ended)" if len(left) < len(cell.seeds) else ""
    return f"{min(reached(folder, settings['steps']) for folder in left)}/{settings['steps']}{ended}"
