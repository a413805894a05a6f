"""A run belongs to the definition of its task and algorithm that it was trained on, not to their names."""

import enum
import functools
import json
import math
import operator
import re
import subprocess
import sys
import types
from collections import deque
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import pytest
import torch
from helpers import CHECKPOINTED, Breaks, run_command, train

import envs
import plot
from algos import ALGORITHMS, Algorithm
from algos.td3 import TD3
from constraints import (
    Ball,
    Box,
    DiagonalEllipse,
    HalfSpace,
    Intersection,
    InUnits,
    LinearConstraint,
    PlanarEllipse,
    QuadraticConstraint,
    WeightedL1,
)
from core.maps import Project
from envs import TASKS, Task
from envs.reacher import Reacher
from store.definition import describe, differences, is_own
from store.origin import is_user, user_files
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


def test_a_definition_does_not_depend_on_what_was_printed():
    space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    before = describe({"value": space})
    assert str(space) and differences(before, describe({"value": space})) == ""


def test_globals_count(monkeypatch):
    before = describe({"value": uses_a_global})
    assert differences(before, describe({"value": uses_a_global})) == ""
    monkeypatch.setitem(globals(), "SCALE", 3.0)
    assert differences(before, describe({"value": uses_a_global})) == "the value's SCALE: 2.0 then, 3.0 now"


MODE = enum.Enum("Mode", {"TIGHT": 0.1})


@pytest.mark.parametrize(
    "before, now",
    [
        (2, 3),  # small numbers and texts are the same objects in the project's modules
        ("task", "algorithm"),
        (slice(6, 9, 2), slice(0, 3)),
        (np.s_[..., 6:9:2], np.s_[..., :2]),
        ({(0, 1)}, {(0, 2)}),
        ({(0, 1): 1.0, (1, 2): 2.0}, {(0, 1): 5.0, (1, 2): 2.0}),
        ({1: "a", "1": "b"}, {1: "c", "1": "b"}),
        (deque([1]), deque([2])),
        (Fraction(1, 2), Fraction(1, 3)),
        (np.sin, np.cos),
        (math.sin, math.cos),
        (torch.nn.functional.relu, torch.nn.functional.silu),
        (operator.itemgetter(1), operator.itemgetter(2)),
        (torch.float32, torch.float64),
        (torch.ones(2).mul, torch.zeros(2).mul),
        (types.SimpleNamespace(rows=[1]), types.SimpleNamespace(rows=[2])),
        (np.poly1d([1, 2]), np.poly1d([1, 3])),
        (torch.distributions.Normal(0.0, 1.0), torch.distributions.Normal(0.0, 2.0)),
        (torch.nn.Sequential(torch.nn.ReLU()), torch.nn.Sequential(torch.nn.Tanh())),
        (np.array([None] * 20 + [1]), np.array([None] * 20 + [2])),
        (re.compile("a"), re.compile("a", re.DOTALL)),
        (MODE.TIGHT, enum.Enum("Mode", {"TIGHT": 0.2}).TIGHT),
    ],
)
def test_any_value_counts(before, now, monkeypatch):
    monkeypatch.setitem(globals(), "SCALE", before)
    one = describe({"value": uses_a_global})
    assert differences(one, describe({"value": uses_a_global})) == ""
    other = describe({"value": now})
    monkeypatch.setitem(globals(), "SCALE", now)
    assert "value's SCALE" in differences(one, describe({"value": uses_a_global}))
    assert differences(describe({"value": before}), other)


def test_each_argument_of_a_constraint_counts():
    def eye(obs):
        return torch.eye(2).expand(*obs.shape[:-1], 2, 2)

    one, two = scaled(1.0), scaled(2.0)
    cases = [
        (Ball, {"bound": 0.5, "dim": 2}, {"bound": one}),
        (HalfSpace, {"normal": one, "bound": 1.0, "dim": 2}, {"normal": two, "bound": 2.0}),
        (PlanarEllipse, {"matrix": eye, "bound": 1.0}, {"matrix": lambda obs: 2 * eye(obs), "bound": 2.0}),
        (DiagonalEllipse, {"scale": one, "bound": 1.0, "dim": 2}, {"scale": two, "bound": one}),
        (LinearConstraint, {"dim": 2, "A": eye, "b": one}, {"A": one, "b": two, "on_empty": "least"}),
        (QuadraticConstraint, {"dim": 2, "Q": eye, "bound": 1.0}, {"Q": one, "bound": 2.0, "c": one}),
        (InUnits, {"constraint": Ball(0.5, 2), "low": [-1, -1], "high": [1, 1]}, {"low": [-2, -1], "high": [1, 2]}),
    ]
    for kind, arguments, others in cases:
        before = describe({"value": kind(**arguments)})
        for name, value in others.items():
            assert differences(before, describe({"value": kind(**arguments | {name: value})})), (kind, name)


def test_lambdas_in_one_line_are_told_apart():
    one, two = lambda obs: obs + SCALE, lambda obs: obs - SCALE
    assert describe({"value": one})["value"] == "lambda obs: obs + SCALE"
    assert describe({"value": two})["value"] == "lambda obs: obs - SCALE"


def test_what_a_decorator_adds_counts():
    def decorated(factor):
        def decorate(function):
            @functools.wraps(function)
            def inner(obs):
                return function(obs) * factor

            return inner

        return decorate(uses_a_global)

    said = differences(describe({"value": decorated(2.0)}), describe({"value": decorated(3.0)}))
    assert said == "the value's factor: 2.0 then, 3.0 now"


class Computed:
    @functools.cached_property
    def weight(self):
        return SCALE

    @property
    def half(self):
        return SCALE / 2

    def __call__(self, obs):
        return times(obs, self.weight)


def test_what_properties_use_counts_and_what_they_keep_does_not(monkeypatch):
    value = Computed()
    before = describe({"value": value})
    value(torch.zeros(9))
    assert differences(before, describe({"value": value})) == ""
    monkeypatch.setitem(globals(), "SCALE", 3.0)
    assert "SCALE in class Computed: 2.0 then, 3.0 now" in differences(before, describe({"value": value}))


def test_modules_count_wherever_they_are_imported(tmp_path, monkeypatch):
    """Modules imported in the call or outside the function, and modules that import each other."""
    (tmp_path / "own_rows").mkdir()
    (tmp_path / "own_rows" / "__init__.py").write_text("from own_rows import table\nBOUND = 1.0\n")
    (tmp_path / "own_rows" / "table.py").write_text("import own_rows\nROWS = 1\n")
    (tmp_path / "own_late.py").write_text("ROWS = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    import own_rows

    def late(obs):
        import own_late

        return obs * own_late.ROWS

    def around(obs):
        return obs * own_rows.table.ROWS * own_rows.table.own_rows.BOUND

    before = {function: describe({"value": function}) for function in (late, around)}
    sys.modules["own_late"].ROWS = own_rows.table.ROWS = 2
    for function, description in before.items():
        assert "ROWS: 1 then, 2 now" in differences(description, describe({"value": function}))


def test_a_function_that_a_function_calls_counts(monkeypatch):
    def times(obs, factor):
        return obs[..., 6:9:2] / factor

    before = describe({"value": uses_a_global})
    monkeypatch.setitem(globals(), "times", times)
    said = differences(before, describe({"value": uses_a_global}))
    assert said == ("the value's times: return obs[..., 6:9:2] * factor then, return obs[..., 6:9:2] / factor now")


def test_comments_and_blank_lines_do_not_count(tmp_path):
    codes = [
        "def f(x):\n    return x\n",
        "def f(x):  # the identity\n\n    # as it says\n    return x  # x\n",
        'def f(x):\n    """The identity.\n\n    # It is."""\n\n    return x\n',
    ]
    found = []
    for i, code in enumerate(codes):
        path = tmp_path / f"m{i}.py"
        path.write_text(code)
        namespace = {"__name__": "nowhere"}
        exec(compile(code, str(path), "exec"), namespace)
        found.append(describe({"value": namespace["f"]})["value"])
    assert found[0] == found[1] == found[2] == "def f(x):\n    return x"


def test_the_papers_tasks_and_algorithms_are_the_projects_own():
    for name in ("R+N", "R+T", "HC+MA", "W+O+S"):
        for algo in ALGORITHMS:
            assert all(map(is_own, define(name, algo).values()))
    assert not is_own(describe({"value": l1(scaled(1.0))})) and not is_own(describe({"value": Slow}))
    assert "constraint.l1.bound" in define("W+O+S", "DPre")["task"]


PROGRAM = """
import json, logging, sys, torch
import numpy as np
from constraints import LinearConstraint, WeightedL1
from store.definition import describe

LIMITS = {"b": 2.0, "a": [1, 2, 3], 3: {"x", "y", "z"}}

log = logging.getLogger(__name__)

def weight(obs):
    log.debug("weight of %s in %s", obs, __file__)
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


class Side(enum.IntEnum):
    LEFT = 1


@dataclass
class Scaled:
    factor: float = 2.0

    def __call__(self, obs):
        return times(obs, self.factor * Side.LEFT)


class Pair(NamedTuple):
    low: float


def test_what_python_adds_to_a_class_does_not_count(tmp_path):
    """Each version of Python adds something else."""
    found = describe({"value": Scaled(), "pair": Pair})
    assert {key for key in found if "class" in key} == {
        "class Scaled", "class Scaled.factor", "class Scaled.__call__", "class Side", "class Side.LEFT",
        "class Side.LEFT.value", "class Pair", "class Pair.low", "class Pair.low.arguments",
    } | {key for key in found if key.startswith("class Scaled.__call__.")}  # fmt: skip


def test_the_folder_of_a_file_does_not_count(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    one, two = ({"value": [tmp_path / name, str(tmp_path / name)]} for name in "ab")
    assert differences(describe(one), describe(two)) == ""


def test_a_program_without_a_file(tmp_path):
    """Code from a pipe has no source file. It still counts, but the order of a set does not."""
    program = """
import json
from constraints import WeightedL1
from store.definition import describe
mode = "a"
print(json.dumps(describe({"value": WeightedL1(lambda obs: obs + (mode in {"a", "b", "c", "d"}), 0.5, 2)})))
"""
    found = []
    for seed, text in (("1", program), ("2", program), ("2", program.replace("obs +", "obs -"))):
        environment = {"PYTHONPATH": f"{ROOT}", "PYTHONHASHSEED": seed, "PATH": "/usr/bin"}
        done = subprocess.run(
            [sys.executable, "-"],
            input=text,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            env=environment,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout))
    assert found[0] == found[1] != found[2]


def test_libraries_outside_of_the_environment_are_libraries(tmp_path, monkeypatch):
    """For example on clusters, whose modules put their own package folders into PYTHONPATH."""
    folder = tmp_path / "apps" / "site-packages"
    folder.mkdir(parents=True)
    (folder / "far_library.py").write_text("def f(x):\n    return x\n")
    monkeypatch.syspath_prepend(folder)
    import far_library

    assert is_own(describe({"value": far_library.f}))


def test_libraries_in_a_folder_of_their_own_are_libraries_and_what_lies_beside_them_is_not(tmp_path, monkeypatch):
    """As `pip install --target` leaves them."""
    about = tmp_path / "aimed_library-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: aimed-library\nVersion: 1.0\n")
    (about / "RECORD").write_text("aimed_library/__init__.py,,\naimed_library-1.0.dist-info/METADATA,,\n")
    (tmp_path / "aimed_library").mkdir()
    (tmp_path / "aimed_library" / "__init__.py").write_text("def f(x):\n    return x\n")
    (tmp_path / "lying_beside.py").write_text("def f(x):\n    return x\n")
    monkeypatch.syspath_prepend(tmp_path)
    import aimed_library
    import lying_beside

    assert not is_user(aimed_library.f) and is_user(lying_beside.f)
    assert [file.name for file in user_files() if file.is_relative_to(tmp_path)] == ["lying_beside.py"]


@pytest.fixture
def define_task():
    """A function that gives the task R+X a constraint and, unless it is Reacher, a robot."""

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
    assert err.count("\n") == 1 and "the constraint's bound: 0.05 then, 0.9 now" in err
    assert "(the same holds for 1 more); overwrite=changed starts such runs again" in err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.json")} == before
    if not more:
        assert run_command(command(tmp_path, "overwrite=true")) == 0
        assert run_command(command(tmp_path)) == 0 and "already finished" in capsys.readouterr().out
        define_task(Ball(0.9, 2), Slow)
        assert run_command(command(tmp_path)) == 2
        assert "the robot: Reacher then, Slow now" in capsys.readouterr().err


CALLS = []


def counts_its_calls(obs):
    CALLS.append(1)
    return times(obs, SCALE)


def test_what_a_function_remembers_is_not_part_of_a_later_cell(tmp_path, capsys, define_task):
    CALLS.clear()
    define_task(l1(counts_its_calls))
    both = command(tmp_path, words=WORDS.replace("algo=DPre", "algo=DPre,DOpt"))
    assert run_command(both) == 0 and CALLS
    CALLS.clear()  # as in another process
    capsys.readouterr()
    assert run_command(command(tmp_path, words=WORDS.replace("algo=DPre", "algo=DOpt"))) == 0
    assert "already finished" in capsys.readouterr().out


def test_an_environment_of_ones_own_counts_for_gymnasium_robot(tmp_path):
    def environment(power):
        class Environment(gymnasium.Env):
            observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
            action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
            power_of_reward = power

        return Environment

    found = []
    try:
        for power, settings in ((1, {}), (2, {}), (2, {"slow": True})):
            gymnasium.registry.pop("Own-v0", None)
            gymnasium.register("Own-v0", entry_point=environment(power), max_episode_steps=5, kwargs=settings)
            robot = type("Own", (Reacher,), {"identifier": "Own-v0"})
            TASKS["R+X"] = task(Ball(0.5, 2), robot)
            found.append(define("R+X", "DPre")["task"])
            del TASKS["R+X"]
    finally:
        gymnasium.registry.pop("Own-v0", None)
        TASKS.pop("R+X", None)
    assert "1 then, 2 now" in differences(found[0], found[1])
    assert "slow" in differences(found[1], found[2])


def test_a_librarys_gymnasium_environment_is_its_name(define_task):
    define_task(Ball(0.05, 1), envs.GymnasiumRobot("Pendulum-v1"))
    task = define("R+X", "DPre")["task"]
    assert is_own(task) and task["robot.identifier"] == "Pendulum-v1" and task["robot.environment"] == "PendulumEnv"


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
    """A function that registers an agent under the name DMine."""

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
    """Such runs of the project's own tasks are older than definitions; for others, the definition is unknown."""
    define_task(Ball(0.05, 2))
    assert run_command(command(tmp_path)) == 0
    for path in tmp_path.rglob("definition.json"):
        path.unlink()
    assert run_command(command(tmp_path)) == 0 and "already finished" in capsys.readouterr().out
    define_task(l1(scaled(1.0)))
    assert run_command(command(tmp_path)) == 2
    assert "has no readable definition.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    "content, said",
    [
        ('{"task": {"constraint": 3}, "algorithm": {}}', "another definition of its task"),
        ("[]", "no readable definition.json"),
        ('{"task": []}', "no readable definition.json"),
    ],
)
def test_a_damaged_definition_is_no_traceback(tmp_path, capsys, define_task, content, said):
    define_task(l1(scaled(1.0)))
    assert run_command(command(tmp_path)) == 0
    for path in tmp_path.rglob("definition.json"):
        path.write_text(content)
    assert run_command(command(tmp_path)) == 2
    assert said in capsys.readouterr().err
    assert plot.main([str(tmp_path), "format=csv"]) == 0


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
