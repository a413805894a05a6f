"""The normalising flow of a cell's map: trained once for a task and its settings, then shared by all seeds.

    results/flows/<task>/<flow>-<checksum>/
        settings.json    the settings of the flow and the definition of the task; `<checksum>` in the folder's name is
                         the checksum of this file
        training.csv     step, seconds, and the measures of `core.flow_training` at that step
        checkpoint.pt    while the training is unfinished
        flow.pt          the parameters, the measures and where they come from; written last, so its presence means that
                         the training is finished
    results/flows/<task>/<flow>-<checksum>.lock
                         while a process trains it; others wait for it

Each run saves the flow with its parameters, so it needs this folder only at its start.
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import envs
from algos import ALGORITHMS
from constraints import ConstraintError, EmptySetError
from core.config import Config
from core.flow import Flow
from core.flow_training import DivergedError, FlowTraining
from core.words import ConfigError
from envs import TASKS
from store.definition import Description
from store.files import one_line, replace_file, user_path
from store.interrupt import Interrupted
from store.lock import LockedError, run_lock
from store.provenance import describe_environment
from store.tensors import load_tensors, save_tensors

FOLDER = "flows"
"""The subfolder of the results folder with flows."""
VERSION = 2
"""The version of the training of flows, part of the checksum."""
STATES = 20_000
"""Observations of random play; `core.flow_training.HELD_OUT` of them are kept for the measures."""
ROBOTS = 40
"""Robots that play at the same time."""
LONGEST_HOLD = 16
"""The most steps for which random play repeats an action: a new action in each step would cancel the last one."""
MEASURES = 20
"""Number of measurements in a training."""
SECONDS = 60.0
"""Time between checkpoints."""
WAITING = 1.0
"""Seconds between checks whether another process has trained the flow."""
GOOD, WIDE = 0.99, 0.5
"""A note is printed if accuracy or recall is below these."""


class FlowFolder:
    """The folder of the flow of `config`; `task` describes its task, as definition.json does."""

    def __init__(self, config: Config, flow: Flow, task: Description):
        of_training = {name: value for name, value in asdict(flow).items() if name != "flow_entropy"}
        settings = {"version": VERSION, "flow": of_training, "task": task}
        self.settings = json.dumps(settings, indent=2, sort_keys=True) + "\n"
        digest = hashlib.sha256(self.settings.encode()).hexdigest()[:12]
        self.path = user_path(config.results) / FOLDER / config.env / f"{flow.flow}-{digest}"

    def read(self) -> dict[str, Any] | None:
        """The trained flow, or None if there is none. ConfigError if the file is damaged."""
        return self._load("flow.pt", "delete it, and the next run trains the flow again")

    def checkpoint(self) -> dict[str, Any] | None:
        """The checkpoint to resume from, or None to start anew; a damaged one is reported on stderr."""
        try:
            return self._load("checkpoint.pt", "the training of the flow starts again")
        except ConfigError as error:
            print(error, file=sys.stderr)
            return None

    def _load(self, name: str, remedy: str) -> dict[str, Any] | None:
        path = self.path / name
        if not path.is_file():
            return None
        try:
            return load_tensors(path)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} is damaged ({one_line(error)}); {remedy}") from error

    def begin(self) -> None:
        """Make the folder with settings.json."""
        self.path.mkdir(parents=True, exist_ok=True)
        self._replace("settings.json", self.settings)

    def save_curve(self, rows: list[dict[str, float]]) -> None:
        lines = [",".join(rows[0]), *(",".join(map(repr, row.values())) for row in rows)]
        self._replace("training.csv", "\n".join(lines) + "\n")

    def save_checkpoint(self, content: Mapping[str, Any]) -> None:
        save_tensors(self.path / "checkpoint.pt", content)

    def finish(self, content: Mapping[str, Any]) -> None:
        save_tensors(self.path / "flow.pt", content)
        (self.path / "checkpoint.pt").unlink(missing_ok=True)

    def _replace(self, name: str, text: str) -> None:
        replace_file(self.path / name, lambda file: file.write(text.encode()))


def flow_of(
    config: Config, definition: Mapping[str, Description], stop_if_asked: Callable[[], None]
) -> dict[str, Any] | None:
    """The flow of the map of `config`, read from its folder or trained now; None if the map has no flow.

    The flow is a dict: `state` has the parameters, `measures` the last row of training.csv, and `info` the versions,
    commit and machine of the process that trained it, as in a run's info.json. `stop_if_asked` raises Interrupted to
    end the training with a checkpoint. Raises ConfigError if the flow cannot be trained.
    """
    algorithm = ALGORITHMS[config.algo]
    if not isinstance(algorithm.map, Flow):
        return None
    flow = cast("Flow", algorithm.map.configured(config))
    folder = FlowFolder(config, flow, definition["task"])
    while (trained := folder.read()) is None:
        try:
            with run_lock(folder.path):
                if folder.read() is None:  # another process may have finished it since
                    _train(config, flow, folder, stop_if_asked)
        except LockedError as error:
            print(f"waiting: {error}", file=sys.stderr)
            _wait(folder, stop_if_asked)
        except Interrupted:
            before = folder.checkpoint()
            step = before["training"]["step"] if before else 0
            print(f"interrupted at step {step} of {folder.path}; the same command resumes", file=sys.stderr)
            raise
        except ConstraintError as error:
            hint = "; on_empty='least' takes the least violating actions there" * isinstance(error, EmptySetError)
            raise ConfigError(f"the flow of {config.env} cannot be trained: {one_line(error)}{hint}") from error
    accuracy, recall = (trained["measures"][name] for name in ("accuracy", "recall"))
    if accuracy < GOOD:
        _note(f"the flow of {config.env} maps {100 * accuracy:.1f} % of the box into the set; the rest is projected")
    if recall < WIDE:
        _note(f"the flow of {config.env} reaches {100 * recall:.1f} % of the set; no policy can use the rest")
    return trained


def _note(text: str) -> None:
    print(f"note: {text}", file=sys.stderr)


def _wait(folder: FlowFolder, stop_if_asked: Callable[[], None]) -> None:
    """Wait until another process has trained the flow or has stopped."""
    while folder.read() is None:
        stop_if_asked()
        try:
            with run_lock(folder.path):
                return
        except LockedError:
            time.sleep(WAITING)


def _train(config: Config, flow: Flow, folder: FlowFolder, stop_if_asked: Callable[[], None]) -> None:
    """Train the flow, from its checkpoint if there is one, and save it."""
    folder.begin()
    before, rows, started = folder.checkpoint(), [], time.perf_counter()
    info = describe_environment(sys.orig_argv[1:])
    interval = 0.5 if sys.stderr.isatty() else 60.0  # seconds, as in `core.progress`
    name = f"{config.algo} {config.env} flow"
    with tqdm(total=flow.flow_steps, desc=name, unit="step", mininterval=interval, maxinterval=interval) as bar:
        training = FlowTraining(flow, TASKS[config.env].constraint, random_play(config, stop_if_asked), stop_if_asked)
        if before is not None:
            training.load_state(before["training"])
            rows, started = before["rows"], started - before["seconds"]
            bar.update(training.step)

        def checkpoint() -> None:
            seconds = time.perf_counter() - started
            with _reported(f"no checkpoint of the flow at step {training.step}"):
                folder.save_checkpoint({"training": training.state(), "rows": rows, "seconds": seconds})

        saved = time.perf_counter()
        try:
            while not training.ended:
                stop_if_asked()
                training.advance()
                bar.update()
                if training.step * MEASURES // flow.flow_steps > (training.step - 1) * MEASURES // flow.flow_steps:
                    seconds = time.perf_counter() - started
                    rows.append({"step": training.step, "seconds": round(seconds, 2), **training.measure()})
                    with _reported(f"no training.csv of the flow at step {training.step}"):
                        folder.save_curve(rows)
                    bar.set_postfix(accuracy=f"{rows[-1]['accuracy']:.3f}", refresh=False)
                if time.perf_counter() - saved > SECONDS:
                    checkpoint()
                    saved = time.perf_counter()
        except Interrupted:
            checkpoint()
            raise
        except DivergedError as error:
            raise ConfigError(
                f"the flow of {config.env} cannot be trained: {error}; try a smaller flow_learning_rate"
            ) from error
    folder.finish({"state": training.network.state_dict(), "measures": rows[-1], "info": info})


@contextmanager
def _reported(what: str) -> Iterator[None]:
    """Report an OSError and continue."""
    try:
        yield
    except OSError as error:
        tqdm.write(f"{what}: {one_line(error)}", file=sys.stderr)


@torch.no_grad()  # coefficients may be learned
def random_play(config: Config, stop_if_asked: Callable[[], None]) -> Tensor:
    """`STATES` observations (n, k) of the task's robot under random actions, each repeated for a while and projected.

    They are in order of time: at each step, the observations of all robots.
    """
    task, random = TASKS[config.env], np.random.default_rng(0)
    robots = [envs.make(config.env, simulator=config.simulator) for _ in range(ROBOTS)]
    try:
        obs = np.stack([robot.reset(seed=number)[0] for number, robot in enumerate(robots)])
        suggested = np.zeros((ROBOTS, task.constraint.dim))
        left = np.zeros(ROBOTS, np.int64)
        seen = []
        for _ in range(STATES // ROBOTS):
            stop_if_asked()
            fresh = left == 0
            suggested[fresh] = random.uniform(-2.0, 2.0, (fresh.sum(), task.constraint.dim)).clip(-1.0, 1.0)
            left[fresh] = random.integers(1, LONGEST_HOLD + 1, fresh.sum())
            left -= 1
            seen.append(torch.from_numpy(obs).float())
            actions = task.constraint.project(seen[-1], torch.from_numpy(suggested).float())
            for i, outcome in enumerate(envs.step_together(robots, actions.numpy())):
                if isinstance(outcome, Exception):
                    raise outcome
                arrived, _, terminated, truncated, _ = outcome
                obs[i] = robots[i].reset()[0] if terminated or truncated else arrived
    finally:
        for robot in robots:
            robot.close()
    return torch.cat(seen)
