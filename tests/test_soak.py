"""A short soak of the feasibility maps; bench/soak.py is the long one."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from constraints import Constraint
from envs import TASKS

SCRIPT = Path(__file__).parents[1] / "bench" / "soak.py"


@pytest.fixture(scope="module")
def script():
    import sys

    path = list(sys.path)
    specification = importlib.util.spec_from_file_location("soak", SCRIPT)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    sys.path[:] = path
    return module


def test_no_infeasible_action_reaches_a_robot(script):
    soaks = script.soak(list(TASKS), steps=3_000, checks=40_000, seed=3, parallel=2, progress=False)
    assert [result.task for result in soaks] == list(TASKS)
    for result in soaks:
        assert result.problems == [] and result.refused > 0
        assert result.executed >= 200 and result.checked >= 3_000
        assert all(-np.inf < largest <= 1e-6 for largest in result.largest.values())


def test_the_soak_finds_a_map_that_is_wrong_by_little(script, monkeypatch, capsys):
    radial_map = Constraint.radial_map

    def wrong(self, obs, action, center=None):
        return radial_map(self, obs, action, center) * torch.where(obs[..., :1] > 1.0, 1.00001, 1.0)

    monkeypatch.setattr(Constraint, "radial_map", wrong)
    assert script.main(["env=R+L2,R+M", "steps=1e3", "checks=2e4"]) == 1
    out = capsys.readouterr().out
    assert "R+L2 radial_map: " in out and "R+M radial_map: " in out and "obs=[" in out and "suggested=[" in out
