"""Checkpoints: a seed resumes from one exactly as if it had never stopped, however the process ended.

    seed=<n>/checkpoint/
        state-<serial>.pt           the state of the seed at one moment; the newest two are kept
        replay-<start>-<stop>.f32   transitions `start` to `stop` - 1 as rows of float32, written once

A state file is a line with the SHA-256 of the rest, then a `torch.save` of tensors, numbers and text. It is read with
`weights_only`, so nothing in it is executed. It names its replay files, with their checksums. Each file is complete
and on disk before another file names it. Older files are deleted only after that. A crash at any point therefore leaves
a whole checkpoint.

The seeds of a lockstep group share the `moment` of a checkpoint. If all of them resume from one moment, they repeat
every bit. Any other choice changes the shape of the batch, and thus the rounding.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch

from store.files import one_line, replace_file
from store.tensors import load_tensors, save_tensors

Stretch = Callable[[int, int], Sequence[torch.Tensor]]
"""Maps `start` and `stop` to views of one seed's transitions `start` to `stop` - 1, each a row of float32."""

FORMAT = 4
"""The version of a checkpoint's content."""

_DAMAGES = (OSError, ValueError, KeyError, TypeError, RuntimeError, pickle.UnpicklingError)


class FormatError(Exception):
    """A checkpoint is intact, but of another version of this code. The message is one line."""


class ReplayFile(NamedTuple):
    """A stretch of one seed's transitions on disk."""

    name: str
    start: int
    stop: int
    digest: str


@dataclass(frozen=True)
class Checkpoint:
    """The intact checkpoint of one seed.

    `group` has the seeds that trained in lockstep, in order. `step` counts this seed's environment steps, `settings` is
    its configuration. Serial numbers ascend with time.
    """

    path: Path
    serial: int
    moment: str
    group: tuple[int, ...]
    step: int
    settings: dict[str, Any]
    replay_files: tuple[ReplayFile, ...]

    def state(self) -> dict[str, Any]:
        """The state that `CheckpointFolder.write` received."""
        return load_tensors(self.path)["state"]

    def fill(self, stretch: Stretch, oldest: int) -> None:
        """Copy the transitions from number `oldest` on, the first in the buffer, into the views of `stretch`."""
        for name, start, stop, _ in self.replay_files:
            kept = max(start, oldest)
            views = stretch(kept, stop)
            with open(self.path.parent / name, "rb") as file:
                file.seek((kept - start) * views[0].shape[-1] * 4)
                for rows in views:
                    read = torch.empty_like(rows, device="cpu")
                    file.readinto(read.numpy().data.cast("B"))
                    rows.copy_(read)


class CheckpointFolder:
    """The checkpoints of one run, that is, of one seed.

    Call `write` for every seed of the group, then `keep` (or `discard`) for every seed: a crash at any point leaves a
    checkpoint that all seeds share.
    """

    def __init__(self, run_folder: str | Path):
        self.folder = Path(run_folder) / "checkpoint"
        self.serial = 0
        # The replay files of the newest kept state, of the one before it, and of one not yet kept or discarded.
        self.files: list[ReplayFile] = []
        self.previous_files: list[ReplayFile] = []
        self.written: list[ReplayFile] | None = None

    def write(
        self,
        moment: str,
        group: Sequence[int],
        step: int,
        settings: Mapping[str, Any],
        state: Mapping[str, Any],
        stretch: Stretch,
        oldest: int,
        stop: int,
    ) -> None:
        """Write the state and the new transitions of a seed. Its buffer holds the transitions `oldest` to `stop` - 1.

        Raises OSError if that fails.
        """
        self.folder.mkdir(exist_ok=True)
        files = self._write_replay(stretch, oldest, stop)
        content = {"format": FORMAT, "serial": self.serial + 1, "moment": moment, "group": list(group), "step": step}
        content |= {"settings": dict(settings), "replay_files": [list(file) for file in files]}
        save_tensors(self._state_path(self.serial + 1), content | {"state": dict(state)})
        self.written = files

    def keep(self) -> None:
        """Make the written checkpoint the newest one. Of the older ones, keep only the one before it."""
        self.serial, self.files, self.previous_files = self.serial + 1, self.written, self.files
        self.discard()

    def discard(self) -> None:
        """Delete everything but the newest two kept checkpoints."""
        self.written = None
        used = {self._state_path(serial).name for serial in (self.serial, self.serial - 1)}
        used |= {file.name for file in (*self.files, *self.previous_files)}
        for path in self.folder.iterdir():
            if path.name not in used:
                path.unlink()

    def _write_replay(self, stretch: Stretch, oldest: int, stop: int) -> list[ReplayFile]:
        """Write the transitions since the newest checkpoint; return the files that hold `oldest` to `stop` - 1."""
        files = [file for file in self.files if file.stop > oldest]
        start = max(oldest, files[-1].stop if files else 0)
        if start < stop:
            name, digest = f"replay-{start}-{stop}.f32", hashlib.sha256()
            blocks = [rows.cpu().numpy().data.cast("B") for rows in stretch(start, stop)]
            for block in blocks:
                digest.update(block)
            replace_file(self.folder / name, lambda file: file.writelines(blocks))
            files.append(ReplayFile(name, start, stop, digest.hexdigest()))
        return files

    def _state_path(self, serial: int) -> Path:
        return self.folder / f"state-{serial}.pt"

    def read(self) -> tuple[list[Checkpoint], list[str]]:
        """The intact checkpoints, newest first, and a line for each damaged one.

        Raises FormatError if another version of this code wrote one.
        """
        intact, problems = [], []
        digests: dict[str, str] = {}  # of replay files, most of which both checkpoints name
        for path in sorted(self.folder.glob("state-*.pt"), key=_serial_of, reverse=True):
            try:
                content = load_tensors(path)
                if content.get("format") != FORMAT:
                    raise FormatError(
                        f"{path} was written by another version of this code and cannot be resumed: use overwrite=true"
                        " to start again and keep the old run, or leave its seed out of seed="
                    )
                files = tuple(ReplayFile(*file) for file in content["replay_files"])
                for file in files:
                    if file.name not in digests:
                        digests[file.name] = _digest(self.folder / file.name)
                    if digests[file.name] != file.digest:
                        raise ValueError(f"{file.name} has a wrong checksum")
                keys = ("serial", "moment", "step", "settings")
                intact.append(
                    Checkpoint(
                        path=path, group=tuple(content["group"]), replay_files=files, **{k: content[k] for k in keys}
                    )
                )
            except _DAMAGES as error:
                problems.append(f"{path}: damaged checkpoint: {one_line(error)}")
        return intact, problems

    def resume(self, checkpoint: Checkpoint) -> None:
        """Continue from `checkpoint`: delete newer ones, and keep the one before until the next is written."""
        self.serial, self.files, self.previous_files = checkpoint.serial, list(checkpoint.replay_files), []
        for path in self.folder.glob("state-*.pt"):
            if _serial_of(path) > self.serial:
                path.unlink()
        with suppress(*_DAMAGES):
            before = load_tensors(self._state_path(self.serial - 1))
            self.previous_files = [ReplayFile(*file) for file in before["replay_files"]]

    def remove(self) -> None:
        """Delete the folder."""
        if self.folder.is_dir():
            for path in self.folder.iterdir():
                path.unlink()
            self.folder.rmdir()


def saved_step(run_folder: str | Path) -> int:
    """The environment steps in the newest checkpoint of a run, from the names of its files; 0 without one."""
    names = (path.stem for path in Path(run_folder, "checkpoint").glob("replay-*.f32"))
    return max((int(name.rpartition("-")[2]) for name in names), default=0)


def group_checkpoints(
    intact: Mapping[int, Sequence[Checkpoint]], started: Mapping[int, tuple[int, ...]]
) -> tuple[list[dict[int, Checkpoint]], list[int]]:
    """Groups of seeds that resume together, each seed with its checkpoint, and the seeds that start anew.

    `intact` maps each seed to its checkpoints, newest first; `started` maps it to the group that it started in. Picks
    the moment that most seeds have, the newest on a tie, and repeats that for the other seeds. (After a crash between
    two writes, the previous moment is picked.) The beginning is a moment too, if at most one checkpoint followed it.
    """
    moments: dict[Any, dict[int, Checkpoint | None]] = {}
    for seed, checkpoints in intact.items():
        for checkpoint in checkpoints:
            moments.setdefault(checkpoint.moment, {})[seed] = checkpoint
        if not checkpoints or checkpoints[-1].serial == 1:
            moments.setdefault(("beginning", started[seed]), {})[seed] = None

    groups: list[dict[int, Checkpoint]] = []
    fresh: list[int] = []
    remaining = set(intact)
    while remaining:

        def rank(seeds: dict[int, Checkpoint | None]) -> tuple[int, int]:
            return len(seeds.keys() & remaining), max(c.serial if c else 0 for c in seeds.values())  # noqa: B023

        best = max(moments.values(), key=rank)
        taken = {seed: best[seed] for seed in sorted(best.keys() & remaining)}
        if all(taken.values()):
            groups.append(taken)
        else:
            fresh += taken
        remaining -= taken.keys()
    return groups, sorted(fresh)


def _serial_of(path: Path) -> int:
    number = path.stem.removeprefix("state-")
    return int(number) if number.isdecimal() else -1


def _digest(path: Path) -> str:
    digest, block = hashlib.sha256(), bytearray(1 << 20)
    with open(path, "rb") as file:
        while size := file.readinto(block):
            digest.update(memoryview(block)[:size])
    return digest.hexdigest()
