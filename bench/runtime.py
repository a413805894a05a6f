"""The paper's runtime experiment: the first gradient steps of every algorithm on HalfCheetah (HC+O).

    python bench/runtime.py                                        # as the paper, and batch 256: hours on one core
    python bench/runtime.py algo=DOpt,DRad batch=1,16 trials=2 steps=100 out=bench/results
    python bench/runtime.py seeds=10                               # ten seeds in lockstep: seconds of all ten

A trial fills a replay buffer with 1,000 steps of the environment under random feasible actions, makes a new agent with
the paper's hyperparameters but for the batch size, and takes `steps` gradient steps, sampling included. Every trial
has seeds of its own. All cells are measured once before any is measured again, and every measurement is saved when it
is made, so that what an interruption leaves is of use.

Prints a table and saves `out`/runtime.csv (default bench/results), a row a measurement, which `python plot.py runtime`
draws. CPU seconds are CPU time of the process, on one thread, so that other load on the machine does not count; GPU
seconds are the time in which its kernels run, from as many further gradient steps under PyTorch's profiler.
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

import numpy as np
import torch
from tqdm import tqdm

import envs
import run
from algos import ALGORITHMS
from core.agent import Agent
from core.config import ConfigError, choose, split_names
from core.random import stream_seed
from core.replay import Replay
from core.results import processor
from plots.runtime import COLUMNS, runtime_table
from plots.tables import to_terminal

TASK = "HC+O"
FILL = 1_000
"""Transitions of each seed in the replay buffer."""
DEVICE = torch.device("cpu")
"""Where the networks compute."""
DEFAULTS = {
    "algo": "all",
    "batch": "1,16,100,256",
    "trials": "10",
    "steps": "1000",
    "seeds": "1",
    "out": "bench/results",
}


def make_agent(name: str, batch: int, seeds: Sequence[int]) -> Agent:
    """A new agent with the paper's settings for the task, the batch size apart."""
    ((config, _),) = run.plan([f"algo={name}", f"env={TASK}", f"batch_size={batch}"])
    constraint = envs.constraint(TASK)
    return ALGORITHMS[name].build(config, constraint, envs.TASKS[TASK].robot.obs_dim, seeds)


def fill_replay(agent: Agent) -> Replay:
    """A buffer with FILL steps of the environment of each of the agent's seeds, under its warm-up actions."""
    seeds = agent.seeds
    everyone = range(len(seeds))
    replay = Replay(seeds, FILL, agent.obs_dim, agent.action_dim, agent.stores_centers)
    robots = [envs.make(TASK) for _ in seeds]
    obs = stack([env.reset(seed=stream_seed(seed, "environment"))[0] for env, seed in zip(robots, seeds, strict=True)])
    for _ in range(FILL):
        suggested = agent.warm_up(everyone)
        executed = agent.pull_back(obs, suggested, None)
        steps = [env.step(action) for env, action in zip(robots, executed.numpy(), strict=True)]
        next_obs, reward, terminated = (stack([step[k] for step in steps]) for k in range(3))
        stored = suggested if agent.placement == "environment" else executed
        replay.add(everyone, obs, stored, reward[:, None], terminated[:, None], next_obs)
        restarts = {
            i: env.reset()[0] for i, (env, step) in enumerate(zip(robots, steps, strict=True)) if any(step[2:4])
        }
        obs = stack([restarts.get(i, row) for i, row in enumerate(next_obs.numpy())])
    for env in robots:
        env.close()
    return replay


def stack(rows: Sequence) -> torch.Tensor:
    return torch.as_tensor(np.stack(rows), dtype=torch.float32)


def measure(name: str, batch: int, replay: Replay, seeds: Sequence[int], steps: int) -> tuple[float, float]:
    """CPU and GPU seconds of the first `steps` gradient steps."""
    agent = make_agent(name, batch, seeds)

    def train() -> None:
        for _ in range(steps):
            agent.update(replay.sample(batch))

    start = time.process_time()
    train()
    cpu = time.process_time() - start
    return cpu, kernel_seconds(train) if DEVICE.type == "cuda" else 0.0


def kernel_seconds(call: Callable[[], None]) -> float:
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        call()
        torch.cuda.synchronize(DEVICE)
    return sum(event.self_device_time_total for event in profile.key_averages()) * 1e-6


def machine() -> str:
    """Processor, versions and device."""
    device = torch.cuda.get_device_name(DEVICE) if DEVICE.type == "cuda" else "no GPU"
    return f"{processor()}, {device}, torch {torch.__version__}"


def parse_arguments(arguments: Sequence[str]) -> tuple[list[str], list[int], dict[str, int], Path]:
    """Algorithms, batch sizes, the whole numbers by name, and the folder. Raises ConfigError for what is wrong."""
    options = dict(DEFAULTS)
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or not value:
            raise ConfigError(f"expected key=value, got {argument!r}")
        options[choose("key", key, DEFAULTS)] = value
    batches = [positive("batch", text) for text in options["batch"].split(",")]
    counts = {key: positive(key, options[key]) for key in ("trials", "steps", "seeds")}
    return split_names("algo", options["algo"], ALGORITHMS), batches, counts, Path(options["out"]).expanduser()


def positive(key: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"bad value {text!r} for {key}: expected whole numbers from 1 on")
    return int(text)


def run_trials(names: Sequence[str], batches: Sequence[int], counts: dict[str, int], path: Path) -> None:
    """Measure every cell `trials` times and write each measurement to `path` at once."""
    fixed = {"task": TASK, "seeds": counts["seeds"], "steps": counts["steps"], "machine": machine()}
    total = counts["trials"] * len(names) * len(batches)
    with open(path, "w", newline="", encoding="utf-8") as file, tqdm(total=total, unit="cell", smoothing=0) as bar:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for trial, name in product(range(counts["trials"]), names):
            seeds = range(trial * counts["seeds"], (trial + 1) * counts["seeds"])
            replay = fill_replay(make_agent(name, batches[0], seeds))
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
        names, batches, counts, out = parse_arguments(arguments)
        out.mkdir(parents=True, exist_ok=True)
        path = out / "runtime.csv"
        try:
            run_trials(names, batches, counts, path)
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
