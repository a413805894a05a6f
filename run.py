"""Train cells of the benchmark: `python run.py algo=SRad env=W+M seed=3`. Without arguments: usage."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial

from algos import ALGORITHMS, setting_keys
from envs import TASKS
from store.output import forgiving_output
from sweep.cells import make_cells
from sweep.exit import Exit, exit_code, stoppable
from sweep.launch import launch
from sweep.play import play
from sweep.plugins import HELP, KEY, load_plugins
from sweep.settings import SLURM_PREFIX, SlurmSettings, SweepSettings, parse_sweep
from sweep.status import describe_status
from sweep.train import train_cells


def usage() -> str:
    """The help text, made from the definitions of algorithms, tasks and settings."""
    lines = [
        "usage: python run.py algo=NAMES env=NAMES [key=value ...]",
        "",
        "  python run.py algo=SRad env=W+M seed=3             one run",
        "  python run.py algo=SRad env=W+M seed=0-9           ten seeds, trained in lockstep in one process",
        "  python run.py algo=DOpt,DRad env=all seed=0,1      several cells, one after the other",
        "  python run.py algo=SRad env=R+L2 tau=0.01,0.02     one cell per value; several lists: all combinations",
        "  python run.py algo=paper env=all seed=0-9 jobs=4   a queue of cells, four at a time, one process each",
        "  python run.py algo=paper env=all seed=0-9 launcher=slurm slurm.hours=12    an array of Slurm jobs",
        "  python run.py status results/                      the state of all cells: running, queued or ended",
        "  python run.py play FOLDER [episodes=3] [which=best] [video=FILE.mp4]    play and film the policy of a run",
        "",
        f"algo: {' '.join(ALGORITHMS)}; paper (the paper's 13) or all",
        f"env:  {' '.join(TASKS)}; or all",
        "",
        "keys (the defaults are the paper's hyperparameters of the algorithm and the task):",
    ]
    lines += [f"  {key:18s} {f.metadata['help']}" for key, f in setting_keys().items() if key not in ("algo", "env")]
    lines += ["", "keys of a sweep (not part of any run's name):", f"  {KEY:18s} {HELP}"]
    for schema, prefix in ((SweepSettings, ""), (SlurmSettings, SLURM_PREFIX)):
        lines += [f"  {prefix + f.name:18s} {f.metadata['help']}" for f in fields(schema)]
    lines.append("  slurm.NAME         any other parameter of sbatch, such as slurm.account=mine slurm.exclusive=true")
    return "\n".join(lines)


def carry_out(arguments: Sequence[str], stop_if_asked: Callable[[], None]) -> Exit:
    """Train what the arguments ask for. `stop_if_asked` raises Interrupted after a signal to stop."""
    sweep, settings = parse_sweep(load_plugins(arguments))
    cells = make_cells(settings)
    if sweep.wanted:
        return launch(sweep, cells, stop_if_asked)
    return train_cells(cells, stop_if_asked)


def main(arguments: Sequence[str]) -> int:
    """Exit code: 0 done, 2 bad input, 3 a seed diverged, 4 a cell of a sweep failed, 128 + n ended by signal n."""
    with forgiving_output():
        if not arguments or {"-h", "--help", "help"} & set(arguments):
            print(usage())
            return Exit.DONE
        if arguments[0] == "status":
            return exit_code(lambda: print(describe_status(load_plugins(arguments[1:]))) or Exit.DONE)
        if arguments[0] == "play":
            return exit_code(lambda: stoppable(partial(play, load_plugins(arguments[1:]))))
        return exit_code(lambda: stoppable(partial(carry_out, arguments)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
