"""Measurements of seeds in lockstep on any device: gradient steps, whole runs, and the agreement of two devices."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from statistics import median
from typing import Any

import torch

from bench.common import agent_of, fill_replay, make_config
from bench.eager import EagerUpdate
from bench.floor import Floor, update_products
from bench.phases import Stopwatch, new_trainer
from core.agent import Agent
from core.ahead import Ahead
from core.cuda_graph import CapturedStep, GradientSteps

ALGO = {"TD3": "DPre", "SAC": "SPre"}
TRANSITIONS = 1_000
"""Number in each seed's replay buffer, for the measurement of gradient steps."""
ROUNDS = 5
WARM_UP, SETTLED, LEARNED = 1_000, 2_000, 5_000
"""Environment steps of a run before the first gradient step, at the start of the measurement, and at its end."""
COMPARED = (1, 10, 50, 200)
"""Gradient steps after which devices are compared."""
ROUNDINGS = 3
NEVER = 10**9

PHASES = ("draws", "policy", "map", "environments", "transfer", "gradient step", "waiting", "rest")
"""Phases of a run's wall-clock time. `draws` are the random numbers of gradient steps. `policy` includes the random
numbers of exploration, the copies to the device and back, and the wait for earlier gradient steps. `transfer` is the
storing of transitions, `gradient step` the launch of one, and `waiting` the check for losses that are not finite."""


def wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def rates(call: Callable[[], object], count: int, device: torch.device) -> tuple[float, float]:
    """Calls a second, and CPU milliseconds of this thread a call: medians over rounds of `count` calls."""
    for _ in range(10):
        call()
    wait_for(device)
    rounds = []
    for _ in range(ROUNDS):
        start, cpu = time.perf_counter(), time.thread_time()
        for _ in range(count):
            call()
        cpu = time.thread_time() - cpu  # waiting for a GPU keeps the CPU busy and does not count
        wait_for(device)
        rounds.append((count / (time.perf_counter() - start), 1e3 * cpu / count))
    return median(rate for rate, _ in rounds), median(cpu for _, cpu in rounds)


@contextmanager
def memory_of(device: torch.device) -> Iterator[Callable[[], float | str]]:
    """Yield a function that returns the peak GPU memory since the start, in megabytes ("" on a CPU)."""
    on_gpu = device.type == "cuda"
    if on_gpu:
        gc.collect()  # agents and their graphs form reference cycles
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    yield lambda: torch.cuda.max_memory_allocated(device) / 1e6 if on_gpu else ""


def floor_rate(floor: Floor, count: int, device: torch.device) -> float:
    """Updates a second of the matrix products alone; a GPU runs them as a CUDA graph."""
    if device.type != "cuda":
        return rates(floor.update, count, device)[0]
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        for _ in range(2 * floor.delay):
            floor.update()
    torch.cuda.current_stream(device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(floor.delay):
            floor.update()
    return floor.delay * rates(graph.replay, count, device)[0]


def measure_updates(base: str, task: str, seeds: int, count: int, device: torch.device) -> dict[str, Any]:
    """A record of the speed and memory of gradient steps of `seeds` seeds in lockstep, `count` steps in each round."""
    config = make_config(ALGO[base], env=task, device=device)
    with memory_of(device) as peak:
        agent = agent_of(config, range(seeds))
        replay = fill_replay(agent, TRANSITIONS)
        rate, cpu = rates(GradientSteps(agent, replay, config.batch_size), count, device)
        megabytes = peak()
    floor = Floor(update_products(base, config, agent.obs_dim, agent.action_dim, seeds), device)
    record = {"base": base, "algo": config.algo, "task": task, "seeds": seeds, "steps_a_round": count}
    record |= {"steps_per_second": rate, "seed_updates_per_second": seeds * rate, "cpu_ms_a_step": cpu}
    record["floor_seed_updates_per_second"] = seeds * floor_rate(floor, count, device)
    eager = EagerUpdate(base, config, agent.obs_dim, agent.action_dim)
    record["eager_updates_per_second"] = rates(eager.update, count, device)[0] if seeds == 1 else ""
    buffer = config.buffer_size * sum(replay.widths) * 4 * seeds
    return record | {"gpu_mb": megabytes, "replay_mb": buffer / 1e6}


def measure_agreement(name: str, task: str, device: torch.device) -> list[dict[str, Any]]:
    """Records of the difference between the parameters of two seeds on `device` and on the CPU after `COMPARED` steps.

    `difference` is the largest of any parameter tensor, relative to the largest number in the tensor. `rounding` is the
    largest such difference among `ROUNDINGS` trainings on the CPU whose initial parameters differ by a rounding. It
    shows how far kinks of a network or a map amplify roundings.
    """
    there_config = make_config(name, env=task, hidden="[64,64]", batch_size=32, device=device)
    here_config = replace(there_config, device="cpu")
    agents = [agent_of(config, range(2)) for config in (here_config, there_config, *[here_config] * ROUNDINGS)]
    for number, agent in enumerate(agents[2:]):
        round_differently(agent, torch.Generator().manual_seed(number))
    steps = [GradientSteps(agent, fill_replay(agent, 200), 32) for agent in agents]
    records = []
    for number in range(1, COMPARED[-1] + 1):
        for step in steps:
            step()
        if number in COMPARED:
            here, there, *others = agents
            rounding = max(difference(here, other) for other in others)
            record = {"algo": name, "task": task, "steps": number, "difference": difference(here, there)}
            records.append(record | {"rounding": rounding})
    return records


@torch.no_grad()
def round_differently(agent: Agent, generator: torch.Generator) -> None:
    """Change every parameter by at most two steps of float32, up or down."""
    for network in agent.networks().values():
        for parameter in network.parameters():
            parameter.mul_(1 + 6e-8 * torch.randn(parameter.shape, generator=generator).sign())


def difference(agent: Agent, other: Agent) -> float:
    """The largest difference of any parameter tensor of any seed, relative to the largest number in it."""
    found = []
    for i in range(len(agent.seeds)):
        one, two = agent.state(i), other.state(i)
        found += [((two[k] - v).abs().max() / v.abs().max().clamp(1e-8)).item() for k, v in one.items()]
    return max(found)


class _Enough(BaseException):
    """Ends a training loop from within. A BaseException, as the loop would report an Exception as an error."""


def measure_run(base: str, task: str, seeds: int, threads: int, device: torch.device) -> dict[str, Any]:
    """A record of the speed and phases of a whole run, environment included, between `SETTLED` and `LEARNED` steps."""
    never = dict.fromkeys(("steps", "eval_every", "checkpoint_every"), NEVER)
    config = make_config(
        ALGO[base], env=task, device=device, learning_starts=WARM_UP, buffer_size=2 * LEARNED, threads=threads, **never
    )
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    watch, moments = Stopwatch(), []

    def stop_if_asked() -> None:  # the loop calls it between any two steps
        if any(seed.owed for seed in trainer.seeds):
            return
        steps = min(seed.steps for seed in trainer.seeds)
        if steps >= (LEARNED if moments else SETTLED):
            wait_for(device)
            moments.append((time.perf_counter(), steps, trainer.seeds[0].gradient_steps))
            if len(moments) == 2:
                raise _Enough
            watch.calls.clear()

    with new_trainer(config, range(seeds), stop_if_asked) as trainer, ExitStack() as watched:
        agent, replay = trainer.agent, trainer.replay
        watches = [
            (agent, "explore", "policy"),
            (trainer, "_outcomes", "environments"),
            (replay, "add", "transfer"),
            (replay, "flush", "transfer"),
            (agent, "diverged", "waiting"),
            (Ahead, "begin", "draws"),
            *(
                [(CapturedStep, "repeat", "gradient step")]
                if device.type == "cuda"
                else [(agent, "update", "gradient step")]
            ),
        ]
        if agent.placement == "environment":  # the map is not part of gradient steps
            watches.append((agent, "feasible", "map"))
        for owner, name, phase in watches:
            watched.enter_context(watch.watch(owner, name, phase))
        with suppress(_Enough):
            trainer.run()
    torch.set_num_threads(before)
    (start, first, _), (stop, last, _) = moments
    steps = last - first
    record = {"base": base, "algo": config.algo, "task": task, "seeds": seeds, "threads": threads, "steps": steps}
    record |= {"gradient_steps": moments[1][2] - moments[0][2], "steps_per_second": steps / (stop - start)}
    record["seed_steps_per_second"] = seeds * record["steps_per_second"]
    milliseconds = {phase: 1e3 * watch.seconds(phase) / steps for phase in PHASES}
    milliseconds["rest"] = 1e3 * (stop - start) / steps - sum(milliseconds.values())
    return record | {f"{phase}_ms".replace(" ", "_"): value for phase, value in milliseconds.items()}
