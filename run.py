"""Train cells of the benchmark: `python run.py algo=SRad env=W+M seed=3`. Without arguments: usage."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import torch

import envs
from algos import ALGORITHMS, NFWPO
from core.config import (
    Config,
    ConfigError,
    defaults,
    differences,
    parse_arguments,
    parse_seeds,
    resolve,
    saved_settings,
    split_names,
)
from core.results import RunWriter, describe_environment, is_finished, read_run, run_folder, variant_name
from core.trainer import Trainer
from envs import TASKS


def usage() -> str:
    """The help text, made from the definitions of algorithms, tasks and settings."""
    lines = [
        "usage: python run.py algo=NAMES env=NAMES [key=value ...]",
        "",
        "  python run.py algo=SRad env=W+M seed=3             one run",
        "  python run.py algo=SRad env=W+M seed=0-9           ten seeds, trained in lockstep in one process",
        "  python run.py algo=DOpt,DRad env=all seed=0,1      several cells, one after the other",
        "",
        f"algo: {' '.join(ALGORITHMS)}, or all",
        f"env:  {' '.join(TASKS)}, or all",
        "",
        "keys (defaults depend on algorithm and task: the paper's hyperparameter table):",
    ]
    for f in fields(Config):
        if f.name not in ("algo", "env"):
            lines.append(f"  {f.name:18s} {f.metadata['help']}")
    return "\n".join(lines)


def plan(arguments: list[str]) -> list[tuple[Config, Config]]:
    """The cells that the arguments ask for, each as (configuration, the paper's configuration of the same cell)."""
    overrides = parse_arguments(arguments)
    for key, choices in (("algo", ALGORITHMS), ("env", TASKS)):
        if key not in overrides:
            raise ConfigError(f"{key}= is missing (choices: {', '.join(choices)}, all)")
    names = split_names("algorithm", overrides["algo"], ALGORITHMS)
    tasks = split_names("task", overrides["env"], TASKS)
    parse_seeds(overrides.get("seed", "0"))
    bases = [_paper_config(name, task) for task in tasks for name in names]
    cells = []
    for base in bases:
        # A key that only some of several algorithms have is theirs alone; one that none has is a mistake.
        applicable = {
            key: text
            for key, text in overrides.items()
            if key in ("algo", "env")
            or getattr(base, key) is not None
            or all(getattr(other, key) is None for other in bases)
        }
        cells.append((resolve(base, applicable), base))
    return cells


def _paper_config(name: str, task: str) -> Config:
    algorithm = ALGORITHMS[name]
    return defaults(
        algo=name,
        env=task,
        robot=TASKS[task].robot.__name__,
        base=algorithm.base,
        mapping=algorithm.mapping,
        frank_wolfe=issubclass(algorithm.agent, NFWPO),
        penalty=algorithm.penalty,
        steps=TASKS[task].steps,
    )


def make_trainer(config: Config, seeds: list[int], writers: Sequence[RunWriter], progress: bool = True) -> Trainer:
    """The trainer of one cell: its environments and its agent put together; one writer a seed."""
    algorithm = ALGORITHMS[config.algo]
    train_envs = [envs.make(config.env) for _ in seeds]
    agent = algorithm.agent(
        config,
        envs.constraint(config.env),
        train_envs[0].observation_space.shape[0],
        seeds,
        mapping=algorithm.mapping,
        placement=algorithm.placement,
    )
    return Trainer(config, agent, train_envs, lambda: envs.make(config.env), writers, progress)


def train(config: Config, base: Config) -> None:
    """Run the seeds of one cell that have no finished run, and say what came out and where it is."""
    torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)  # Adam's moments of dead units decay into denormals, which halve the speed
    variant = variant_name(config.algo, differences(config, base))
    folders = {}
    for seed in parse_seeds(config.seed):
        folder = run_folder(config.results, config.env, variant, seed)
        if is_finished(folder) and not config.overwrite:
            print(f"{folder}: already finished{_result_of(folder)} (overwrite=true runs it again and keeps the old)")
        else:
            folders[seed] = folder
    if not folders:
        return

    info = describe_environment(["run.py", *sys.argv[1:]])
    writers = [
        RunWriter(folder, saved_settings(config, seed), info, config.eval_episodes, replace_finished=config.overwrite)
        for seed, folder in folders.items()
    ]
    try:
        results = make_trainer(config, list(folders), writers).run()
    except KeyboardInterrupt:
        print(f"\ninterrupted; unfinished runs stay in {writers[0].folder.parent}", file=sys.stderr)
        raise
    for writer, result in zip(writers, results, strict=True):
        print(
            f"{writer.folder}: return {result['return_mean']:.2f} over {len(result['returns'])} episodes"
            f" (parameters of step {result['best_step']}; largest violation {result['largest_violation']:.1e})"
        )


def _result_of(folder: Path) -> str:
    try:
        return f", return {read_run(folder).result['return_mean']:.2f}"
    except ValueError as error:
        return f", but unreadable ({error})"


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input, 130 interrupted."""
    if not arguments or {"-h", "--help", "help"} & set(arguments):
        print(usage())
        return 0
    try:
        for config, base in plan(arguments):
            train(config, base)
    except (ConfigError, OSError) as error:
        print(f"run.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
