"""Train cells of the benchmark: `python run.py algo=SRad env=W+M seed=3`. Without arguments: usage."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

import envs
from algos import ALGORITHMS, PAPER, paper_settings, setting_keys
from constraints import ConstraintError
from core.config import (
    RUN_KEYS,
    Config,
    ConfigError,
    differences,
    keys_of,
    parse_arguments,
    resolve,
    saved_settings,
    split_names,
)
from core.trainer import Trainer
from envs import TASKS, TOLERANCE
from store.checkpoint import Checkpoint, CheckpointFolder, group_checkpoints
from store.files import one_line
from store.folder import (
    RunWriter,
    describe_failure,
    has_ended,
    has_failed,
    lockstep_group,
    read_run,
    run_folder,
    variant_name,
)
from store.interrupt import Interrupted, Interrupts
from store.lock import LockedError, run_lock
from store.provenance import describe_environment
from sweep.launch import launch
from sweep.settings import SLURM_PREFIX, SlurmSettings, SweepSettings, parse_sweep
from sweep.status import describe_status


def usage() -> str:
    """The help text, made from the definitions of algorithms, tasks and settings."""
    lines = [
        "usage: python run.py algo=NAMES env=NAMES [key=value ...]",
        "",
        "  python run.py algo=SRad env=W+M seed=3             one run",
        "  python run.py algo=SRad env=W+M seed=0-9           ten seeds, trained in lockstep in one process",
        "  python run.py algo=DOpt,DRad env=all seed=0,1      several cells, one after the other",
        "  python run.py algo=all env=all seed=0-9 jobs=4     a queue of cells, four at a time, a process each",
        "  python run.py algo=all env=all seed=0-9 launcher=slurm slurm.hours=12    an array of Slurm jobs",
        "  python run.py status results/                      how all cells stand, running, queued or ended",
        "",
        f"algo: {' '.join(ALGORITHMS)}, paper (the paper's 13) or all",
        f"env:  {' '.join(TASKS)}, or all",
        "",
        "keys (defaults depend on algorithm and task: the paper's hyperparameter table):",
    ]
    lines += [f"  {key:18s} {f.metadata['help']}" for key, f in setting_keys().items() if key not in ("algo", "env")]
    lines += ["", "keys of a sweep (not part of any run's name):"]
    for schema, prefix in ((SweepSettings, ""), (SlurmSettings, SLURM_PREFIX)):
        lines += [f"  {prefix + f.name:18s} {f.metadata['help']}" for f in fields(schema)]
    lines.append("  slurm.NAME         any other parameter of sbatch, as slurm.account=mine slurm.exclusive=true")
    return "\n".join(lines)


def plan(arguments: list[str]) -> list[tuple[Config, Config]]:
    """The cells that the arguments ask for, each as (configuration, the paper's configuration of the same cell)."""
    overrides = parse_arguments(arguments, setting_keys())
    for key, choices in (("algo", ALGORITHMS), ("env", TASKS)):
        if key not in overrides:
            raise ConfigError(f"{key}= is missing (choices: {', '.join(choices)}, all)")
    names = split_names("algorithm", overrides["algo"], ALGORITHMS, {"paper": PAPER})
    tasks = split_names("task", overrides["env"], TASKS)
    bases = [paper_settings(name, task, TASKS[task].robot, TASKS[task].steps) for task in tasks for name in names]
    cells = []
    for base in bases:
        # A key that only some of several algorithms have is theirs alone; one that none has is a mistake.
        applicable = {
            key: text
            for key, text in overrides.items()
            if key in keys_of(base) or not any(key in keys_of(other) for other in bases)
        }
        cells.append((resolve(base, applicable), base))
    return cells


def check_device(name: str) -> None:
    """ConfigError where PyTorch cannot compute on the device `name`."""
    choices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    choices += [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if name not in choices:
        hint = "" if len(choices) > 1 else "; PyTorch sees no CUDA GPU here"
        raise ConfigError(f"bad value {name!r} for device{hint} (choices: {', '.join(choices)})")


def device_name(device: str) -> str:
    """What info.json calls it."""
    return device if device == "cpu" else torch.cuda.get_device_name(device)


def make_trainer(
    config: Config,
    seeds: list[int],
    writers: Sequence[RunWriter],
    progress: bool = True,
    check: Callable[[], None] = lambda: None,
) -> Trainer:
    """The trainer of one cell: its environments and its agent put together; one writer a seed.

    ConfigError where networks and replay buffer do not fit into memory.
    """
    train_envs = [envs.make(config.env) for _ in seeds]
    try:
        obs_dim = train_envs[0].observation_space.shape[0]
        agent = ALGORITHMS[config.algo].build(config, envs.constraint(config.env), obs_dim, seeds)
        return Trainer(config, agent, train_envs, lambda: envs.make(config.env), writers, progress, check)
    except RuntimeError as error:
        if not any(words in str(error) for words in ("allocate memory", "out of memory")):
            raise
        raise ConfigError(
            f"not enough memory for {len(seeds)} seeds with hidden={config.hidden}, buffer_size={config.buffer_size}"
        ) from error


def check_constraint(task: str) -> None:
    """ConfigError, before anything is trained, where the constraint of `task` does not work on its robot."""
    constraint = TASKS[task].constraint
    env = envs.make(task)
    try:
        obs = torch.from_numpy(env.reset(seed=0)[0]).float().unsqueeze(0)
        if constraint.dim != env.robot.action_dim:
            raise ValueError(f"it is for {constraint.dim} action coordinates, the robot has {env.robot.action_dim}")
        action = constraint.project(obs, torch.ones(1, constraint.dim))
        if action.shape != (1, constraint.dim) or not constraint.violation(obs, action).item() <= TOLERANCE:
            raise ValueError(f"it projects (1, ..., 1) to {action.tolist()} at a first observation")
    except Exception as error:  # from code of the user's own
        raise ConfigError(f"the constraint of {task} does not work: {one_line(error)}") from error
    finally:
        env.close()


def train(config: Config, base: Config, check: Callable[[], None] = lambda: None) -> bool:
    """Run the seeds of one cell that have not ended, from their checkpoints where there are any, and say what came out
    and where it is. Whether all seeds have a result."""
    torch.set_num_threads(config.threads)
    check_device(config.device)  # only here: the machine that submits a job need not have a GPU
    if config.device.startswith("cuda:"):
        torch.cuda.set_device(config.device)
    check_constraint(config.env)
    torch.set_flush_denormal(True)  # Adam's moments of dead units decay into denormals, which halve the speed
    if config.steps <= config.learning_starts:
        print(
            f"note: steps={config.steps} is not more than learning_starts={config.learning_starts}: nothing is learned",
            file=sys.stderr,
        )
    variant = variant_name(config.algo, differences(config, base))
    folders = {seed: run_folder(config.results, config.env, variant, seed) for seed in config.seeds}
    with ExitStack() as locks:
        for folder in folders.values():
            locks.enter_context(run_lock(folder))
        ended = {seed for seed, folder in folders.items() if has_ended(folder) and not config.overwrite}
        for seed in sorted(ended):
            print(f"{folders[seed]}: {_end_of(folders[seed])} (overwrite=true starts it again and keeps this one)")
        groups, fresh = ([], list(folders)) if config.overwrite else _find_checkpoints(folders, ended)
        info = describe_environment(["run.py", *sys.argv[1:]]) | {
            "threads": config.threads,
            "device": device_name(config.device),
        }
        for group in groups:
            if ended.issuperset(group):  # the process died when all was done
                for seed in group:
                    CheckpointFolder(folders[seed]).remove()
            else:
                _resume(config, folders, group, ended, info, check)
        if fresh:
            info["lockstep"] = fresh
            writers = [
                RunWriter(
                    folders[seed],
                    saved_settings(config, seed),
                    info,
                    config.eval_episodes,
                    replace_finished=config.overwrite,
                )
                for seed in fresh
            ]
            _run(make_trainer(config, fresh, writers, check=check))
        return not any(has_failed(folder) for folder in folders.values())


def _find_checkpoints(folders: dict[int, Path], ended: set[int]) -> tuple[list[dict[int, Checkpoint]], list[int]]:
    """The seeds to take up together, each with its checkpoint, and those to start from the beginning."""
    intact, started = {}, {}
    for seed, folder in folders.items():
        checkpoints, problems = CheckpointFolder(folder).read()
        if not checkpoints and seed in ended:  # what a death while they were deleted has left
            CheckpointFolder(folder).remove()
            continue
        for problem in problems:
            print(problem, file=sys.stderr)
        intact[seed] = checkpoints
        started[seed] = checkpoints[0].group if checkpoints else lockstep_group(folder)
    groups, fresh = group_checkpoints(intact, started)
    return groups, [seed for seed in fresh if seed not in ended]


def _resume(
    config: Config,
    folders: dict[int, Path],
    group: dict[int, Checkpoint],
    ended: set[int],
    info: dict[str, Any],
    check: Callable[[], None],
) -> None:
    """Train on from the checkpoints of `group`, which are of one moment."""
    before = next(iter(group.values())).group
    # Seeds that have ended ride along, so that the batch is what it was; with others missing there is no use in that.
    seeds = list(before) if set(before) == set(group) else [seed for seed in group if seed not in ended]
    writers = []
    for seed in seeds:
        checkpoint, settings = group[seed], saved_settings(config, seed)
        for key in settings.keys() - set(RUN_KEYS):
            if checkpoint.settings.get(key) != settings[key]:
                raise ConfigError(
                    f"{folders[seed]} was started with {key}={checkpoint.settings.get(key)}, which is {settings[key]}"
                    " now; overwrite=true starts it again and keeps the old one"
                )
    for seed in seeds:
        resumed = info | {"step": group[seed].step, "lockstep": seeds}
        writers.append(RunWriter.resume(folders[seed], saved_settings(config, seed), resumed, config.eval_episodes))
        if seed not in ended:
            print(f"{folders[seed]}: resuming from step {group[seed].step}")
    if len(seeds) < len(before):
        print(f"(trained with other seeds before, {len(before)} in all: equal up to rounding to an unbroken run)")
    trainer = make_trainer(config, seeds, writers, check=check)
    trainer.restore([group[seed] for seed in seeds])
    _run(trainer)


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
                f" (parameters of step {result['best_step']}; largest violation {result['largest_violation']:.1e})"
            )


def _end_of(folder: Path) -> str:
    try:
        run = read_run(folder)
    except ValueError as error:
        return f"already finished, but unreadable ({error})"
    if run.failure:
        return describe_failure(run.failure)
    return f"already finished, return {run.result['return_mean']:.2f}"


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input, 3 a seed diverged, 4 a cell of a sweep failed, 128 + n ended by signal n."""
    if not arguments or {"-h", "--help", "help"} & set(arguments):
        print(usage())
        return 0
    try:
        if arguments[0] == "status":
            print(describe_status(arguments[1:]))
            return 0
        with Interrupts() as interrupts:
            sweep, words = parse_sweep(arguments)
            cells = plan(words)
            if sweep.wanted:
                if sweep.settings.launcher == "local":
                    check_device(cells[0][0].device)
                threads_given = any(word.startswith("threads=") for word in words)
                return launch(sweep, cells, threads_given, interrupts.check)
            done = [train(config, base, interrupts.check) for config, base in cells]
    except (ConfigError, ConstraintError, LockedError) as error:
        print(f"run.py: {one_line(error)}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"run.py: {error.filename or 'system'}: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except Interrupted as interrupted:
        return 128 + interrupted.signum
    return 0 if all(done) else 3


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
