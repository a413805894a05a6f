"""The cells of a sweep on this machine: a process each, as many at a time as wanted, the others in a queue."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from datetime import datetime
from pathlib import Path

from store.files import one_line
from store.interrupt import Interrupted
from sweep.cells import command_words, format_seeds, reason_of
from sweep.plan import Entry, describe_state
from sweep.progress import Display, End

RUN = Path(__file__).parents[1] / "run.py"
POLL = 0.5
"""Seconds between two looks at signals and progress."""


class Queue:
    """The processes of the cells. A crash of one, or the end of one for lack of memory, leaves the others alone."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.stopping = False
        self.processes: dict[Entry, tuple[subprocess.Popen, float]] = {}  # with the time of the start

    def running(self) -> dict[Entry, float]:
        """The cells that have a process, each with the seconds since its start."""
        with self.lock:
            return {entry: time.monotonic() - start for entry, (_, start) in self.processes.items()}

    def train(self, entry: Entry) -> End | None:
        """Run the process of a cell to its end; None where the queue was stopped first."""
        cell, path = entry.cell, entry.cell.record("log")
        command = [sys.executable, str(RUN), *command_words(entry.config, entry.base)]
        try:
            with self.lock:
                if self.stopping:
                    return None
                cell.record("end").unlink(missing_ok=True)
                with open(path, "a") as log:
                    print(f"+ {' '.join(command)} # {datetime.now():%Y-%m-%d %H:%M:%S}", file=log, flush=True)
                    # In a session of its own, as a terminal sends Ctrl-C to every process of its session: a cell must
                    # get one signal, from `stop`, because a second one would end it without a checkpoint.
                    process = subprocess.Popen(
                        command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
                    )
                start = time.monotonic()
                self.processes[entry] = process, start
            code = process.wait()
            with self.lock:
                del self.processes[entry]
                if self.stopping and code in (-signal.SIGTERM, 128 + signal.SIGTERM):
                    return None
            end = End(code, time.monotonic() - start, reason_of(code, path))
            cell.note_end(code, path)
            return end
        except OSError as error:  # of the log, or of starting a process
            return End(1, 0.0, f"{error.filename or 'system'}: {one_line(error)}")

    def stop(self) -> None:
        """Have every process write its checkpoint and end, and start no other; a second call ends them at once."""
        with self.lock:
            self.stopping = True
            for process, _ in self.processes.values():
                process.terminate()


def run_queue(entries: Sequence[Entry], jobs: int, check: Callable[[], None]) -> int:
    """Train the cells that have not ended, `jobs` at a time in the given order; the exit code.

    Those that another process or a Slurm job has, or may have, are left out.
    `check` raises Interrupted to end all: the processes write their checkpoints first.
    """
    elsewhere = [entry for entry in entries if entry.state.name in ("running", "queued", "unknown")]
    entries = [entry for entry in entries if entry not in elsewhere]
    waiting = [entry for entry in entries if entry.state.name != "finished"]
    for entry in waiting:
        log = entry.cell.record("log")
        log.parent.mkdir(parents=True, exist_ok=True)
        log.touch()  # tells `status` of the cell
    queue, display = Queue(), Display(entries, jobs)
    interrupted: Interrupted | None = None
    with ThreadPoolExecutor(jobs) as pool, display:
        unfinished = {pool.submit(queue.train, entry): entry for entry in waiting}
        try:
            while unfinished:
                done, _ = wait(unfinished, timeout=POLL, return_when=FIRST_COMPLETED)
                for future in done:
                    entry, end = unfinished.pop(future), future.result()
                    if end is not None:
                        display.end(entry, end)
                display.show(queue.running())
                try:
                    if interrupted is None:
                        check()
                except Interrupted as error:
                    interrupted = error
                    display.say("interrupted: waiting for checkpoints (a second time ends without them)")
                    queue.stop()
        except BaseException:
            queue.stop()
            raise
    print(display.summary())
    for entry, end in display.failed.items():
        seeds = format_seeds(entry.cell.seeds)
        print(f"{entry.cell.name} seed={seeds} failed: {end.reason}\n    {entry.cell.record('log')}", file=sys.stderr)
    if elsewhere:
        first = elsewhere[0]
        print(
            f"{len(elsewhere)} left out, as others have them (`run.py status {first.cell.root}` shows all):"
            f" {first.cell.name} seed={format_seeds(first.cell.seeds)} is {describe_state(first.state)}"
            + (" ..." if len(elsewhere) > 1 else ""),
            file=sys.stderr,
        )
    if interrupted:
        print("interrupted; the same command resumes (without overwrite=true)", file=sys.stderr)
        raise interrupted
    return 4 if display.failed else 2 if elsewhere else 3 if display.diverged else 0


def cores() -> int:
    """Those that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
