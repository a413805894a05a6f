"""Training cells: resume or start the seeds of each that have not ended, and report the results."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import envs
from algos import ALGORITHMS, setting_keys
from core.config import AUTO, RUN_KEYS, THREADS, Config
from core.trainer import Trainer
from core.words import ConfigError, known_name, parse_words
from envs import TASKS
from store.checkpoint import Checkpoint, CheckpointFolder, FormatError, group_checkpoints
from store.definition import Description
from store.folder import describe_failure, has_ended, has_failed, lockstep_group, read_run
from store.interrupt import Interrupted
from store.lock import run_lock
from store.loggers import LoggerError, check_loggers, logger_names
from store.output import forgiving_output
from store.provenance import command_line, describe_environment
from store.writer import RunWriter
from sweep.cells import Cell, make_cells
from sweep.check import check_training
from sweep.definition import changed_runs, define, refuse
from sweep.exit import Exit, stoppable
from sweep.flows import flow_of
from sweep.plugins import load_plugins, refuse_to_train_in_plugin


def train_words(words: str) -> bool:
    """Train the cells that `words` ask for, as `python run.py <words>` does, one after the other in this process.

    Returns whether every seed has a result; a seed that diverged has none. Ctrl-C writes a checkpoint and ends the
    program; the same call resumes. Raises ConfigError for wrong words, ConstraintError for a constraint that fails and
    LockedError if another process trains a run.
    """
    refuse_to_train_in_plugin()
    cells = make_cells(parse_words(load_plugins(words.split()), setting_keys()))
    try:
        with forgiving_output():
            return stoppable(partial(train_cells, cells)) is Exit.DONE
    except Interrupted as interrupted:
        raise SystemExit(128 + interrupted.signum) from None


def train_cells(cells: Sequence[Cell], stop_if_asked: Callable[[], None] = lambda: None) -> Exit:
    """Train `cells` one after the other. `stop_if_asked` raises Interrupted to end the training with a checkpoint."""
    # Define all cells before the first training, which may change the objects described.
    definitions = [define(cell.config.env, cell.config.algo) for cell in cells]
    done = [train(*each, stop_if_asked) for each in zip(cells, definitions, strict=True)]
    return Exit.DONE if all(done) else Exit.DIVERGED


def train(cell: Cell, definition: Mapping[str, Description], stop_if_asked: Callable[[], None] = lambda: None) -> bool:
    """Train the seeds of one cell that have not ended, from their checkpoints if there are any.

    `definition` comes from `sweep.definition.define`. Prints each result and its folder. Returns whether every seed has
    a result.
    """
    cell = replace(cell, config=on_this_machine(cell.config))
    config, folders = cell.config, dict(zip(cell.seeds, cell.folders, strict=True))
    torch.set_num_threads(int(config.threads))
    check_log(config.log)
    check_device(config.device)  # only here: the machine that submits a job need not have a GPU
    if config.device.startswith("cuda:"):
        torch.cuda.set_device(config.device)
    # Adam's moments of dead units decay into denormals, which halve the speed. Threads that start later inherit this.
    torch.set_flush_denormal(True)
    check_robot(config.env)
    check_training(config, partial(make_env, config.env, config.simulator))
    if config.steps <= config.learning_starts:
        print(
            f"note: steps={config.steps} is not more than learning_starts={config.learning_starts}: nothing is learned",
            file=sys.stderr,
        )
    with ExitStack() as locks:
        for folder in folders.values():
            locks.enter_context(run_lock(folder))
        changed = changed_runs(folders.values(), definition)
        if changed and config.overwrite == "false":
            refuse(changed)
        again = {s for s, folder in folders.items() if config.overwrite == "true" or folder in changed}
        kept = {seed: folder for seed, folder in folders.items() if seed not in again}
        ended = {seed for seed, folder in kept.items() if has_ended(folder)}
        for seed in sorted(ended):
            print(f"{folders[seed]}: {_end_of(folders[seed])} (overwrite=true starts it again and keeps this one)")
        groups, fresh = _find_checkpoints(kept, ended)
        fresh = sorted({*fresh, *again})
        info = describe_environment(sys.orig_argv[1:])
        info |= {"cell": command_line(cell.words), "threads": config.threads, "device": _device_name(config.device)}
        for group in groups:
            if ended.issuperset(group):  # the process died after the last seed's end
                for seed in group:
                    CheckpointFolder(folders[seed]).remove()
            else:
                _resume(cell, folders, group, ended, info, definition, stop_if_asked)
        if fresh:
            info["lockstep"] = fresh
            flow = flow_of(config, definition, stop_if_asked)
            if flow is not None:
                info["flow"] = flow["measures"] | {"trained": flow["info"]}
            writers = [
                RunWriter(
                    folders[seed],
                    cell.settings(seed),
                    info,
                    config.eval_episodes,
                    replace_finished=seed in again,
                    definition=definition,
                )
                for seed in fresh
            ]
            _run(make_trainer(config, fresh, writers, True, stop_if_asked, flow and flow["state"]))
        return not any(has_failed(folder) for folder in folders.values())


def make_trainer(
    config: Config,
    seeds: Sequence[int],
    writers: Sequence[RunWriter],
    progress: bool = True,
    stop_if_asked: Callable[[], None] = lambda: None,
    flow: Mapping[str, Tensor] | None = None,
) -> Trainer:
    """The trainer of one cell, with its environments and its agent; one writer for each seed.

    `flow` has the parameters of the map's flow, if the map has one and the training does not resume. Raises ConfigError
    if the networks and the replay buffer do not fit into memory.
    """
    new_env = partial(make_env, config.env, config.simulator)
    train_envs = [new_env() for _ in seeds]
    obs_dim = train_envs[0].observation_space.shape[0]
    try:
        agent = ALGORITHMS[config.algo].build(config, envs.constraint(config.env), obs_dim, list(seeds))
        if flow:
            agent.map.load_state(flow)
        return Trainer(config, agent, train_envs, new_env, envs.step_together, writers, progress, stop_if_asked)
    except RuntimeError as error:
        if not any(words in str(error) for words in ("allocate memory", "out of memory")):
            raise
        raise ConfigError(
            f"not enough memory for {len(seeds)} seeds with hidden={config.hidden}, buffer_size={config.buffer_size}"
        ) from error


def on_this_machine(config: Config, threads: int | None = None) -> Config:
    """`config` with "auto" replaced by this machine's device and number of threads.

    `threads` is the number for a cell that shares the machine with others. Device and threads change the rounding, and
    the chaos of training turns that into a different run.
    """
    device = config.device
    if device == AUTO:
        gpu_pays = torch.cuda.is_available() and not TASKS[config.env].constraint.solved_on_cpu
        device = "cuda" if gpu_pays else "cpu"
    if config.threads == AUTO:
        config = replace(config, threads=threads or THREADS[torch.device(device).type])
    return replace(config, device=device)


def check_device(name: str) -> None:
    """Raise ConfigError if PyTorch cannot compute on the device `name`."""
    choices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    choices += [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if name not in choices:
        hint = "" if len(choices) > 1 else "; PyTorch sees no CUDA GPU here"
        raise ConfigError(f"bad value {name!r} for device{hint} (choices: {', '.join(choices)})")


def check_log(text: str) -> None:
    """Raise ConfigError if a logger of `text`, a value of `log`, cannot work here."""
    try:
        check_loggers(logger_names(text))
    except LoggerError as error:
        raise ConfigError(str(error)) from error


def make_env(task: str, simulator: str | None) -> envs.ActionConstrainedEnv:
    """The environment of `task`. Raises ConfigError if the simulator is not available."""
    try:
        return envs.make(task, simulator=simulator)
    except envs.UnavailableError as error:
        raise ConfigError(str(error)) from error


def check_robot(task: str) -> None:
    """Raise ConfigError if the robot of `task` does not keep the protocol of `envs.Robot` in a few steps.

    Also raised if no algorithm has hyperparameters for the group that the robot names.
    """
    robot = envs.TASKS[task].robot
    groups = {group: None for algorithm in ALGORITHMS.values() for group in algorithm.agent.paper}
    known_name(f"hyperparameters of {robot.__name__}", robot.hyperparameters, groups)
    try:
        envs.check_robot(robot, steps=10)
    except envs.RobotError as error:
        raise ConfigError(f"the robot of {task} does not work: {error}") from error


def _device_name(device: str) -> str:
    """The name of `device` in info.json."""
    return device if device == "cpu" else torch.cuda.get_device_name(device)


def _find_checkpoints(folders: dict[int, Path], ended: set[int]) -> tuple[list[dict[int, Checkpoint]], list[int]]:
    """Groups of seeds that resume together, each seed with its checkpoint, and the seeds that start anew."""
    intact, started = {}, {}
    for seed, folder in folders.items():
        try:
            checkpoints, problems = CheckpointFolder(folder).read()
        except FormatError:
            if seed in ended:  # other seeds of its batch may still need the checkpoint, with the version that wrote it
                continue
            raise
        if not checkpoints and seed in ended:  # left by a crash during their deletion
            CheckpointFolder(folder).remove()
            continue
        for problem in problems:
            print(problem, file=sys.stderr)
        intact[seed] = checkpoints
        started[seed] = checkpoints[0].group if checkpoints else lockstep_group(folder)
    groups, fresh = group_checkpoints(intact, started)
    return groups, [seed for seed in fresh if seed not in ended]


def _resume(
    cell: Cell,
    folders: dict[int, Path],
    group: dict[int, Checkpoint],
    ended: set[int],
    info: dict[str, Any],
    definition: Mapping[str, Description],
    stop_if_asked: Callable[[], None],
) -> None:
    """Resume the training from the checkpoints of `group`, which were written together."""
    config, before = cell.config, next(iter(group.values())).group
    # Seeds that have ended stay in the batch to keep its shape. If other seeds are missing, the shape changes anyway.
    seeds = list(before) if set(before) == set(group) else [seed for seed in group if seed not in ended]
    for seed in seeds:
        _check_settings(folders[seed], group[seed].settings, cell.settings(seed))
    writers = []
    for seed in seeds:
        resumed = info | {"step": group[seed].step, "lockstep": seeds}
        settings = cell.settings(seed)
        writers.append(RunWriter.resume(folders[seed], settings, resumed, config.eval_episodes, definition))
        if seed not in ended:
            print(f"{folders[seed]}: resuming from step {group[seed].step}")
    if len(seeds) < len(before):
        print(f"(before, {len(before)} seeds were trained together: equal to an uninterrupted run only up to rounding)")
    for key, now in (("threads", config.threads), ("device", config.device)):
        if (earlier := group[seeds[0]].settings[key]) != now:
            print(f"({key}={now} now, {earlier} before: equal to an uninterrupted run only up to rounding)")
    trainer = make_trainer(config, seeds, writers, True, stop_if_asked)
    trainer.restore([group[seed] for seed in seeds])
    _run(trainer)


def _check_settings(folder: Path, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise ConfigError if a setting that decides what is learned differs from its value at the start of the run.

    The simulator counts too, because the state of one simulator does not fit another.
    """
    for key in now.keys() - (set(RUN_KEYS) - {"simulator"}):
        if before.get(key) != now[key]:
            raise ConfigError(
                f"{folder} started with {key}={before.get(key)}, but this command has {key}={now[key]}; use the old"
                " value, or overwrite=true to start again and keep the old run"
            )


def _run(trainer: Trainer) -> None:
    try:
        results = trainer.run()
    except (Interrupted, KeyboardInterrupt):
        step = max(seed.steps for seed in trainer.seeds)
        print(
            f"\ninterrupted at step {step}; the same command resumes (without overwrite=true)"
            f" (unfinished runs are in {trainer.seeds[0].writer.folder.parent})",
            file=sys.stderr,
        )
        raise
    for seed, result in zip(trainer.seeds, results, strict=True):
        folder = seed.writer.folder
        if result is None:
            print(f"{folder}: {describe_failure(seed.failure)}", file=sys.stderr)
        else:
            print(
                f"{folder}: return {result['return_mean']:.2f} over {len(result['returns'])} episodes"
                f" (parameters of step {result['best_step']}; largest violation {result['largest_violation']:.1e}"
                f"{'; quick=true: too few to compare' if trainer.config.quick else ''})"
            )


def _end_of(folder: Path) -> str:
    """How the ended run in `folder` ended, in a few words."""
    try:
        run = read_run(folder)
    except ValueError as error:
        return f"already finished, but unreadable ({error})"
    if run.failure:
        return describe_failure(run.failure)
    return f"already finished, return {run.result['return_mean']:.2f}"
