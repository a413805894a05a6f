"""Cells: an algorithm on a task with some seeds, which one process trains in lockstep.

    results/sweep/<task>/<variant>/
        seed=<seeds>.log     the output of the cell's processes on this machine, one after the other
        seed=<seeds>.job     the Slurm job that trains the cell, its cluster and its log
        seed=<seeds>.end     how the cell's last process failed: exit code, log and reason

The runs themselves are in their usual folders: see store/folder.py.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from algos import ALGORITHMS, PAPER, paper_settings, setting_keys
from core.config import Config, differences, keys_that_apply, resolve, saved_settings, split_values
from core.words import ConfigError, known_name, parse_words, split_names
from envs import TASKS
from store.files import replace_file, user_path
from store.folder import parse_variant, run_folder, variant_folder, variant_name
from sweep.exit import Exit
from sweep.plugins import load_plugins, plugin_words

RECORDS = "sweep"
"""The subfolder of the results folder with logs and records."""


@dataclass(frozen=True)
class CellFolders:
    """The folders of a cell's runs and records. `root` is the results folder; `seeds` are in ascending order."""

    root: Path
    task: str
    variant: str
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        return f"{parse_variant(self.variant)[0]} {self.task}"

    @property
    def folders(self) -> list[Path]:
        """The folder of each seed's run."""
        return [run_folder(self.root, self.task, self.variant, seed) for seed in self.seeds]

    def record(self, kind: str) -> Path:
        """The path of the file `kind`: "log", "job" or "end"."""
        return self.root / RECORDS / self.task / self.variant / f"seed={format_seeds(self.seeds)}.{kind}"

    def read(self, kind: str) -> dict[str, Any]:
        """Read the record `kind`; empty if there is none."""
        try:
            record = json.loads(self.record(kind).read_text())
        except (OSError, ValueError):
            return {}
        return record if isinstance(record, dict) else {}

    def write(self, kind: str, content: Mapping[str, Any]) -> None:
        """Write the record `kind`."""
        path = self.record(kind)
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, lambda file: file.write(json.dumps(content).encode() + b"\n"))

    @property
    def job(self) -> str:
        """The cell's last Slurm job and its cluster, as job numbers repeat across clusters; empty without one."""
        record = self.read("job")
        return f"{record['job']} of cluster {record['cluster']}" if record.get("cluster") else record.get("job", "")

    def note_end(self, code: int, log: Path, reason: str = "") -> None:
        """Record how a process of this cell failed, or delete the record if it ended well.

        Without a `reason`, `reason_of` finds it in the log.
        """
        if code in (Exit.DONE, Exit.DIVERGED):
            self.record("end").unlink(missing_ok=True)
        else:
            self.write("end", {"exit_code": code, "log": str(log), "reason": reason})


@dataclass(frozen=True)
class Cell(CellFolders):
    """A cell to train: its configuration and the paper's configuration of the same algorithm and task."""

    config: Config = field(compare=False)
    paper: Config = field(compare=False)

    @classmethod
    def of(cls, config: Config) -> Cell:
        """The cell that `config` describes."""
        paper = paper_config(config.algo, config.env)
        changed = differences(config, paper)
        for key, value in changed.items():
            if "/" in str(value):
                raise ConfigError(
                    f"bad value {value!r} for {key}: it is part of the run's folder name, so it cannot have a '/'"
                )
        return cls(
            root=user_path(config.results),
            task=config.env,
            variant=variant_folder(variant_name(config.algo, changed)),
            seeds=config.seeds,
            config=config,
            paper=paper,
        )

    def __reduce__(self) -> tuple:
        # A cell is pickled as its words: the classes of configurations are made at run time.
        return _cell_of, (self.words,)

    @property
    def full_variant(self) -> str:
        """The algorithm and all of its settings that differ from the paper's, of any length."""
        return variant_name(self.config.algo, differences(self.config, self.paper))

    def settings(self, seed: int) -> dict[str, object]:
        """The content of config.yaml of a seed's run."""
        named = {} if self.variant == self.full_variant else {"variant": self.full_variant}
        return saved_settings(self.config, seed) | named

    @property
    def words(self) -> list[str]:
        """The words after `run.py` that train this cell alone."""
        config = self.config
        words = {"algo": config.algo, "env": config.env, "seed": format_seeds(self.seeds)}
        words |= parse_variant(self.full_variant)[1]
        if config.quick:  # it changes these two, so even the paper's values must be given
            words |= {"eval_episodes": str(config.eval_episodes), "final_episodes": str(config.final_episodes)}
        words |= {"results": str(self.root.absolute()), "overwrite": config.overwrite}
        words |= {"device": config.device, "threads": str(config.threads)}
        words |= {"checkpoint_every": str(config.checkpoint_every), "log": config.log}
        if config.simulator is not None:
            words["simulator"] = config.simulator
        return [*plugin_words(), *(f"{key}={value}" for key, value in words.items())]


def paper_config(name: str, task: str) -> Config:
    """The paper's configuration of the algorithm `name` on `task`."""
    robot = TASKS[task].robot
    simulator = next(iter(robot.simulators), None)
    return replace(paper_settings(name, task, robot, TASKS[task].steps), simulator=simulator)


def make_cells(settings: Mapping[str, str]) -> list[Cell]:
    """The cells that `settings` ask for: every algorithm of `algo` on every task of `env`.

    A comma-separated list of values gives a cell for each value, several lists a cell for each combination;
    `split_values` defines lists. A setting that only some of the algorithms have applies to those. Raises ConfigError
    for settings that do not fit.
    """
    for key, choices in (("algo", [*ALGORITHMS, "paper", "all"]), ("env", [*TASKS, "all"])):
        if key not in settings:
            raise ConfigError(f"{key}= is missing (choices: {', '.join(choices)})")
    names = split_names("algorithm", settings["algo"], ALGORITHMS, {"paper": PAPER})
    tasks = split_names("task", settings["env"], TASKS)
    papers = [paper_config(name, task) for task in tasks for name in names]

    def applies(key: str, paper: Config) -> bool:
        # A key that no algorithm has is a mistake, which `resolve` reports.
        return key in keys_that_apply(paper) or not any(key in keys_that_apply(other) for other in papers)

    for task in tasks if "simulator" in settings else ():
        if simulators := TASKS[task].robot.simulators:
            known_name(f"simulator of {task}", settings["simulator"], simulators)
    cells = [
        Cell.of(resolve(paper, words))
        for paper in papers
        for words in _combinations(paper, {key: text for key, text in settings.items() if applies(key, paper)})
    ]
    return list(dict.fromkeys(cells))  # 1e-3 and 0.001 are the same cell


def _combinations(paper: Config, settings: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """One value of every setting, in all combinations; the last setting changes fastest."""
    known = keys_that_apply(paper)
    values = [split_values(type(paper), key, text) if key in known else [text] for key, text in settings.items()]
    for combination in product(*values):
        yield dict(zip(settings, combination, strict=True))


def _cell_of(words: Sequence[str]) -> Cell:
    (cell,) = make_cells(parse_words(load_plugins(words), setting_keys()))
    return cell


def shorten(cells: Sequence[CellFolders]) -> tuple[list[str], str]:
    """The cells' variants without the settings that all cells share, and these shared settings as text."""
    variants = [parse_variant(cell.full_variant if isinstance(cell, Cell) else cell.variant) for cell in cells]
    shared = set.intersection(*(set(settings.items()) for _, settings in variants))
    names = [variant_name(algo, dict(settings.items() - shared)) for algo, settings in variants]
    return names, " ".join(f"{key}={value}" for key, value in sorted(shared))


def format_seeds(seeds: Sequence[int]) -> str:
    """Write ascending seeds as `parse_seeds` reads them, with ranges: 0-9,12."""
    parts: list[list[int]] = []
    for seed in seeds:
        if parts and seed == parts[-1][-1] + 1:
            parts[-1][1:] = [seed]
        else:
            parts.append([seed])
    return ",".join("-".join(map(str, part)) for part in parts)
