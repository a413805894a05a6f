"""Sets one thread for each test process, because the processes share the cores, and Hypothesis profiles: few examples
by default, `HYPOTHESIS_PROFILE=long` for 1,000 examples of each property."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before PyTorch is imported; child processes inherit it

import pytest
import torch
from helpers import CHECKPOINTED, outcome, train
from hypothesis import settings

from algos import ALGORITHMS, Algorithm
from core import flow_training
from plots import aggregates, figures
from sweep import flows

settings.register_profile("ci", max_examples=40, deadline=None)
settings.register_profile("long", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def denormal_numbers():
    """Restores denormal numbers. Training flushes them to zero in the whole process, but later tests may need them."""
    yield
    torch.set_flush_denormal(False)


@pytest.fixture(scope="session")
def unbroken(tmp_path_factory):
    """The outcome of the cell `CHECKPOINTED` after an uninterrupted training."""
    root = tmp_path_factory.mktemp("unbroken")
    train(root, CHECKPOINTED)
    return outcome(root)


@pytest.fixture
def small_flows(monkeypatch):
    """Flows see few states, and train for 20 steps unless a command sets another number."""
    monkeypatch.setattr(flows, "STATES", 400)
    monkeypatch.setattr(flow_training, "HELD_OUT", 100)
    monkeypatch.setattr(flow_training, "POOL", 500)
    for algorithm in (ALGORITHMS["DFlow"], ALGORITHMS["SFlow"]):
        monkeypatch.setitem(vars(algorithm.map), "flow_steps", 20)
        monkeypatch.setitem(vars(algorithm), "config_class", Algorithm.config_class.func(algorithm))  # it is cached


@pytest.fixture
def drawn(monkeypatch):
    """The figures that plot.py would save, by name."""
    found = {}
    for module in (figures, aggregates):
        monkeypatch.setattr(module, "save", lambda figure, folder, name, formats: found.setdefault(name, figure) and [])
    return found
