"""The cost of a checkpoint with a full replay buffer.

    python bench/checkpoint.py                                               # HC+O, a million transitions
    python bench/checkpoint.py seeds=4 env=R+L2 transitions=2e5 folder=DIR   # DIR: on the disk to be measured

Each seed's buffer has `transitions` transitions. They are synthetic, because only their size matters. Prints for each
number of seeds in lockstep: time and bytes of a checkpoint after `checkpoint_every` steps, and of one that writes the
whole buffer; the time of resuming; the additional memory for writing; and the checkpoint's share of the training time,
estimated from the time of a gradient step.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import torch

from core.config import Config, saved_settings
from core.seed import Best
from core.words import ConfigError, parse_words, whole_numbers
from store.checkpoint import CheckpointFolder
from store.writer import RunWriter
from sweep.cells import make_cells
from sweep.train import make_trainer


def megabytes(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.glob("*/checkpoint/*")) / 1e6


def peak() -> float:
    """The peak memory of this process so far, in megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def timed(action) -> float:
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def measure(config: Config, count: int, folder: Path) -> None:
    seeds = list(range(count))
    folders = [folder / f"seed={seed}" for seed in seeds]
    writers = [RunWriter(path, saved_settings(config, seed), {}, 1) for path, seed in zip(folders, seeds, strict=True)]
    trainer = make_trainer(config, seeds, writers, progress=False)
    trainer.agent.map.use_untrained(trainer.agent.constraint, trainer.obs)
    trainer._begin()
    trainer.replay.rows.uniform_()
    transitions = trainer.replay.capacity
    trainer.replay.added = [transitions] * count
    update = min(timed(lambda: trainer.agent.update(trainer.replay.sample(config.batch_size))) for _ in range(10))
    for i in seeds:
        trainer.seeds[i].best = Best(0.0, 0, trainer.agent.state(i))

    before = peak()
    whole = timed(trainer._checkpoint), megabytes(folder)
    trainer.replay.added = [transitions + config.checkpoint_every] * count
    seconds = timed(trainer._checkpoint)
    written = megabytes(folder) - whole[1]
    training = config.checkpoint_every * update
    print(f"seeds={count}: a gradient step takes {1e3 * update:.1f} ms")
    print(f"  whole buffer: {whole[0]:.2f} s, {whole[1]:.0f} MB")
    print(f"  after {config.checkpoint_every} steps: {seconds:.2f} s, {written:.1f} MB,", end=" ")
    print(f"{100 * seconds / training:.2f} % of the time of as many gradient steps")
    print(f"  memory: {peak() - before:.0f} MB more than the {before:.0f} MB of training")

    newest = []

    def resume() -> None:
        newest.extend(CheckpointFolder(path).read()[0][0] for path in folders)
        trainer.restore(newest)

    print(f"  resuming: {timed(resume):.1f} s", flush=True)


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input."""
    options = {"seeds": "1,10", "env": "HC+O", "transitions": "1e6", "folder": tempfile.gettempdir()}
    try:
        options |= parse_words(arguments, options)
        size = options["transitions"]
        (cell,) = make_cells({"algo": "DPre", "env": options["env"], "buffer_size": size, "steps": size})
        counts = whole_numbers("seeds", options["seeds"])
    except ConfigError as error:
        print(f"bench/checkpoint.py: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    for count in counts:
        with tempfile.TemporaryDirectory(dir=options["folder"]) as folder:
            measure(cell.config, count, Path(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
