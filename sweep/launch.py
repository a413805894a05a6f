"""From the command line to the launcher of a sweep."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

from core.config import Config, ConfigError
from sweep.cells import cell_of, job_states
from sweep.cluster import submit
from sweep.local import run_queue
from sweep.plan import describe_plan, make_plan, memory_warning
from sweep.settings import Sweep


def launch(sweep: Sweep, cells: Sequence[tuple[Config, Config]], threads_given: bool, check: Callable[[], None]) -> int:
    """Plan the cells, each (configuration, the paper's), and print the plan or carry it out; the exit code.

    `check` raises Interrupted after a signal. ConfigError for what the user can put right.
    """
    on_slurm = sweep.settings.launcher == "slurm"
    jobs = sweep.slurm.parallel if on_slurm else sweep.settings.jobs or 1
    if not threads_given:
        threads = sweep.slurm.cpus if on_slurm else 1
        cells = [(replace(config, threads=threads), base) for config, base in cells]
    if on_slurm and cells[0][0].overwrite:
        raise ConfigError("overwrite=true does not go with launcher=slurm: each requeue would start the cell again")
    if on_slurm:
        _check_gpus(sweep, cells[0][0].device)
    entries = make_plan(cells, job_states(cell_of(*cell) for cell in cells))
    if sweep.settings.dry:
        print(describe_plan(entries, jobs))
        return 0
    if on_slurm:
        submit(sweep, cells)
        check()
        return 0
    if warning := memory_warning(entries, jobs):
        print(warning, file=sys.stderr)
    return run_queue(entries, jobs, check)


def _check_gpus(sweep: Sweep, device: str) -> None:
    """ConfigError where the jobs get GPUs that they do not use, or the other way round."""
    gpus = sweep.slurm.gpus
    # sbatch has other parameters that ask for GPUs, and some clusters want those.
    asked = gpus or any(name.startswith(("gpus", "gres", "tres")) for name in sweep.sbatch)
    if device != "cpu" and not asked:
        raise ConfigError(f"device={device} with launcher=slurm needs slurm.gpus= of at least 1")
    if ":" in device:
        raise ConfigError(
            f"device={device} does not go with launcher=slurm: a job sees its own GPUs alone (device=cuda)"
        )
    if device == "cpu" and gpus:
        raise ConfigError(f"slurm.gpus={gpus} needs device=cuda: with device=cpu, the cells would not use them")
