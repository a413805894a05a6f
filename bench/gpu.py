"""All measurements on a GPU, in one call of a few minutes.

    python bench/gpu.py                                       # at most 9 minutes, into bench/results/gpu
    python bench/gpu.py minutes=5 parts=updates,runs out=FOLDER
    python bench/gpu.py device=cpu parts=updates seeds=1      # the same on a CPU
    python bench/gpu.py parts=updates base=TD3,SAC task=R+L2,HC+O seeds=1,10,30 steps=200       # the defaults of a part

The parts run in this order. Each result is saved at once, so that an early end keeps all results before it:

- `tests`: the tests that need CUDA (output in tests.txt);
- `updates`: gradient steps of TD3 (DPre) and SAC (SPre), sampling included, of 1, 10 and 30 seeds in lockstep on R+L2
  and HC+O, beside the floor (the same matrix products and nothing else, as a CUDA graph) and, for one seed, beside
  eager PyTorch in CleanRL's style (bench/eager.py); CPU time of the thread that launches them; GPU memory;
- `agreement`: the difference between parameters on the GPU and on the CPU over the first 200 updates, all 13
  algorithms, and for comparison the difference that a rounding of the initial parameters causes on the CPU;
- `runs`: steps a second of whole runs, environment included, and the phases of a step of all seeds;
- `cells`: full-length cells of R+L2, the algorithms `cells` with the seeds `cell_seeds`, a process for each algorithm,
  until the time is over. Their folders are in `out`/runs. They write a checkpoint only when the time is over; the same
  command then resumes them. If NVIDIA's Multi-Process Service is installed, the processes share the GPU through it;
  otherwise they take turns.

Every part has a table in `out` as CSV and Markdown. gpu.md has all tables, and machine.json names the machine. Errors
are in errors.txt; the other measurements continue.

A machine with PyTorch but without network needs some wheels of its Python version, 34 MB for all parts but the tests:

    pip download -d wheels --no-deps --only-binary=:all: -c requirements-lock.txt gymnasium farama-notifications \\
        cloudpickle mujoco mujoco-core omegaconf pyyaml tqdm numpy pillow typing_extensions

The tests also need pytest, pytest-xdist, hypothesis, matplotlib, scipy and their dependencies. On that machine:

    pip install --no-index --no-deps --target FOLDER wheels/*
    PYTHONPATH=FOLDER MUJOCO_GL=disable python bench/gpu.py

With MUJOCO_GL=disable, MuJoCo needs neither OpenGL nor its packages.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(ROOT)

import torch

from algos import PAPER
from bench.common import machine_name
from bench.lockstep import ALGO, PHASES, measure_agreement, measure_run, measure_updates
from bench.mps import shared_gpu
from core.config import parse_seeds
from core.words import ConfigError, parse_words, split_names, whole_number, whole_numbers
from envs import TASKS
from store.files import user_path
from store.folder import find_runs, read_run
from store.provenance import describe_environment
from sweep.cells import format_seeds
from sweep.train import check_device
from tables import MISSING, Table, text_cells, to_markdown, to_terminal, write_table

PARTS = ("tests", "updates", "agreement", "runs", "cells")
DEFAULTS = {
    "parts": "all",
    "base": "TD3,SAC",
    "task": "R+L2,HC+O",
    "seeds": "1,10,30",
    "steps": "200",
    "cells": "DPre,SRad,DAlpha,SPre,DRad",
    "cell_seeds": "0-9",
    "minutes": "9",
    "device": "cuda",
    "out": "bench/results/gpu",
}
TESTS = ["tests/test_graph.py", "tests/test_device.py", "tests/test_ahead.py", "-k", "cuda or gpu or ahead"]
TEST_SECONDS = 120
RUN_SEEDS = (1, 10)
CELL_TASK = "R+L2"
CELL_WORDS = ["checkpoint_every=1000000000", "threads=1"]
STOPPING = 40
"""Seconds reserved at the end for the cells to write their checkpoints."""


@dataclass(frozen=True)
class Options:
    parts: list[str]
    bases: list[str]
    tasks: list[str]
    seeds: list[int]
    steps: int
    cells: list[str]
    cell_seeds: Sequence[int]
    device: torch.device
    out: Path
    deadline: float

    @property
    def seconds_left(self) -> float:
        return self.deadline - time.monotonic()


# ---------------------------------------------------------------------------------------------------------- the parts


def run_tests(options: Options) -> Table:
    """Run the tests that need CUDA; their output is in tests.txt."""
    command = [sys.executable, "-m", "pytest", "-q", "-o", "addopts=", "-p", "no:cacheprovider", "-rs", *TESTS]
    if importlib.util.find_spec("xdist"):
        command += ["-n", "4"]
    path = options.out / "tests.txt"
    start = time.monotonic()
    with open(path, "w", encoding="utf-8") as file:
        try:
            limit = min(TEST_SECONDS, options.seconds_left)
            code = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, timeout=limit).returncode
            outcome = f"exit code {code}"
        except subprocess.TimeoutExpired:
            outcome = "not finished"
    lines = path.read_text(encoding="utf-8").strip().splitlines()
    record = {"outcome": outcome, "seconds": round(time.monotonic() - start, 1), "summary": lines[-1] if lines else ""}
    return Table("tests", "Tests that need CUDA", [*record], 3, [[text_cells(*map(str, record.values()))]], [record])


def updates_table(records: Sequence[dict]) -> Table:
    rows = [
        text_cells(
            r["base"],
            r["task"],
            str(r["seeds"]),
            f"{r['seed_updates_per_second']:,.0f}",
            f"{r['floor_seed_updates_per_second']:,.0f}",
            f"{r['eager_updates_per_second']:,.0f}" if r["eager_updates_per_second"] else MISSING,
            f"{r['cpu_ms_a_step']:.3f}",
            f"{r['gpu_mb']:,.0f}" if r["gpu_mb"] else MISSING,
            f"{r['replay_mb']:,.0f}",
        )
        for r in records
    ]
    header = ["", "task", "seeds", "seed-updates/s", "floor", "eager", "CPU ms a step", "GPU MB", "MB of a full buffer"]
    return Table("updates", "Gradient steps, sampling included", header, 3, [rows], list(records))


def agreement_table(records: Sequence[dict]) -> Table:
    counts = list(dict.fromkeys(r["steps"] for r in records))
    by_name: dict[str, list[dict]] = {}
    for r in records:
        by_name.setdefault(r["algo"], []).append(r)
    rows = [
        text_cells(
            name,
            *(f"{r['difference']:.1e}" for r in found),
            *(f"{r['rounding']:.1e}" for r in found if r["steps"] == counts[-1]),
        )
        for name, found in by_name.items()
    ]
    title = f"Largest relative difference to the CPU's parameters after so many updates, {records[0]['task']}"
    header = ["", *map(str, counts), f"{counts[-1]}, CPU with another rounding"]
    return Table("agreement", title, header, 1, [rows], list(records))


def runs_table(records: Sequence[dict]) -> Table:
    keys = [f"{phase}_ms".replace(" ", "_") for phase in PHASES]
    rows = [
        text_cells(
            r["base"],
            r["task"],
            str(r["seeds"]),
            str(r["threads"]),
            f"{r['steps_per_second']:,.0f}",
            f"{r['seed_steps_per_second']:,.0f}",
            *(f"{r[key]:.3f}" for key in keys),
        )
        for r in records
    ]
    title = "Whole runs, and the milliseconds of a step of all seeds"
    header = ["", "task", "seeds", "threads", "steps/s", "seed-steps/s", *PHASES]
    return Table("runs", title, header, 4, [rows], list(records))


def measure_each(
    options: Options, cases: Sequence[tuple], measure: Callable[..., Any], table: Callable[[list], Table]
) -> Table | None:
    """Measure as many of `cases` as the time allows; save their table after each. None if there is no measurement."""
    records: list[dict] = []
    for case in cases:
        if options.seconds_left < 0:
            print(f"the time is over before {case}", file=sys.stderr)
            break
        try:
            found = measure(*case, options.device)
        except Exception:  # GPU time is scarce: a case that fails must not cost the others
            report(options, f"{case}")
            continue
        records += found if isinstance(found, list) else [found]
        write_table(table(records), options.out, ("csv", "md"))
        print(json.dumps(records[-1]), flush=True)
    return table(records) if records else None


def report(options: Options, what: str) -> None:
    """Print the exception that is being handled and append it to errors.txt."""
    text = f"{what}:\n{traceback.format_exc()}\n"
    print(text, file=sys.stderr, flush=True)
    with open(options.out / "errors.txt", "a", encoding="utf-8") as file:
        file.write(text)


def measure_updates_of(options: Options) -> Table | None:
    cases = [(b, t, s, options.steps) for t in options.tasks for s in options.seeds for b in options.bases]
    return measure_each(options, cases, measure_updates, updates_table)


def measure_agreement_of(options: Options) -> Table | None:
    return measure_each(options, [(name, "HC+O") for name in PAPER], measure_agreement, agreement_table)


def measure_runs_of(options: Options) -> Table | None:
    many = min(os.cpu_count() or 1, 8)
    cases = [(b, t, s, 1) for t in options.tasks for s in RUN_SEEDS for b in options.bases]
    if many > 1 and "HC+O" in options.tasks:  # Reacher's closed form uses no threads
        cases += [(b, "HC+O", RUN_SEEDS[-1], many) for b in options.bases]
    return measure_each(options, cases, measure_run, runs_table)


def train_cells(options: Options) -> Table | None:
    """Train full-length cells, all at once, until they are done or the time is over."""
    if options.seconds_left < STOPPING:
        print("the time is over before the cells", file=sys.stderr)
        return None
    seeds = f"seed={format_seeds(options.cell_seeds)}"
    words = [f"env={CELL_TASK}", seeds, f"device={options.device}", f"results={options.out / 'runs'}", *CELL_WORDS]
    started = time.monotonic()
    running: dict[str, subprocess.Popen] = {}
    with shared_gpu(options.device) as environment:
        try:
            for name in options.cells:
                command = [sys.executable, "run.py", f"algo={name}", *words]
                with open(options.out / f"cell-{name}.txt", "w", encoding="utf-8") as file:
                    running[name] = subprocess.Popen(
                        command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, env=os.environ | environment
                    )
            while any(p.poll() is None for p in running.values()) and options.seconds_left > STOPPING:
                time.sleep(0.5)
        finally:
            stop(list(running.values()))
    wall = time.monotonic() - started
    records = [cell_record(options, name, process.returncode, wall) for name, process in running.items()]
    return cells_table(records, bool(environment))


def stop(processes: Sequence[subprocess.Popen]) -> None:
    """Ask the running processes to save and end; kill those that do not end in time."""
    for process in processes:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    limit = time.monotonic() + STOPPING - 5
    for process in processes:
        try:
            process.wait(max(limit - time.monotonic(), 0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def cell_record(options: Options, name: str, code: int, wall: float) -> dict[str, Any]:
    """The progress of a cell and the mean return of its finished seeds.

    `seconds` counts the training itself if a seed is finished, else it is `wall`.
    """
    runs = []
    for folder in find_runs(options.out / "runs"):
        with suppress(ValueError):  # the time was over before its files were complete
            runs.append(read_run(folder))
    runs = [run for run in runs if run.algo == name]
    results = [run.result for run in runs if run.result]
    steps = min((int(max(run.evaluations.step, default=0)) for run in runs), default=0)
    seconds = max((result["seconds"]["total"] for result in results), default=wall)
    record = {"algo": name, "task": CELL_TASK, "seeds": len(options.cell_seeds), "processes": len(options.cells)}
    record |= {"exit_code": code, "finished": len(results), "evaluated_to_step": steps, "seconds": seconds}
    mean = sum(result["return_mean"] for result in results) / len(results) if results else ""
    return record | {"steps_per_second": steps / seconds, "return_mean": mean}


def cells_table(records: Sequence[dict], shared: bool) -> Table:
    rows = [
        text_cells(
            r["algo"],
            f"{r['finished']} of {r['seeds']}",
            f"{r['evaluated_to_step']:,}",
            f"{r['seconds']:.0f}",
            f"{r['steps_per_second']:,.0f}",
            MISSING if r["return_mean"] == "" else f"{r['return_mean']:.2f}",
        )
        for r in records
    ]
    sharing = "sharing the GPU through MPS" if shared else "taking turns"
    title = f"Cells of {CELL_TASK}, {records[0]['seeds']} seeds each, {len(records)} processes at once, {sharing}"
    return Table("cells", title, ["", "finished", "steps", "seconds", "steps/s", "return"], 1, [rows], list(records))


# -------------------------------------------------------------------------------------------------------- the command


def parse_arguments(arguments: Sequence[str]) -> Options:
    """The options of the command. Raises ConfigError for a wrong word."""
    options = DEFAULTS | parse_words(arguments, DEFAULTS)
    check_device(options["device"])
    minutes = whole_number("minutes", options["minutes"])
    return Options(
        split_names("parts", options["parts"], dict.fromkeys(PARTS)),
        split_names("base", options["base"], ALGO),
        split_names("task", options["task"], TASKS),
        list(dict.fromkeys(whole_numbers("seeds", options["seeds"]))),
        whole_number("steps", options["steps"]),
        split_names("cells", options["cells"], dict.fromkeys(PAPER)),
        parse_seeds(options["cell_seeds"]),
        torch.device(options["device"]),
        user_path(options["out"]).resolve(),
        time.monotonic() + 60 * minutes,
    )


def measure_all(options: Options) -> None:
    """Run the chosen parts in order and add the table of each to gpu.md."""
    parts = {
        "tests": run_tests,
        "updates": measure_updates_of,
        "agreement": measure_agreement_of,
        "runs": measure_runs_of,
        "cells": train_cells,
    }
    name = machine_name(options.device)
    machine = describe_environment(["bench/gpu.py"]) | {"machine": name, "cores": os.cpu_count()}
    (options.out / "machine.json").write_text(json.dumps(machine, indent=2) + "\n", encoding="utf-8")
    texts = [f"{name}, {os.cpu_count()} cores\n"]
    for part in PARTS:
        if part not in options.parts:
            continue
        print(f"{part}: {options.seconds_left:.0f} s left", file=sys.stderr, flush=True)
        try:
            table = parts[part](options)
        except Exception:
            report(options, part)
            table = None
        if table:
            write_table(table, options.out, ("csv", "md"))
            print(to_terminal(table, bold=False, width=None), flush=True)
            texts.append(to_markdown(table))
            (options.out / "gpu.md").write_text("\n".join(texts), encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 1 something failed, 2 bad input, 130 interrupted."""
    if {"-h", "--help", "help"} & set(arguments):
        print(__doc__.strip())
        return 0
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # `finally` stops the cells first
    try:
        options = parse_arguments(arguments)
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "errors.txt").unlink(missing_ok=True)
        measure_all(options)
        if (options.out / "errors.txt").exists():
            print(f"some measurements failed: {options.out / 'errors.txt'}", file=sys.stderr)
            return 1
    except (ConfigError, OSError) as error:
        print(f"bench/gpu.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted; the measurements so far are in the folder", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
