"""The paper's tables of tasks and of hyperparameters, made from the definitions that the code runs with."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from typing import Any

from algos import ALGORITHMS, PAPER, setting_keys
from core.config import RUN_KEYS, keys_of
from envs.tasks import TASKS, Task
from tables import MISSING, Table, TableCell, text_cells


def task_table(tasks: Mapping[str, Task] = TASKS) -> Table:
    """The paper's Table "Experiment environments and constraints", with the steps of training."""
    sections, records = [], []
    for robot, names in groupby(tasks, lambda name: tasks[name].robot.__name__):
        rows: list[list[TableCell]] = []
        for name in names:
            task = tasks[name]
            dim = task.constraint.dim
            cells = text_cells("" if rows else f"{robot} (d = {dim})", name, task.description, f"{task.steps:,}")
            cells[2] = cells[2]._replace(tex=f"${task.formula}$")
            rows.append(cells)
            record = {"task": name, "robot": robot, "action_dim": dim, "steps": task.steps}
            records.append(record | {"description": task.description, "formula": task.formula})
        sections.append(rows)
    title = "Tasks: robot, additional constraint (the box [-1, 1]^d always holds as well), environment steps of a run"
    return Table("tasks", title, ["Environment", "Task", "Constraint", "Steps"], 3, sections, records)


def hyperparameter_table() -> Table:
    """The paper's Table "Hyperparameters used in the experiments", then the constants that it leaves to its sources."""
    columns = _configurations()
    tables = [ALGORITHMS[name].agent.paper for name in PAPER]
    in_paper = {key for table in tables for settings in table.values() for key in settings}
    published: list[list[TableCell]] = []
    further: list[list[TableCell]] = []
    records = []
    for key, setting in setting_keys().items():
        values = [config.get(key) for config in columns.values()]
        if key in (*RUN_KEYS, "steps") or all(value is None for value in values):
            continue
        row = text_cells(key, setting.metadata["help"], *(_text(value) for value in values))
        (published if key in in_paper else further).append(row)
        for (robot, family), value in zip(columns, values, strict=True):
            records.append({"setting": key, "robot": robot, "base": family, "value": value})
    header = ["Setting", "Meaning", *(f"{robot} {family}" for robot, family in columns)]
    spans = {robot: len(list(group)) for robot, group in groupby(robot for robot, _ in columns)}
    title = "Hyperparameters of the paper's table, then constants and protocol"
    return Table("hyperparameters", title, header, 2, [published, further], records, spans)


def _configurations() -> dict[tuple[str, str], dict[str, Any]]:
    """All settings by group of robots and family of algorithms.

    An algorithm gets its own column if one of its values differs from an earlier algorithm of its family.
    """
    columns: dict[tuple[str, str], dict[str, Any]] = {}
    for group in dict.fromkeys(group for algorithm in ALGORITHMS.values() for group in algorithm.agent.paper):
        for name, algorithm in ALGORITHMS.items():
            config = algorithm.paper_config(name, "", group, steps=0)
            settings = {key: getattr(config, f.name) for key, f in keys_of(config).items()}
            column = columns.setdefault((group, algorithm.agent.family), {})
            if any(column.get(key, value) != value for key, value in settings.items() if key != "algo"):
                column = columns.setdefault((group, name), {})
            column |= settings
    return columns


def _text(value: Any) -> str:
    if value is None:
        return MISSING
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
