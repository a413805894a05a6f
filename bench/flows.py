"""Accuracy of the flows of DFlow and SFlow, and the cost of their training: the tables of docs/flows.md.

    python bench/flows.py                                        # all tasks, both ways: some eight minutes on one core
    python bench/flows.py env=HC+O flow=mle flow_steps=10000 flow_width=256 every=2500
    python bench/flows.py env=R+L2 recipe=published every=250 stop=0.99

Words: `env=` and `flow=` (lists), every other setting of a flow's training, and

    every=N            a row every N steps, from step 0 on; without it, a row at the end only
    stop=SHARE         end a training at the first row with at least this accuracy
    recipe=published   widths, learning rates, softness and steps of FlowPG (flow=mle) and CV-Flow (flow=reverse); the
                       learning rate is constant, and no point is moved to the box's faces

Prints a row at a time: step; CPU seconds of this process on one thread, with random play and samples but without the
measures; accuracy; accuracy on the box's faces; recall (core/flow_training.py, `measure`).
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from torch import Tensor

from core.config import Config
from core.flow import Flow
from core.flow_training import DivergedError, FlowTraining
from core.words import ConfigError, known_name, parse_words, split_names, whole_number
from envs import TASKS
from sweep.cells import make_cells
from sweep.flows import random_play

PUBLISHED = {
    "mle": {"flow_steps": "390600", "mle_softness": "1e-4"},
    "reverse": {"flow_steps": "500000", "reverse_softness": "1e-5"},
}
WIDTH_AND_RATE = {"flow_width": "256", "flow_learning_rate": "1e-5"}
COLUMNS = ("task", "flow", "step", "seconds", "accuracy", "on faces", "recall")


class Published(FlowTraining):
    """The training of FlowPG and CV-Flow, but with this project's initial network and states."""

    def learning_rate(self) -> float:
        return self.flow.flow_learning_rate

    def points(self, count: int) -> Tensor:
        return 2.0 * torch.rand(count, self.constraint.dim, generator=self.generator) - 1.0


def rows(config: Config, recipe: type[FlowTraining], every: int, stop: float) -> Iterator[tuple]:
    """Train the flow of `config` and yield a row of `COLUMNS` every `every` steps (0: at the end only).

    Ends early at the first row whose accuracy is at least `stop`.
    """
    flow, seconds, started = Flow().configured(config), 0.0, time.process_time()
    training = recipe(flow, TASKS[config.env].constraint, random_play(config, lambda: None))
    while True:
        if training.ended or (every and training.step % every == 0):
            seconds += time.process_time() - started
            measures = training.measure()
            shares = (measures[name] for name in ("accuracy", "face_accuracy", "recall"))
            yield config.env, flow.flow, training.step, f"{seconds:.1f}", *(f"{100 * share:.1f} %" for share in shares)
            if training.ended or measures["accuracy"] >= stop:
                return
            started = time.process_time()
        training.advance()


def main(argv: Sequence[str]) -> int:
    if argv and argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    try:
        of_training = [f.name for f in fields(Flow) if not f.metadata.get("of_density")]
        words = parse_words(argv, ("env", "every", "stop", "recipe", *of_training))
        known_name("recipe", words.get("recipe", "published"), ("published",))
        published = "recipe" in words
        every = whole_number("every", words["every"]) if "every" in words else 0
        stop = parse_share(words["stop"]) if "stop" in words else math.inf
        settings = {key: text for key, text in words.items() if key not in ("env", "flow", "every", "stop", "recipe")}
        cells = [
            cell
            for way in split_names("flow", words.get("flow", "reverse,mle"), PUBLISHED)
            for cell in make_cells(
                {"algo": "DFlow", "env": words.get("env", "all"), "flow": way}
                | (PUBLISHED[way] | WIDTH_AND_RATE if published else {})
                | settings
            )
        ]
    except ConfigError as error:
        print(f"bench/flows.py: {error}", file=sys.stderr)
        return 2
    print(" | ".join(COLUMNS))
    for cell in cells:
        try:
            for row in rows(cell.config, Published if published else FlowTraining, every, stop):
                print(" | ".join(map(str, row)), flush=True)
        except DivergedError as error:
            print(f"{cell.config.env} | {cell.config.flow} | {error}", flush=True)
    return 0


def parse_share(text: str) -> float:
    """A number in (0, 1]. Raises ConfigError for anything else."""
    with suppress(ValueError):
        if 0.0 < float(text) <= 1.0:
            return float(text)
    raise ConfigError(f"bad value {text!r} for stop: must be above 0 and at most 1")


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        print("\ninterrupted; the rows above stand", file=sys.stderr)
        sys.exit(130)
