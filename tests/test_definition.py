"""A run belongs to the definition of its task and algorithm that it was trained on, not to their names."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import CHECKPOINTED, Breaks, run_command, train

import plot
from algos import ALGORITHMS, Algorithm
from algos.td3 import TD3
from constraints import Ball, Box, Intersection, LinearConstraint, WeightedL1
from core.maps import Project
from envs import TASKS, Task
from envs.reacher import Reacher
from store.definition import describe, differences, is_own
from sweep.definition import define

ROOT = Path(__file__).parents[1]
WORDS = CHECKPOINTED.replace("env=R+N", "env=R+X")
SCALE = 2.0


def task(constraint, robot=Reacher):
    return Task(robot, constraint, "a task", "a formula", 20)


def scaled(factor):
    return lambda obs: obs[..., 6:9:2] * factor


def times(obs, factor):
    return obs[..., 6:9:2] * factor


def uses_a_global(obs):
    return times(obs, SCALE)


class Rows(LinearConstraint):
    def __init__(self, table):
        super().__init__(2)
        self._table = table

    def A(self, obs):
        return self._table.expand(*obs.shape[:-1], 2, 2)

    def b(self, obs):
        return torch.ones_like(obs[..., :2])


class Weights:
    def __init__(self, factor):
        self.factor = factor

    def __call__(self, obs):
        return times(obs, self.factor)

    def method(self, obs):
        return times(obs, self.factor)


class Slow(Reacher):
    max_episode_steps = 10


def network(weight):
    layer = torch.nn.Linear(2, 1, bias=False)
    torch.nn.init.constant_(layer.weight, weight)
    return layer


def l1(weight):
    return WeightedL1(weight, 0.3, 2)


def other_project():
    class Project2(Project):
        pull = 2

    return Project2()


@pytest.mark.parametrize(
    "before, now, said",
    [
        (Ball(0.05, 2), Ball(0.9, 2), "the value's bound: 0.05 then, 0.9 now"),
        (Ball(0.05, 2), Box(2), "the value: Ball then, Box now"),
        (l1(scaled(2.0)), l1(scaled(3.0)), "the value's weight.factor: 2.0 then, 3.0 now"),
        (
            l1(lambda obs: obs[..., :2]),
            l1(lambda obs: obs[..., 1:3]),
            "the value's weight: lambda obs: obs[..., :2] then, lambda obs: obs[..., 1:3] now",
        ),
        (
            l1(functools.partial(times, factor=2.0)),
            l1(functools.partial(times, factor=3.0)),
            "the value's weight.keywords[factor]: 2.0 then, 3.0 now",
        ),
        (l1(Weights(2.0)), l1(Weights(3.0)), "the value's weight.factor: 2.0 then, 3.0 now"),
        (l1(Weights(2.0).method), l1(Weights(3.0).method), "the value's weight.self.factor: 2.0 then, 3.0 now"),
        (
            Intersection(Box(2), Intersection(Ball(0.1, 2), Box(2))),
            Intersection(Box(2), Intersection(Ball(0.2, 2), Box(2))),
            "the value's constraints[1].constraints[0].bound: 0.1 then, 0.2 now",
        ),
        (
            Rows(torch.eye(2)),
            Rows(2 * torch.eye(2)),
            "the value's _table: [[1.0, 0.0], [0.0, 1.0]] then, [[2.0, 0.0], [0.0, 2.0]] now",
        ),
        (Rows(torch.zeros(2, 50)), Rows(torch.zeros(2, 50).index_fill(1, torch.tensor(7), 1.0)), "checksum"),
        (Rows(np.zeros(2)), Rows(np.ones(2)), "[0.0, 0.0] then, [1.0, 1.0] now"),
        (Project(), other_project(), "the value: Project then, other_project.<locals>.Project2 now"),
        (network(1.0), network(2.0), "the value's weight: [[1.0, 1.0]] then, [[2.0, 2.0]] now"),
        ({"a": 1, "b": (2, 3)}, {"a": 1, "b": (2, 4)}, "the value[b]: 2, 3 then, 2, 4 now"),
    ],
)
def test_what_differs_is_said(before, now, said):
    assert said in differences(describe({"value": before}), describe({"value": now}))
    assert differences(describe({"value": before}), describe({"value": before})) == ""


def test_a_definition_does_not_depend_on_what_was_done_with_it():
    values = [*(TASKS[name].constraint for name in ("R+M", "R+T", "H+O+S")), Rows(torch.eye(2)), l1(scaled(2.0))]
    values.append(Intersection(Ball(0.5, 2), Rows(torch.eye(2))))
    for value in values:
        before = describe({"value": value})
        obs = torch.randn(4, 17)
        for method in (value.project, value.linear_oracle, value.violation, value.alpha_map):
            method(obs, torch.randn(4, value.dim))
        assert differences(before, describe({"value": value})) == ""


def test_globals_count(monkeypatch):
    before = describe({"value": uses_a_global})
    assert differences(before, describe({"value": uses_a_global})) == ""
    monkeypatch.setitem(globals(), "SCALE", 3.0)
    assert differences(before, describe({"value": uses_a_global})) == "the value's SCALE: 2.0 then, 3.0 now"


def test_a_function_that_a_function_calls_counts(monkeypatch):
    def times(obs, factor):
        return obs[..., 6:9:2] / factor

    before = describe({"value": uses_a_global})
    monkeypatch.setitem(globals(), "times", times)
    said = differences(before, describe({"value": uses_a_global}))
    assert said == ("the value's times: return obs[..., 6:9:2] * factor then, return obs[..., 6:9:2] / factor now")


def test_comments_and_blank_lines_do_not_count(tmp_path):
    codes = ["def f(x):\n    return x\n", "def f(x):  # the identity\n\n    # as it says\n    return x  # x\n"]
    found = []
    for i, code in enumerate(codes):
        path = tmp_path / f"m{i}.py"
        path.write_text(code)
        namespace = {"__name__": "nowhere"}
        exec(compile(code, str(path), "exec"), namespace)
        found.append(describe({"value": namespace["f"]})["value"])
    assert found[0] == found[1] == "def f(x):\n    return x"


def test_the_papers_tasks_and_algorithms_are_the_projects_own():
    for name in ("R+N", "R+T", "HC+MA", "W+O+S"):
        for algo in ALGORITHMS:
            assert all(map(is_own, define(name, algo).values()))
    assert not is_own(describe({"value": l1(scaled(1.0))})) and not is_own(describe({"value": Slow}))
    assert "constraint.l1.bound" in define("W+O+S", "DPre")["task"]


PROGRAM = """
import json, sys, torch
import numpy as np
from constraints import LinearConstraint, WeightedL1
from store.definition import describe

LIMITS = {"b": 2.0, "a": [1, 2, 3], 3: {"x", "y", "z"}}

def weight(obs):
    return obs[..., 6:9:2] * LIMITS["b"] * max(x for x in LIMITS["a"])

class Barrier(LinearConstraint):
    table = np.arange(40.0)
    def A(self, obs):
        return torch.diag_embed(weight(obs))
    def b(self, obs):
        return torch.ones_like(obs[..., :2])

FOUND = describe({"one": Barrier(2), "two": WeightedL1(weight, 0.5, 2),
                  "three": WeightedL1(lambda o: o[..., :2], 1.0, 2)})
if __name__ == "__main__":
    print(json.dumps(FOUND))
"""


def test_a_description_is_the_same_in_every_process(tmp_path):
    (tmp_path / "barrier.py").write_text(PROGRAM)
    commands = [["barrier.py"], ["-c", "import json, barrier; print(json.dumps(barrier.FOUND))"]]
    found = []
    for hashing in ("1", "2"):
        for command in commands:
            environment = {"PYTHONPATH": f"{ROOT}:.", "PYTHONHASHSEED": hashing, "PATH": "/usr/bin"}
            done = subprocess.run(
                [sys.executable, *command], cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=120
            )
            assert done.returncode == 0, done.stderr
            found.append(json.loads(done.stdout))
    assert all(other == found[0] for other in found) and "0x" not in json.dumps(found[0])
    assert "class Barrier" in found[0] and found[0]["one.dim"] == "2"


@pytest.fixture
def define_task():
    """Gives the task R+X a constraint, and a robot where it is not Reacher."""

    def give(*args):
        TASKS.pop("R+X", None)
        TASKS["R+X"] = task(*args)

    yield give
    TASKS.pop("R+X", None)


def command(root, *more, words=WORDS):
    return [*words.split(), f"results={root}", *more]


@pytest.mark.parametrize("more", [[], ["jobs=1"]])
def test_a_finished_run_of_another_definition_is_not_taken_for_this_one(tmp_path, capsys, define_task, more):
    define_task(Ball(0.05, 2))
    assert run_command(command(tmp_path)) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.json")}
    define_task(Ball(0.9, 2))
    capsys.readouterr()
    assert run_command(command(tmp_path, *more)) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "the constraint's bound: 0.05 then, 0.9 now; overwrite=true" in err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} == before
    if not more:
        assert run_command(command(tmp_path, "overwrite=true")) == 0
        assert run_command(command(tmp_path)) == 0 and "already finished" in capsys.readouterr().out
        define_task(Ball(0.9, 2), Slow)
        assert run_command(command(tmp_path)) == 2
        assert "the robot: Reacher then, Slow now" in capsys.readouterr().err


def test_a_run_does_not_resume_under_another_definition(tmp_path, capsys, define_task):
    define_task(Ball(0.05, 2))
    with pytest.raises(ZeroDivisionError):
        train(tmp_path, WORDS, Breaks(77, error=ZeroDivisionError()))
    define_task(Ball(0.9, 2))
    assert run_command(command(tmp_path)) == 2
    assert "the constraint's bound: 0.05 then, 0.9 now" in capsys.readouterr().err
    define_task(Ball(0.05, 2))
    assert run_command(command(tmp_path)) == 0
    assert capsys.readouterr().out.count("resuming from step") == 2


@pytest.fixture
def name_algorithm():
    """Gives the name DMine to an agent."""

    def give(agent):
        ALGORITHMS.pop("DMine", None)
        ALGORITHMS["DMine"] = Algorithm(agent, Project(), "environment")

    yield give
    ALGORITHMS.pop("DMine", None)


def test_an_algorithm_of_ones_own_has_a_definition_too(tmp_path, capsys, name_algorithm):
    class Mine(TD3):
        family = "TD3"

    words = [*CHECKPOINTED.replace("algo=DPre", "algo=DMine").split(), f"results={tmp_path}"]
    name_algorithm(Mine)
    assert run_command(words) == 0
    name_algorithm(TD3)
    assert run_command(words) == 2
    assert "another definition of its algorithm: the agent" in capsys.readouterr().err


def test_runs_without_a_definition(tmp_path, capsys, define_task):
    """Runs of the project's own tasks are older than definitions; of others, nobody knows what they were trained on."""
    define_task(Ball(0.05, 2))
    assert run_command(command(tmp_path)) == 0
    for path in tmp_path.rglob("definition.json"):
        path.unlink()
    assert run_command(command(tmp_path)) == 0 and "already finished" in capsys.readouterr().out
    define_task(l1(scaled(1.0)))
    assert run_command(command(tmp_path)) == 2
    assert "does not tell on which definition" in capsys.readouterr().err


def test_plots_keep_runs_of_two_definitions_apart(tmp_path, capsys, define_task):
    for seed, bound in (("1", 0.05), ("2", 0.9)):
        define_task(Ball(bound, 2))
        assert run_command(command(tmp_path, words=WORDS.replace("seed=3,5", f"seed={seed}"))) == 0
    capsys.readouterr()
    assert plot.main([str(tmp_path), "format=csv"]) == 0
    captured = capsys.readouterr()
    assert "note: R+X has two definitions: the constraint's bound: 0.05 then, 0.9 now" in captured.err
    rewards = (tmp_path / "tables" / "rewards.csv").read_text()
    assert rewards.count("task_definition=") == 2
