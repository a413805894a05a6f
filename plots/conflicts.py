"""Separates and reports runs that name the same task or algorithm but were trained on different definitions of it."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from store.definition import Description, differences, is_own
from store.folder import Run, read_definition
from store.info import read_info

_UNKNOWN = "unknown"


def keep_apart(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Separate runs whose task or algorithm has several definitions; return all runs and a line for each conflict.

    Such a run gets one more setting, `task_definition` or `algorithm_definition`, which separates it in all tables and
    figures. A run without a stored definition is older than this feature. It conflicts only with a user's definition.
    """
    definitions = [read_definition(run.folder) for run in runs]
    extra: list[dict[str, str]] = [{} for _ in runs]
    notes = []
    for part in ("task", "algorithm"):
        by_name = defaultdict(list)
        for i, run in enumerate(runs):
            by_name[run.task if part == "task" else run.algo].append(i)
        for name, members in by_name.items():
            marks = {i: _mark((definitions[i] or {}).get(part)) for i in members}
            known = [i for i in members if marks[i] != _UNKNOWN]
            own = all(is_own(definitions[i][part]) for i in known)  # type: ignore[index]
            kinds = {marks[i] for i in (known if own else members)}
            if len(kinds) < 2:
                continue
            for i in members:
                extra[i][f"{part}_definition"] = marks[i]
            # The first run of each definition, by starting time.
            members.sort(key=lambda i: str(read_info(runs[i].folder).get("started", "")))
            firsts: dict[str, int] = {}
            for i in members:
                if marks[i] in kinds:
                    firsts.setdefault(marks[i], i)
            i, *others = firsts.values()
            for j in others:
                one, other = definitions[i], definitions[j]
                what = differences(one[part], other[part]) if one and other else "one of them is unknown"
                notes.append(f"{name} has two definitions: {what} (then {runs[i].folder}, now {runs[j].folder})")
    apart = [
        replace(run, overrides=run.overrides | more, config=run.config | more) if more else run
        for run, more in zip(runs, extra, strict=True)
    ]
    return apart, notes


def _mark(description: Description | None) -> str:
    """A short name of a definition."""
    if description is None:
        return _UNKNOWN
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()[:6]
