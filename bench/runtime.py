"""The paper's runtime experiment: the first gradient steps of every algorithm on HalfCheetah (HC+O).

    python bench/runtime.py                                        # as the paper, and batch 256: hours on one core
    python bench/runtime.py algo=DOpt,DRad batch=1,16 trials=2 steps=100 out=bench/results
    python bench/runtime.py seeds=10                               # ten seeds in lockstep: seconds of all ten
    python bench/runtime.py algo=DRad,SRad,DOpt,NFW device=cuda    # networks and replay buffer on a GPU

A trial fills a replay buffer with 1,000 steps of the environment under random feasible actions, makes a new agent with
the paper's hyperparameters but for the batch size, and takes `steps` gradient steps, sampling included. Every trial
has seeds of its own. All cells are measured once before any is measured again, and every measurement is saved when it
is made, so that what an interruption leaves is of use.

Prints a table and saves `out`/runtime.csv (default bench/results), a row a measurement, which `python plot.py runtime`
draws. CPU seconds are CPU time of the process, on one thread, so that other load on the machine does not count. With a
GPU, the two parts make up the wall-clock time: GPU seconds are the time in which its kernels run, from as many further
gradient steps under PyTorch's profiler, CPU seconds the rest. The first steps capture CUDA graphs; with steps=10000
they hardly count, and the time of one step times 9e5 is that of the gradient steps of a whole run.
"""

from __future__ import annotations

import csv
import os
import sys
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# Scripts find modules beside themselves; those needed here lie in the project.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from tqdm import tqdm

import run
from algos import ALGORITHMS
from bench.common import TASK, fill_replay, machine, make_agent, parse_options, positive, positives
from core.config import ConfigError, split_names
from core.graph import GradientSteps
from core.replay import Replay
from plots.runtime import COLUMNS, runtime_table
from plots.tables import to_terminal

FILL = 1_000
"""Transitions of each seed in the replay buffer."""
DEFAULTS = {
    "algo": "all",
    "batch": "1,16,100,256",
    "trials": "10",
    "steps": "1000",
    "seeds": "1",
    "device": "cpu",
    "out": "bench/results",
}


def measure(name: str, batch: int, replay: Replay, seeds: Sequence[int], steps: int) -> tuple[float, float]:
    """CPU and GPU seconds of the first `steps` gradient steps."""
    agent = make_agent(name, batch, seeds, replay.rows.device)
    take_gradient_step = GradientSteps(agent, replay, batch)

    def train() -> None:
        for _ in range(steps):
            take_gradient_step()
        if agent.device.type == "cuda":
            torch.cuda.synchronize(agent.device)

    clock = time.process_time if agent.device.type == "cpu" else time.perf_counter
    start = clock()
    train()
    seconds = clock() - start
    gpu = kernel_seconds(train) if agent.device.type == "cuda" else 0.0
    return max(seconds - gpu, 0.0), gpu


def kernel_seconds(call: Callable[[], None]) -> float:
    """Of the kernels that `call`, which waits for the GPU, makes it run."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        call()
    # Events of the host may repeat the time of the kernels that they launch.
    events = (event for event in profile.events() if event.device_type == torch.autograd.DeviceType.CUDA)
    return sum(event.self_device_time_total for event in events) * 1e-6


def parse_arguments(arguments: Sequence[str]) -> tuple[list[str], list[int], dict[str, int], str, Path]:
    """Algorithms, batch sizes, whole numbers by name, device and folder. Raises ConfigError for what is wrong."""
    options = parse_options(arguments, DEFAULTS)
    run.check_device(options["device"])
    batches = positives("batch", options["batch"])
    counts = {key: positive(key, options[key]) for key in ("trials", "steps", "seeds")}
    names = split_names("algo", options["algo"], ALGORITHMS)
    return names, batches, counts, options["device"], Path(options["out"]).expanduser()


def run_trials(names: Sequence[str], batches: Sequence[int], counts: dict[str, int], device: str, path: Path) -> None:
    """Measure every cell `trials` times and write each measurement to `path` at once."""
    fixed = {"task": TASK, "seeds": counts["seeds"], "steps": counts["steps"], "machine": machine(torch.device(device))}
    total = counts["trials"] * len(names) * len(batches)
    with open(path, "w", newline="", encoding="utf-8") as file, tqdm(total=total, unit="cell", smoothing=0) as bar:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for trial, name in product(range(counts["trials"]), names):
            seeds = range(trial * counts["seeds"], (trial + 1) * counts["seeds"])
            replay = fill_replay(make_agent(name, batches[0], seeds, device), FILL)
            for batch in batches:
                bar.set_description(f"{name}, batch {batch}, trial {trial + 1}")
                cpu, gpu = measure(name, batch, replay, seeds, counts["steps"])
                row = {"algo": name, "batch": batch, "trial": trial, "cpu_seconds": cpu, "gpu_seconds": gpu}
                writer.writerow(fixed | row)
                file.flush()
                bar.update()


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input, 130 interrupted."""
    if {"-h", "--help", "help"} & set(arguments):
        print(__doc__.strip())
        return 0
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    interrupted = False
    try:
        names, batches, counts, device, out = parse_arguments(arguments)
        out.mkdir(parents=True, exist_ok=True)
        path = out / "runtime.csv"
        try:
            run_trials(names, batches, counts, device, path)
        except KeyboardInterrupt:
            interrupted = True
            print("\ninterrupted; what is measured stays", file=sys.stderr)
        print(to_terminal(runtime_table(path), bold=False, width=None))
    except (ConfigError, OSError) as error:
        print(f"bench/runtime.py: {error}", file=sys.stderr)
        return 130 if interrupted else 2
    print(f"{path} (python plot.py runtime {path} draws it)")
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
