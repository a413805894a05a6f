"""The cells of a sweep on this machine: a queue of processes, one for each cell."""

from __future__ import annotations

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
from sweep.cells import format_seeds
from sweep.exit import Exit
from sweep.plan import Entry
from sweep.progress import Display, End
from sweep.states import Stage, reason_of

RUN = Path(__file__).parents[1] / "run.py"
POLL = 0.5
"""Seconds between two checks of signals and progress."""


class Queue:
    """The processes of the cells. If one crashes, even for lack of memory, the others continue."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.stopping = False
        self.processes: dict[Entry, tuple[subprocess.Popen, float]] = {}  # with the time of the start

    def running(self) -> dict[Entry, float]:
        """The cells that a process trains, each with the seconds since its start."""
        with self.lock:
            return {entry: time.monotonic() - start for entry, (_, start) in self.processes.items()}

    def train(self, entry: Entry) -> End | None:
        """Run the process of a cell to its end; None if the queue was stopped first."""
        cell, path = entry.cell, entry.cell.record("log")
        command = [sys.executable, str(RUN), *cell.words]
        try:
            with self.lock:
                if self.stopping:
                    return None
                cell.record("end").unlink(missing_ok=True)
                with open(path, "a", encoding="utf-8", errors="backslashreplace") as log:
                    print(f"+ {' '.join(command)} # {datetime.now():%Y-%m-%d %H:%M:%S}", file=log, flush=True)
                    # A session of its own: a terminal sends Ctrl-C to every process of its session, and the signal of
                    # `stop` would then be the second one, which ends the process without a checkpoint.
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
        except OSError as error:  # from the log, or from starting the process
            return End(1, 0.0, f"{error.filename or 'system'}: {one_line(error)}")

    def stop(self) -> None:
        """Make every process write its checkpoint and end, and start no more. A second call ends them at once."""
        with self.lock:
            self.stopping = True
            for process, _ in self.processes.values():
                process.terminate()


def run_queue(entries: Sequence[Entry], jobs: int, stop_if_asked: Callable[[], None]) -> Exit:
    """Train the cells that have not ended, `jobs` at a time, in the given order.

    Skips the cells that another process or a Slurm job trains, or may train. When `stop_if_asked` raises Interrupted,
    the processes write their checkpoints and end; then Interrupted is raised again.
    """
    elsewhere = [entry for entry in entries if entry.state.stage.taken]
    entries = [entry for entry in entries if entry not in elsewhere]
    waiting = [entry for entry in entries if entry.state.stage is not Stage.FINISHED]
    for entry in waiting:
        log = entry.cell.record("log")
        log.parent.mkdir(parents=True, exist_ok=True)
        log.touch()  # `status` finds the cell by it
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
                        stop_if_asked()
                except Interrupted as error:
                    interrupted = error
                    display.say("interrupted: waiting for checkpoints (interrupt again to end without them)")
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
            f"{len(elsewhere)} cell{'s' * (len(elsewhere) > 1)} skipped because another process or job trains"
            f" {'them' if len(elsewhere) > 1 else 'it'}, or may do so"
            f" (`run.py status {first.cell.root}` shows all):"
            f" {first.cell.name} seed={format_seeds(first.cell.seeds)} is {first.state.describe()}"
            + (" ..." if len(elsewhere) > 1 else ""),
            file=sys.stderr,
        )
    if interrupted:
        print("interrupted; the same command resumes (without overwrite=true)", file=sys.stderr)
        raise interrupted
    if display.failed:
        return Exit.FAILED
    if elsewhere:
        return Exit.BAD_INPUT
    return Exit.DIVERGED if display.diverged else Exit.DONE
