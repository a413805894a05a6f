"""Wrong command lines, results folders and constraints: one line that says what is wrong, exit code 2, no traceback.

tests/test_cli.py also tests wrong `key=value` settings.
"""

import json

import pytest
import torch
from helpers import run_command

from constraints import (
    Ball,
    Box,
    HalfSpace,
    Intersection,
    LinearConstraint,
    PlanarEllipse,
    QuadraticConstraint,
    WeightedL1,
    WeightedPositivePart,
)
from envs import TASKS, Task
from envs.reacher import Reacher

WORDS = "steps=20 learning_starts=10 batch_size=4 hidden=8 eval_every=20 eval_episodes=1 final_episodes=1"
VARIANT = "DPre,batch_size=4,eval_episodes=1,eval_every=20,final_episodes=1,hidden=[8],learning_starts=10,steps=20"


def refused(capsys, words):
    """The only line that the refused command `words` prints."""
    capsys.readouterr()
    assert run_command(words.split()) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("run.py: ") and captured.err.count("\n") == 1, captured.err
    return captured.err


@pytest.mark.parametrize(
    "words, said",
    [
        ("algo=DPre env=R+N checkpoint_every=0", "bad value 0 for checkpoint_every: must be at least 1"),
        ("algo=DPre env=R+N checkpoint_every=often", "bad value 'often' for checkpoint_every: expected int"),
        ("algo=DPre env=R+N threads=0", "bad value 0 for threads"),
        ("algo=DPre env=R+N batch_size=0", "bad value 0 for batch_size"),
        ("algo=DPre env=R+N buffer_size=-5", "bad value -5 for buffer_size"),
        ("algo=DPre env=R+N eval_every=0", "bad value 0 for eval_every"),
        ("algo=DPre env=R+N final_episodes=0", "bad value 0 for final_episodes"),
        ("algo=DPre env=R+N learning_starts=-1", "bad value -1 for learning_starts: must not be negative"),
        ("algo=DPre env=R+N learning_rate=inf", "must be finite"),
        ("algo=DPre env=R+N target_noise=-0.1", "bad value -0.1 for target_noise"),
        ("algo=DPre env=R+N policy_delay=0", "bad value 0 for policy_delay"),
        ("algo=DPre env=R+N hidden=8,,8", "bad value '8,,8' for hidden"),
        ("algo=DPre env=R+N seed=1e3", "bad seed '1e3'"),
        ("algo=DPre env=R+N seed=0-99999", "at most 1000 seeds"),
        ("algo=DPre env=R+N seed=1,,2", "bad seed '1,,2'"),
        ("algo=DPre env=R+N threads=1000000", "bad value 1000000 for threads: must be auto or from 1 to 1024"),
        (f"algo=DPre env=R+N jobs=1 seed={','.join(map(str, range(0, 200, 2)))}", "too long for the name of a log"),
        ("algo=NFW env=R+N fw_learning_rate=0", "must be in (0, 1]"),
        ("algo= env=R+N", "expected key=value, got 'algo='"),
        ("algo=DPre,all env=R+n", "did you mean R+N?"),
        ("--steps 5", "expected key=value, got '--steps'"),
        ("algo=DPre env=R+N results", "expected key=value, got 'results'"),
        (
            "algo=DPre env=R+N hidden=[1000000,100000000]",
            "not enough memory for 1 seeds with hidden=[1000000, 100000000]",
        ),
    ],
)
def test_command_lines(capsys, tmp_path, words, said):
    if "results" not in words:
        words += f" results={tmp_path}"
    assert said in refused(capsys, words)


# ---------------------------------------------------------------- results folders


def lock_of_another_host(root):
    path = root / "R+N" / VARIANT / "seed=0.lock"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"pid": 12, "host": "elsewhere"}))


def folder_in_place_of_the_lock(root):
    (root / "R+N" / VARIANT / "seed=0.lock").mkdir(parents=True)


def file_in_place_of_the_task(root):
    (root / "R+N").write_text("")


def file_in_place_of_the_variant(root):
    (root / "R+N").mkdir()
    (root / "R+N" / VARIANT).write_text("")


@pytest.mark.parametrize(
    "prepare, said",
    [
        (lock_of_another_host, "by process 12 on elsewhere; if that process has ended, delete "),
        (folder_in_place_of_the_lock, "is a directory"),
        (file_in_place_of_the_task, "R+N"),
        (file_in_place_of_the_variant, VARIANT),
    ],
)
def test_results_folders(capsys, tmp_path, prepare, said):
    prepare(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert said in refused(capsys, f"algo=DPre env=R+N {WORDS} results={tmp_path}")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("results", ["/dev/null", "/dev/null/below", "/proc/results", "x" * 300])
def test_results_folders_that_cannot_be_written(capsys, monkeypatch, tmp_path, results):
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, f"algo=DPre env=R+N {WORDS} results={results}")
    assert any(reason in line for reason in ("not a directory", "no such file", "file name too long")), line


@pytest.mark.parametrize("name, content", [("result.json", "{"), ("result.json", "{}"), ("failed.json", "[]")])
def test_an_end_that_cannot_be_read_is_not_run_over(capsys, tmp_path, name, content):
    folder = tmp_path / "R+N" / VARIANT / "seed=0"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("algo: DPre\n")
    (folder / name).write_text(content)
    run_command(f"algo=DPre env=R+N {WORDS} results={tmp_path}".split())
    out = capsys.readouterr().out
    assert out.startswith(f"{folder}: already finished, but unreadable ({folder / name}: ") and out.count("\n") == 1
    assert (folder / name).read_text() == content and len(list(folder.iterdir())) == 2


# ---------------------------------------------------------------- constraints


def rows(a, b):
    return LinearConstraint(A=a, b=b, dim=2)


def ones(obs, *shape):
    return torch.ones(*obs.shape[:-1], *shape)


CONSTRAINTS = {
    "weights of another dimension": (
        lambda: WeightedL1(lambda obs: obs[..., :3], 1.0, 2),
        "weight(obs) has shape (1, 3), expected (..., 2) with ... = (1,)",
    ),
    "weights that are NaN": (
        lambda: WeightedL1(lambda obs: obs[..., :2] * torch.nan, 1.0, 2),
        "sample 0: weight(obs) is NaN or infinite",
    ),
    "weights that are no tensor": (lambda: WeightedPositivePart(lambda obs: "x", 1.0, 2), "str"),
    "an index beyond the observation": (
        lambda: HalfSpace(lambda obs: obs[..., [60, 70]], 1.0, 2),
        "index 60 is out of bounds",
    ),
    "a matrix of another dimension": (
        lambda: PlanarEllipse(lambda obs: torch.eye(3), 0.1),
        "matrix(obs) has shape (3, 3), expected (..., 2, 2)",
    ),
    "a matrix that is an upper triangle": (
        lambda: PlanarEllipse(lambda obs: torch.tensor([[1.0, 0.5], [0.0, 1.0]]), 0.1),
        "matrix(obs) is not symmetric",
    ),
    "a bound that is negative": (lambda: Ball(lambda obs: -obs[..., 0].abs() - 1.0, 2), "bound(obs) is not positive"),
    "no rows": (lambda: LinearConstraint(dim=2), "LinearConstraint needs A(obs)"),
    "no bounds": (lambda: LinearConstraint(A=lambda obs: ones(obs, 1, 2), dim=2), "LinearConstraint needs b(obs)"),
    "rows that are NaN": (lambda: rows(lambda o: torch.nan * ones(o, 1, 2), lambda o: ones(o, 1)), "NaN or infinite"),
    "rows of another shape": (lambda: rows(lambda o: torch.ones(3, 5), lambda o: ones(o, 1)), "shape (3, 5), expected"),
    "an empty set": (
        lambda: rows(lambda o: ones(o, 1, 2), lambda o: -5 * ones(o, 1)),
        "sample 0, row 0: the set is empty",
    ),
    "code that fails": (lambda: rows(lambda o: 1 / 0, lambda o: ones(o, 1)), "division by zero"),
    "a quadratic form of another dimension": (
        lambda: QuadraticConstraint(Q=lambda o: torch.eye(3), c=lambda o: 0 * ones(o, 2), bound=1.0, dim=2),
        "Q(obs) has shape (3, 3), expected",
    ),
}


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_constraint_definitions(capsys, tmp_path, monkeypatch, name):
    make, said = CONSTRAINTS[name]
    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, make(), "a task", "a formula", 20))
    line = refused(capsys, f"algo=SRad env=R+X {WORDS} results={tmp_path}")
    assert line.startswith("run.py: the constraint of R+X does not work: ") and said in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: Ball(torch.inf, 2), "got inf"),
        (lambda: Ball(torch.nan, 2), "got nan"),
        (lambda: WeightedL1(lambda obs: obs, torch.nan, 2), "finite, got nan"),
        (lambda: Ball(0.0, 2), "got 0.0"),
        (lambda: WeightedL1(lambda obs: obs, 0.0, 2), "bound must be positive"),
        (lambda: HalfSpace(lambda obs: obs, -1.0, 2), "bound must be positive"),
        (lambda: PlanarEllipse(lambda obs: obs, -0.1), "bound must be positive"),
        (lambda: Box(0), "dim must be at least 1, got 0"),
        (lambda: Intersection(), "at least one constraint"),
        (lambda: Intersection(Box(2), Box(3)), "different dimensions: [2, 3]"),
    ],
)
def test_constraints_that_cannot_be_made(make, said):
    with pytest.raises(ValueError) as error:
        make()
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_constraint_that_breaks_down_later_says_where(capsys, tmp_path, monkeypatch):
    def bound(obs):  # empty once the arm moves; at the start, the arm rests
        return torch.where(obs[..., 6:7].abs() > 0.05, -5.0, 1.0)

    monkeypatch.setitem(TASKS, "R+X", Task(Reacher, rows(lambda o: ones(o, 1, 2), bound), "a task", "a formula", 20))
    assert run_command(f"algo=DPre env=R+X {WORDS} results={tmp_path}".split()) == 3
    assert "failed at step" in (line := capsys.readouterr().err.splitlines()[-1])
    assert "the set is empty, at observation [" in line
    assert not list(tmp_path.rglob("*.lock"))
