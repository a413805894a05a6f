"""The paper's runtime experiment: the first gradient steps of every algorithm on HalfCheetah (HC+O).

    python bench/runtime.py                                        # as the paper, and batch 256: hours on one core
    python bench/runtime.py algo=DOpt,DRad batch=1,16 trials=2 steps=100 out=bench/results
    python bench/runtime.py seeds=10                               # ten seeds in lockstep: seconds of all ten
    python bench/runtime.py algo=DRad,SRad,DOpt,NFW device=cuda    # networks and replay buffer on a GPU

A trial fills replay buffers with 1,000 environment steps under random feasible actions, makes new agents with the
paper's hyperparameters except for the batch size, and takes `steps` gradient steps with them, sampling included. At
one batch size, the algorithms take turns of 50 steps, so that a slow moment of the machine affects all of them. Every
trial has its own seeds. The results of a batch size are saved at once, so that an interruption loses little.

Prints a table and saves `out`/runtime.csv (default bench/results), a row a measurement, which `python plot.py runtime`
draws. CPU seconds are CPU time of the process, on one thread, so that other load on the machine does not count. With a
GPU, CPU and GPU seconds add up to the wall-clock time: GPU seconds are the time of the kernels, measured with PyTorch's
profiler over as many further gradient steps; CPU seconds are the rest. The first steps capture CUDA graphs. With
steps=10000 this hardly counts, and the time of one step times 9e5 estimates the gradient steps of a whole run.
"""

from __future__ import annotations

import csv
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from tqdm import tqdm

from algos import ALGORITHMS
from bench.common import TASK, fill_replay, machine_name, make_agent
from core.cuda_graph import GradientSteps
from core.words import ConfigError, parse_words, split_names, whole_number, whole_numbers
from plots.runtime import COLUMNS, runtime_table
from store.files import user_path
from sweep.train import check_device
from tables import to_terminal

FILL = 1_000
"""Transitions of each seed in the replay buffer."""
TURN = 50
"""Gradient steps in a turn of one algorithm."""
DEFAULTS = {
    "algo": "all",
    "batch": "1,16,100,256",
    "trials": "10",
    "steps": "1000",
    "seeds": "1",
    "device": "cpu",
    "out": "bench/results",
}


def measure(agents: Mapping[str, GradientSteps], steps: int, progress: Callable[[], None]) -> dict[str, tuple]:
    """CPU and GPU seconds of the first `steps` gradient steps of each agent. Every turn ends with `progress()`."""

    def train(take_gradient_step: GradientSteps, count: int) -> None:
        for _ in range(count):
            take_gradient_step()
        if take_gradient_step.agent.device.type == "cuda":
            torch.cuda.synchronize(take_gradient_step.agent.device)

    seconds = dict.fromkeys(agents, 0.0)
    for done in range(0, steps, TURN):
        for name, steps_of in agents.items():
            clock = time.process_time if steps_of.agent.device.type == "cpu" else time.perf_counter
            start = clock()
            train(steps_of, min(TURN, steps - done))
            seconds[name] += clock() - start
            progress()
    found = {}
    for name, steps_of in agents.items():
        on_gpu = steps_of.agent.device.type == "cuda"
        gpu = kernel_seconds(partial(train, steps_of, steps)) if on_gpu else 0.0
        found[name] = max(seconds[name] - gpu, 0.0), gpu
    return found


def kernel_seconds(call: Callable[[], None]) -> float:
    """GPU seconds of the kernels that `call` launches; `call` must wait for them."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        call()
    # Host events may repeat the time of the kernels that they launch.
    events = (event for event in profile.events() if event.device_type == torch.autograd.DeviceType.CUDA)
    return sum(event.self_device_time_total for event in events) * 1e-6


def parse_arguments(arguments: Sequence[str]) -> tuple[list[str], list[int], dict[str, int], str, Path]:
    """Algorithms, batch sizes, whole numbers by name, device and folder. Raises ConfigError for a wrong word."""
    options = DEFAULTS | parse_words(arguments, DEFAULTS)
    check_device(options["device"])
    batches = whole_numbers("batch", options["batch"])
    counts = {key: whole_number(key, options[key]) for key in ("trials", "steps", "seeds")}
    names = split_names("algo", options["algo"], ALGORITHMS)
    return names, batches, counts, options["device"], user_path(options["out"])


def run_trials(names: Sequence[str], batches: Sequence[int], counts: dict[str, int], device: str, path: Path) -> None:
    """Measure every algorithm and batch size `trials` times; write to `path` after each trial of a batch size."""
    fixed = {
        "task": TASK,
        "seeds": counts["seeds"],
        "steps": counts["steps"],
        "machine": machine_name(torch.device(device)),
    }
    turns = counts["trials"] * len(names) * len(batches) * math.ceil(counts["steps"] / TURN)
    with open(path, "w", newline="", encoding="utf-8") as file, tqdm(total=turns, unit="turn", smoothing=0) as bar:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for trial in range(counts["trials"]):
            seeds = range(trial * counts["seeds"], (trial + 1) * counts["seeds"])
            replays = {name: fill_replay(make_agent(name, batches[0], seeds, device), FILL) for name in names}
            for batch in batches:
                bar.set_description(f"batch {batch}, trial {trial + 1}")
                agents = {
                    name: GradientSteps(make_agent(name, batch, seeds, device), replay, batch)
                    for name, replay in replays.items()
                }
                for name, (cpu, gpu) in measure(agents, counts["steps"], bar.update).items():
                    row = {"algo": name, "batch": batch, "trial": trial, "cpu_seconds": cpu, "gpu_seconds": gpu}
                    writer.writerow(fixed | row)
                file.flush()


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
            print("\ninterrupted; the measurements so far are kept", file=sys.stderr)
        print(to_terminal(runtime_table(path), bold=False, width=None))
    except (ConfigError, OSError) as error:
        print(f"bench/runtime.py: {error}", file=sys.stderr)
        return 130 if interrupted else 2
    print(f"{path} (python plot.py runtime {path} draws it)")
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
