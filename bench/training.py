"""The cost of training: milliseconds of a gradient step and of an environment step, beside the arithmetic floor.

    python bench/training.py                                        # TD3 and SAC, 1 to 10 seeds, 1 and 2 threads
    python bench/training.py base=TD3 seeds=1,10 threads=1 rounds=5 steps=10 out=bench/results

TD3 is DPre (batch 100, layers of 400 and 300), SAC is SPre (batch 256, layers of 256 and 256), both on HalfCheetah
(HC+O) with the paper's settings. For each number of seeds in lockstep, the table also has

- the floor: the matrix products of one update in the same shapes and nothing else (bench/floor.py);
- if it is installed, Stable-Baselines3's algorithm of the same name with one seed and the same batch, layers and rate,
  on the same environment, which projects (bench/peer.py; `pip install -e '.[bench]'`).

All take turns of `steps` gradient steps, then of ten times as many environment steps, replay sampling included, with
10,000 transitions a seed in the buffer. A round has one turn of each; every other round reverses the order. A ratio is
the median of the ratios within rounds, so that other load on the machine affects both sides alike. Times are the least
and the median over rounds: CPU time of the process with one thread, wall-clock time with more.

Environment steps are taken by the training loop of run.py (exploration, projection, simulator, replay buffer) and by
Stable-Baselines3's `collect_rollouts`.

For the first number of threads and each number of seeds, a second table divides the wall-clock time of a whole run
into phases (bench/phases.py explains how they are measured and scaled to the paper's million steps).

Prints the tables and saves them in `out` (default bench/results) as training and phases, .md and .csv.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from tqdm import tqdm

from bench.common import TASK, fill_replay, machine_name, make_agent, make_config
from bench.floor import Floor, update_products
from bench.peer import INSTALLED, Peer, peer_version
from bench.phases import OUTSIDE, UPDATE, Phases, measure_phases, new_trainer
from core.words import ConfigError, parse_words, split_names, whole_number, whole_numbers
from store.files import user_path
from tables import MISSING, Table, text_cells, to_terminal, write_csv, write_table

ALGO = {"TD3": "DPre", "SAC": "SPre"}
TRANSITIONS = 10_000
"""Number in each seed's replay buffer."""
ENV_STEPS = 10
"""Environment steps of a turn for each gradient step of a turn."""
DEFAULTS = {
    "base": "TD3,SAC",
    "seeds": "1,2,5,10",
    "threads": "1,2",
    "rounds": "15",
    "steps": "10",
    "out": "bench/results",
}

Clock = Callable[[], float]
"""Seconds from an arbitrary moment."""
Turn = Callable[[Clock], float]
"""Takes the steps of one turn and returns their seconds."""


@dataclass(frozen=True)
class Options:
    bases: list[str]
    seeds: list[int]
    threads: list[int]
    rounds: int
    steps: int
    out: Path


class _Enough(Exception):
    """Ends a training loop from within."""


# ---------------------------------------------------------------------------------------------------- the measurement


def repeated(call: Callable[[], object], steps: int) -> Turn:
    def turn(clock: Clock) -> float:
        start = clock()
        for _ in range(steps):
            call()
        return clock() - start

    return turn


def environment_turn(base: str, seeds: int, steps: int) -> Turn:
    """Environment steps of a new trainer's loop, without gradient steps; the first ten do not count."""
    never = 10**9
    settings = dict.fromkeys(("steps", "train_freq", "eval_every", "checkpoint_every"), never)
    config = make_config(ALGO[base], **settings, learning_starts=0, buffer_size=TRANSITIONS)

    def turn(clock: Clock) -> float:
        times: list[float] = []

        def stop_if_asked() -> None:  # the loop calls it between any two steps
            taken = trainer.seeds[0].steps
            if taken >= 10 and not times:
                times.append(clock())
            elif taken >= 10 + steps:
                times.append(clock())
                raise _Enough

        with new_trainer(config, range(seeds), stop_if_asked) as trainer, suppress(_Enough):
            trainer.run()
        return times[1] - times[0]

    return turn


def turns(base: str, seeds: int, steps: int, peer: Peer | None) -> dict[str, Turn]:
    """The turns by name; "update" and "environment" are this project's."""
    config = make_config(ALGO[base])
    agent = make_agent(ALGO[base], config.batch_size, range(seeds))
    replay = fill_replay(agent, TRANSITIONS)
    floor = Floor(update_products(base, config, agent.obs_dim, agent.action_dim, seeds))
    found = {
        "floor": repeated(floor.update, steps),
        "update": repeated(lambda: agent.update(replay.sample(config.batch_size)), steps),
    }
    if peer:
        found["peer update"] = repeated(lambda: peer.update(steps), 1)
        found["peer environment"] = repeated(lambda: peer.collect(ENV_STEPS * steps), 1)
    found["environment"] = environment_turn(base, seeds, ENV_STEPS * steps)
    return found


def measure(base: str, threads: int, options: Options, cells: dict[int, dict[str, Turn]], bar: tqdm) -> list[dict]:
    """A record for each number of seeds: milliseconds a step and seed, and ratios."""
    torch.set_num_threads(threads)
    clock = time.process_time if threads == 1 else time.perf_counter
    milliseconds: dict[int, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for number in range(options.rounds + 1):
        direction = 1 if number % 2 else -1
        for seeds in options.seeds[::direction]:
            bar.set_description(f"{base}, threads={threads}, seeds={seeds}")
            for name, turn in list(cells[seeds].items())[::direction]:
                steps = options.steps * (ENV_STEPS if "environment" in name else 1)
                seconds = turn(clock) / (steps * (1 if "peer" in name else seeds))
                if number:  # round 0 is a warm-up
                    milliseconds[seeds][name].append(1e3 * seconds)
            bar.update()
    fixed = {"base": base, "algo": ALGO[base], "threads": threads, "rounds": options.rounds, "steps": options.steps}
    fixed |= {"clock": clock.__name__, "machine": machine_name(torch.device("cpu"))}
    fixed["stable_baselines3"] = peer_version() if INSTALLED else ""
    return [fixed | {"seeds": seeds} | summary(milliseconds[seeds]) for seeds in options.seeds]


def summary(milliseconds: dict[str, list[float]]) -> dict[str, Any]:
    """Least and median time of each turn, and medians of the ratios within rounds; "" for what was not measured."""

    def ratio(above: str, below: str) -> float | str:
        pairs = list(zip(milliseconds.get(above, []), milliseconds.get(below, []), strict=False))
        return median(a / b for a, b in pairs) if pairs else ""

    record: dict[str, Any] = {}
    for name in ("update", "floor", "peer update", "environment", "peer environment"):
        times = milliseconds.get(name, [])
        key = name.replace(" ", "_")
        record |= {f"{key}_ms_least": min(times, default=""), f"{key}_ms_median": median(times) if times else ""}
    record["update_over_floor"] = ratio("update", "floor")
    record["peer_over_update"] = ratio("peer update", "update")
    record["peer_over_environment"] = ratio("peer environment", "environment")
    return record


# --------------------------------------------------------------------------------------------------------- the tables


def training_table(records: Sequence[dict]) -> Table:
    """Milliseconds a step and seed, and ratios."""

    def text(value: float | str, digits: int) -> str:
        return MISSING if value == "" else f"{value:.{digits}f}"

    def times(record: dict, name: str, digits: int) -> str:
        least, middle = (text(record[f"{name}_ms_{which}"], digits) for which in ("least", "median"))
        return least if least == MISSING else f"{least} ({middle})"

    sections: dict[tuple, list] = defaultdict(list)
    for r in records:
        sections[r["base"], r["threads"]].append(
            text_cells(
                f"{r['base']}, {r['threads']} thread{'s' * (r['threads'] > 1)}",
                str(r["seeds"]),
                times(r, "update", 2),
                times(r, "floor", 2),
                text(r["update_over_floor"], 2),
                times(r, "peer_update", 2),
                text(r["peer_over_update"], 2),
                times(r, "environment", 3),
                times(r, "peer_environment", 3),
                text(r["peer_over_environment"], 2),
            )
        )
    first = records[0]
    title = f"{TASK}: milliseconds a step and seed, least (median) of {first['rounds']} rounds, on {first['machine']}"
    header = ["", "seeds", "gradient step", "floor", "ours / floor", "SB3", "SB3 / ours"]
    header += ["environment step", "SB3", "SB3 / ours"]
    return Table("training", title, header, 2, list(sections.values()), list(records))


def phase_records(base: str, seeds: int, threads: int, phases: Phases) -> list[dict]:
    return [
        {
            "base": base,
            "algo": ALGO[base],
            "seeds": seeds,
            "threads": threads,
            "phase": phase,
            "seconds": phases.measured[phase],
            "scaled_seconds": phases.scaled[phase],
            "share": phases.share(phase),
        }
        for phase in (*UPDATE, *OUTSIDE)
    ]


def phases_table(records: Sequence[dict]) -> Table:
    """Percent of a run's wall-clock time."""
    runs: dict[tuple, dict[str, dict]] = defaultdict(dict)
    for record in records:
        runs[record["base"], record["seeds"]][record["phase"]] = record

    def row(label: str, phases: Sequence[str]) -> list:
        shares = (sum(phase_of[phase]["share"] for phase in phases) for phase_of in runs.values())
        return text_cells(label, *(f"{100 * share:.2f}" for share in shares))

    hours = (sum(record["scaled_seconds"] for record in phase_of.values()) / 3600 for phase_of in runs.values())
    sections = [
        [row(phase, [phase]) for phase in UPDATE],
        [row(phase, [phase]) for phase in OUTSIDE],
        [
            row("all outside sampling and update", OUTSIDE),
            text_cells("hours of 1e6 steps of all seeds", *(f"{total:.2f}" for total in hours)),
        ],
    ]
    header = ["", *(f"{base}, {seeds} seed{'s' * (seeds > 1)}" for base, seeds in runs)]
    threads = records[0]["threads"]
    title = f"{TASK}: percent of a run's wall-clock time, {threads} thread{'s' * (threads > 1)}"
    return Table("phases", title, header, 1, sections, list(records))


def save(table: Table, folder: Path) -> None:
    write_table(table, folder, ("csv", "md"))
    print(to_terminal(table, bold=False, width=None), flush=True)


# -------------------------------------------------------------------------------------------------------- the command


def parse_arguments(arguments: Sequence[str]) -> Options:
    """The options of the command. Raises ConfigError for a wrong word."""
    options = DEFAULTS | parse_words(arguments, DEFAULTS)
    steps = whole_number("steps", options["steps"])
    if steps % 2:
        raise ConfigError(f"bad value {steps} for steps: expected an even number, as TD3's actor learns every second")
    return Options(
        split_names("base", options["base"], ALGO),
        list(dict.fromkeys(whole_numbers("seeds", options["seeds"]))),
        list(dict.fromkeys(whole_numbers("threads", options["threads"]))),
        whole_number("rounds", options["rounds"]),
        steps,
        user_path(options["out"]),
    )


def measure_all(options: Options) -> None:
    """Measure, save and print everything. Saves after each number of threads, and after each run of the phases."""
    records: list[dict] = []
    phases: list[dict] = []
    total = len(options.bases) * len(options.threads) * len(options.seeds) * (options.rounds + 1)
    with tqdm(total=total, unit="turn", smoothing=0, disable=None) as bar:
        for base in options.bases:
            peer = Peer(base, make_config(ALGO[base]), TRANSITIONS) if INSTALLED else None
            cells = {seeds: turns(base, seeds, options.steps, peer) for seeds in options.seeds}
            for threads in options.threads:
                records += measure(base, threads, options, cells, bar)
                write_csv(options.out / "training.csv", records)
    save(training_table(records), options.out)
    torch.set_num_threads(options.threads[0])
    for base in options.bases:
        for seeds in options.seeds:
            measured = measure_phases(ALGO[base], range(seeds))
            phases += phase_records(base, seeds, options.threads[0], measured)
            write_csv(options.out / "phases.csv", phases)
    save(phases_table(phases), options.out)


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input, 130 interrupted."""
    if {"-h", "--help", "help"} & set(arguments):
        print(__doc__.strip())
        return 0
    torch.set_flush_denormal(True)
    try:
        options = parse_arguments(arguments)
        options.out.mkdir(parents=True, exist_ok=True)
        if not INSTALLED:
            print("Stable-Baselines3 is not installed: without its columns", file=sys.stderr)
        measure_all(options)
    except (ConfigError, OSError) as error:
        print(f"bench/training.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted; the measurements so far are in the folder", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
