"""Checks the settings of a sweep, plans it, and starts its launcher."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

from core.config import AUTO
from core.words import ConfigError
from store.folder import LONGEST_NAME
from sweep.cells import Cell, format_seeds
from sweep.definition import find_changed, refuse
from sweep.exit import Exit
from sweep.local import run_queue
from sweep.plan import describe_plan, make_plan, memory_warning
from sweep.settings import Sweep
from sweep.slurm import asks_for_gpus, check_gpus, submit
from sweep.states import job_states
from sweep.train import check_device, check_log, make_env, on_this_machine


def launch(sweep: Sweep, cells: Sequence[Cell], stop_if_asked: Callable[[], None]) -> Exit:
    """Plan the cells, and print the plan or carry it out.

    `stop_if_asked` raises Interrupted after a signal. Raises ConfigError for settings that the user can correct.
    """
    on_slurm = sweep.settings.launcher == "slurm"
    jobs = sweep.slurm.parallel if on_slurm else sweep.settings.jobs or 1
    threads = sweep.slurm.cpus if on_slurm else 1
    if on_slurm and cells[0].config.device == AUTO:  # the jobs run on another machine than this one
        device = "cuda" if asks_for_gpus(sweep) else "cpu"
        cells = [Cell.of(replace(cell.config, device=device)) for cell in cells]
    cells = [Cell.of(on_this_machine(cell.config, threads)) for cell in cells]
    settings = cells[0].config  # one command has one device and one overwrite=
    check_log(settings.log)  # Slurm jobs have the same Python and home
    if not on_slurm:
        check_device(settings.device)
        for task, simulator in {(cell.task, cell.config.simulator) for cell in cells if cell.config.simulator}:
            make_env(task, simulator).close()  # if it is not installed, no cell should start
    elif settings.overwrite == "true":
        raise ConfigError("overwrite=true cannot be used with launcher=slurm: each requeue would start the cell again")
    else:
        check_gpus(sweep, settings.device)
    for cell in cells:
        if len(os.fsencode(cell.record("log").name)) > LONGEST_NAME:
            raise ConfigError(
                f"seed={format_seeds(cell.seeds)} is too long for the name of a log: use seeds without gaps, or"
                " several commands"
            )
    if settings.overwrite == "false" and (changed := find_changed(cells)):
        refuse(changed)
    entries = make_plan(cells, job_states(cells))
    if sweep.settings.dry:
        print(describe_plan(entries, jobs))
        return Exit.DONE
    if on_slurm:
        submit(sweep, cells)
        stop_if_asked()
        return Exit.DONE
    if warning := memory_warning(entries, jobs):
        print(warning, file=sys.stderr)
    return run_queue(entries, jobs, stop_if_asked)
