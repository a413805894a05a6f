"""Gradient steps of several processes on one GPU, which take turns or share it through NVIDIA's MPS.

    python bench/shared_gpu.py                          # 1, 4 and 8 processes with ten seeds of DPre on R+L2
    python bench/shared_gpu.py processes=1,2 algo=SPre env=HC+O seeds=3 seconds=5
    python bench/shared_gpu.py device=cpu processes=1,2

Prints a line for taking turns and, if the Multi-Process Service is installed, one for sharing. Each number of processes
has a column.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch

from algos import ALGORITHMS
from bench.common import agent_of, fill_replay, make_config
from bench.mps import shared_gpu
from core.cuda_graph import GradientSteps
from core.words import ConfigError, known_name, parse_words, whole_number, whole_numbers
from envs import TASKS
from sweep.train import check_device

DEFAULTS = {"algo": "DPre", "env": "R+L2", "seeds": "10", "processes": "1,4,8", "seconds": "3", "device": "cuda"}
TRANSITIONS, BLOCK = 300, 50
"""Transitions of each seed; gradient steps between two looks at the clock."""
NUMBER = "--number="
"""The start of the last argument of each measuring process."""
PAUSE = 0.5
"""Seconds between two measurements."""


def take_steps(options: dict[str, str], number: int, processes: list[int]) -> None:
    """Measure as process `number`: print its single-seed updates a second for each number in `processes`.

    In a measurement with `number` processes or fewer, this process pauses and prints 0. The process prints a line when
    it is ready, reads a time (seconds since the epoch) from stdin, and starts then.
    """
    torch.set_num_threads(1)
    seeds, seconds = (whole_number(key, options[key]) for key in ("seeds", "seconds"))
    config = make_config(options["algo"], env=options["env"], device=options["device"])
    agent = agent_of(config, range(seeds))
    step = GradientSteps(agent, fill_replay(agent, TRANSITIONS), config.batch_size)
    for _ in range(10):  # the first steps capture CUDA graphs
        step()
    print("ready", flush=True)
    start = float(input())
    rates = []
    for k, count in enumerate(processes):
        begin = start + k * (seconds + PAUSE)
        time.sleep(max(begin - time.time(), 0.0))
        steps, since = 0, time.time()
        while number < count and time.time() < begin + seconds:
            for _ in range(BLOCK):
                step()
            if agent.device.type == "cuda":
                torch.cuda.synchronize()
            steps += BLOCK
        rates.append(seeds * steps / (time.time() - since) if steps else 0.0)
    print(*rates)


def measure(options: dict[str, str], environment: dict[str, str]) -> list[float]:
    """Single-seed updates a second of all processes together, for each number of processes. Raises ConfigError if one
    fails."""
    words = [f"{key}={value}" for key, value in options.items()]
    running = [
        subprocess.Popen(
            [sys.executable, __file__, *words, f"{NUMBER}{number}"],
            env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for number in range(max(whole_numbers("processes", options["processes"])))
    ]
    ready = [process.stdout.readline() for process in running if process.stdout]
    start = time.time() + 1.0
    outputs = [process.communicate(f"{start}\n")[0] for process in running] if all(ready) else []
    if not outputs or any(process.wait() for process in running):
        for process in running:
            process.kill()
        raise ConfigError("a process failed")
    return [sum(rates) for rates in zip(*(map(float, output.split()) for output in outputs), strict=True)]


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    if {"-h", "--help", "help"} & set(arguments):
        print(__doc__.strip())
        return 0
    try:
        words = list(arguments)
        number = words.pop().removeprefix(NUMBER) if words and words[-1].startswith(NUMBER) else ""
        options = DEFAULTS | parse_words(words, DEFAULTS)
        known_name("algorithm", options["algo"], ALGORITHMS)
        known_name("task", options["env"], TASKS)
        check_device(options["device"])
        processes = whole_numbers("processes", options["processes"])
        whole_number("seeds", options["seeds"])
        whole_number("seconds", options["seconds"])
        if number:
            take_steps(options, int(number), processes)
            return 0
        print("processes: updates of single seeds a second", *processes, sep="\t")
        print("taking turns", *(f"{rate:,.0f}" for rate in measure(options, {})), sep="\t", flush=True)
        with shared_gpu(torch.device(options["device"])) as environment:
            if environment:
                print("sharing through MPS", *(f"{rate:,.0f}" for rate in measure(options, environment)), sep="\t")
    except ConfigError as error:
        print(f"bench/shared_gpu.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
