"""Publish finished runs: add them to the data in the repository.

    python bench/publish.py results/                         # all its cells, to docs/data
    python bench/publish.py results/ env=R+L2 algo=DPre+     # these cells only
    python bench/publish.py results/ settings=any            # runs of a study, with other settings than the paper's
    python bench/publish.py results/ out=DIR                 # to another folder

A cell (task, algorithm and settings) is published with all its seeds or not at all, so that no seed is dropped. A cell
is refused if one of its runs has not ended, lacks its provenance, ran with uncommitted code, resumed at another commit,
has other settings than its folder's name says or, without `settings=any`, other settings than the paper's. A published
seed is never replaced: another run of the same seed is refused, but not the rest of its cell. If runs are refused, the
command prints each with the reason, publishes the rest, and exits with code 1.

The files are described in store/published.py; `python plot.py docs/data` makes tables and figures from them.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from algos import ALGORITHMS, saved_config
from core.config import differences
from core.words import ConfigError, parse_words, split_names
from envs import TASKS
from store.files import one_line, user_path
from store.folder import Run, find_runs, has_ended, parse_variant, read_run, variant_folder, variant_name
from store.published import PublishedRun, check_evaluations, read_published, write_published
from sweep.cells import paper_config

OUT = "docs/data"


_DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""The errors that files of a run cause if another program wrote or damaged them."""


class RefusedError(Exception):
    """A run that must not be published; the message says why."""


def publish(
    root: Path, out: Path, tasks: Sequence[str] | None, algos: Sequence[str] | None, any_settings: bool
) -> tuple[list[str], list[str]]:
    """Publish the cells of `root` in `out`; return the published and the refused runs, a line each.

    `tasks` and `algos` select cells; None selects all. Raises ConfigError if no cell is selected.
    """
    cells: dict[tuple[str, str], list[Path]] = defaultdict(list)
    for folder in find_runs(root):
        task, variant = folder.parent.parent.name, folder.parent.name
        if (tasks is None or task in tasks) and (algos is None or parse_variant(variant)[0] in algos):
            cells[task, variant].append(folder)
    if not cells:
        which = "" if tasks is None and algos is None else " of these tasks and algorithms"
        raise ConfigError(f"no runs{which} in {root} (looked for <task>/<algorithm>/seed=<n> in it)")
    there = {(run.run.task, *run.key): run for run in read_published(out)}
    fresh: dict[str, list[PublishedRun]] = defaultdict(list)
    published, refused = [], []
    for (task, variant), folders in cells.items():
        ready, problems = [], []
        for folder in folders:
            try:
                run = checked(folder, any_settings)
            except RefusedError as error:
                problems.append(f"{folder}: {error}")
                continue
            published_before = there.get((task, *run.key))
            if published_before is None:
                ready.append(run)
            elif published_before.row() != run.row():
                refused.append(f"{folder}: another run of this seed is published already")
        if problems:
            refused += problems + [f"{run.run.folder}: another seed of its cell is refused" for run in ready]
        else:
            fresh[task] += ready
            published += [f"{task} {variant} seed {run.run.seed}: {run.state}" for run in ready]
    for task, runs in fresh.items():
        if runs:
            write_published(out / task, [run for (name, *_), run in there.items() if name == task] + runs)
    return published, refused


def checked(folder: Path, any_settings: bool) -> PublishedRun:
    """The run in `folder`. Raises RefusedError with the reason why it must not be published."""
    if not has_ended(folder):
        raise RefusedError("it has not ended")
    try:
        run = read_run(folder)
        if run.result and run.failure:
            raise RefusedError("it has result.json and failed.json")
        _check_settings(run, any_settings)
        check_evaluations(run)
    except _DAMAGED as error:
        raise RefusedError(_reason(error)) from error
    try:
        info = json.loads((folder / "info.json").read_text())
        _check_provenance(info)
    except _DAMAGED as error:
        raise RefusedError(f"info.json: {_reason(error)}") from error
    return PublishedRun(run, info)


def _reason(error: Exception) -> str:
    return f"no {error}" if isinstance(error, KeyError) else one_line(error)


def _check_provenance(info: Mapping[str, Any]) -> None:
    parts = [info, *info.get("resumed", [])]
    commits = list(dict.fromkeys(part.get("commit") for part in parts))
    if None in commits:
        raise RefusedError("its commit is not known")
    if any(part.get("dirty") is not False for part in parts):
        raise RefusedError("it ran with uncommitted changes")
    if len(commits) > 1:
        raise RefusedError(f"its parts ran at different commits: {', '.join(commits)}")
    for source in (source for part in parts for source in part.get("sources", [])):
        if source["commit"] is None or source["dirty"]:
            raise RefusedError(f"it ran with {source['file']}, of which no commit has that content")


def _check_settings(run: Run, any_settings: bool) -> None:
    if run.task not in TASKS or run.algo not in ALGORITHMS:
        raise RefusedError(f"unknown algorithm or task, {run.algo} on {run.task}")
    config = saved_config(run.config)
    variant = variant_folder(variant_name(config.algo, differences(config, paper_config(config.algo, config.env))))
    for says, holds in ((run.task, config.env), (run.variant, variant), ((run.seed,), config.seeds)):
        if says != holds:
            raise RefusedError(f"its folder says {says}, its config.yaml {holds}")
    if run.overrides and not any_settings:
        changed = " ".join(f"{key}={value}" for key, value in run.overrides.items())
        raise RefusedError(f"its settings are not the paper's: {changed} (settings=any publishes it)")
    if run.result is not None and run.result["steps"] != config.steps:
        raise RefusedError(f"it has {run.result['steps']} steps of {config.steps}")


def main(argv: Sequence[str]) -> int:
    if not argv or argv[0].startswith("-") or "=" in argv[0]:
        print(__doc__)
        return 0 if argv and argv[0] in ("-h", "--help") else 2
    root = user_path(argv[0])
    try:
        words = parse_words(argv[1:], ("env", "algo", "out", "settings"))
        if not root.is_dir():
            raise ConfigError(f"{root} is not a folder")
        tasks = split_names("task", words["env"], TASKS) if "env" in words else None
        algos = split_names("algorithm", words["algo"], ALGORITHMS) if "algo" in words else None
        if words.get("settings", "any") != "any":
            raise ConfigError(f"bad value {words['settings']!r} for settings (choices: any)")
        out = user_path(words.get("out", OUT))
        published, refused = publish(root, out, tasks, algos, "settings" in words)
    except (OSError, ValueError) as error:  # a ConfigError is a ValueError
        where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
        print(f"publish.py: {where}{one_line(error)}", file=sys.stderr)
        return 2
    for line in published or ["nothing new to publish"]:
        print(line)
    for line in refused:
        print(f"refused {line}", file=sys.stderr)
    return 1 if refused else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
