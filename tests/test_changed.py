"""Continuing after a definition has changed: `overwrite=changed`, and the messages that recommend it."""

import fcntl
import json
import os
import pty
import shutil
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from helpers import CHECKPOINTED, Breaks, cells_of, refused_by_plot, run_command, train

import plot
from algos import load_policy
from constraints import Ball
from core.words import ConfigError
from envs import TASKS, Task
from envs.reacher import Reacher
from store.folder import find_runs, has_ended, read_definition
from store.interrupt import Interrupted
from sweep.plan import make_plan
from sweep.states import Stage
from sweep.train import train_cells

ROOT = Path(__file__).parents[1]
TWO_CELLS = CHECKPOINTED.replace("algo=DPre env=R+N", "algo=DPre,DRad env=R+X,R+L2")


@pytest.fixture
def set_bound():
    """A function that sets the bound of the task R+X."""

    def give(bound):
        TASKS.pop("R+X", None)
        TASKS["R+X"] = Task(Reacher, Ball(bound, 2), "a task", "a formula", 60)

    yield give
    TASKS.pop("R+X", None)


def bound_of(folder):
    return read_definition(folder)["task"]["constraint.bound"]


def runs_of(root, task="R+X"):
    return [folder for folder in find_runs(root) if folder.parent.parent.name == task]


def old_folders(root):
    return sorted(root.glob("*/*/*.old-*"))


def test_an_interrupted_sweep_that_starts_changed_cells_again_resumes(tmp_path, set_bound, capsys):
    words = f"{TWO_CELLS} results={tmp_path}"
    set_bound(0.05)
    train_cells(cells_of(words))
    others = {folder: (folder / "result.json").stat().st_mtime_ns for folder in runs_of(tmp_path, "R+L2")}
    set_bound(0.9)
    capsys.readouterr()
    assert run_command(words.split()) == 2
    assert "overwrite=changed" in capsys.readouterr().err
    again = f"{words} overwrite=changed"
    with pytest.raises(Interrupted):
        train_cells(cells_of(again), Breaks(15))
    assert len(old_folders(tmp_path)) == 2  # the seeds of the first cell
    assert sorted(map(bound_of, runs_of(tmp_path))) == ["0.05", "0.05", "0.9", "0.9"]
    assert run_command([*words.split(), "jobs=1"]) == 2  # the other cell still has the old definition
    capsys.readouterr()

    train_cells(cells_of(again))
    assert capsys.readouterr().out.count("resuming from step") == 2
    assert len(old_folders(tmp_path)) == 4 and set(map(bound_of, old_folders(tmp_path))) == {"0.05"}
    assert set(map(bound_of, runs_of(tmp_path))) == {"0.9"} and all(map(has_ended, runs_of(tmp_path)))
    assert {folder: (folder / "result.json").stat().st_mtime_ns for folder in others} == others
    train_cells(cells_of(again))  # nothing is left to do
    assert len(old_folders(tmp_path)) == 4
    assert run_command(words.split()) == 0


def test_a_seed_of_the_present_definition_is_kept(tmp_path, set_bound, capsys):
    set_bound(0.05)
    words = CHECKPOINTED.replace("R+N", "R+X")
    train(tmp_path, words.replace("seed=3,5", "seed=3"))
    set_bound(0.9)
    train(tmp_path, words.replace("seed=3,5", "seed=5"))
    capsys.readouterr()
    train(tmp_path, f"{words} overwrite=changed")
    assert capsys.readouterr().out.count("already finished") == 1
    (old,) = old_folders(tmp_path)
    assert old.name == "seed=3.old-1" and set(map(bound_of, runs_of(tmp_path))) == {"0.9"}


def test_the_plan_of_a_sweep_starts_changed_cells_again(tmp_path, set_bound, capsys):
    words = f"{TWO_CELLS} results={tmp_path}"
    set_bound(0.05)
    train_cells(cells_of(words))
    set_bound(0.9)
    assert run_command([*words.split(), "jobs=2"]) == 2
    assert "(the same holds for 3 more); overwrite=changed" in capsys.readouterr().err
    stages = {(e.cell.task, e.state.stage) for e in make_plan(cells_of(f"{words} overwrite=changed"), {})}
    assert stages == {("R+X", Stage.NEW), ("R+L2", Stage.FINISHED)}
    assert run_command([*words.split(), "jobs=2", "overwrite=changed", "dry=true"]) == 0
    assert "4 cells: 2 new, 2 finished" in capsys.readouterr().out
    for cell in cells_of(f"{words} overwrite=changed"):
        assert "overwrite=changed" in cell.words


def test_the_older_definition_is_the_one_of_then(tmp_path, set_bound, capsys):
    words = CHECKPOINTED.replace("R+N", "R+X")
    for seed, bound, started in ((3, 0.9, "2025-02-01"), (5, 0.05, "2025-01-01")):
        set_bound(bound)
        train(tmp_path, words.replace("seed=3,5", f"seed={seed}"))
        (folder,) = tmp_path.glob(f"*/*/seed={seed}")
        info = json.loads((folder / "info.json").read_text())
        (folder / "info.json").write_text(json.dumps(info | {"started": started}))
    assert plot.main([str(tmp_path), "format=csv"]) == 0
    (note,) = [line for line in capsys.readouterr().err.splitlines() if "two definitions" in line]
    assert "bound: 0.05 then, 0.9 now" in note
    assert note.index("then") < note.index("seed=5") < note.index("seed=3")


PLUGIN = """from constraints import Ball
from envs import TASKS, Task
from envs.reacher import Reacher

TASKS["R+Heat"] = Task(Reacher, Ball(0.5, 2), "a task", "a formula", 40)
"""


def test_a_run_of_a_plugin_names_it_where_it_is_missing(tmp_path, capsys):
    plugin, root = tmp_path / "heat.py", tmp_path / "results"
    plugin.write_text(PLUGIN)
    words = CHECKPOINTED.replace("R+N", "R+Heat").replace("3,5", "3")
    command = [sys.executable, "run.py", f"plugin={plugin}", *words.split(), f"results={root}"]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (folder,) = find_runs(root)
    way = "; its run used heat.py: add plugin=heat.py"
    assert run_command(["play", str(folder)]) == 2
    err = capsys.readouterr().err
    assert "unknown task 'R+Heat'" in err and err.endswith(f"{way}\n") and err.count("\n") == 1
    with pytest.raises(ConfigError, match=way):
        load_policy(folder)
    assert f"unknown task 'R+Heat'{way}" in refused_by_plot(capsys, "actions", folder)
    other = root / "R+L2" / "Mine,steps=40" / "seed=3"
    shutil.copytree(folder, other)
    config = (other / "config.yaml").read_text().replace("algo: DPre", "algo: Mine").replace("R+Heat", "R+L2")
    (other / "config.yaml").write_text(config)
    assert run_command(["play", str(other)]) == 2
    err = capsys.readouterr().err
    assert "unknown algorithm 'Mine'" in err and way in err
    assert way in refused_by_plot(capsys, "actions", other)


def test_play_notes_a_changed_definition_in_one_line(tmp_path, set_bound, capsys, recwarn):
    set_bound(0.05)
    train(tmp_path, CHECKPOINTED.replace("R+N", "R+X").replace("3,5", "3"))
    set_bound(0.9)
    capsys.readouterr()
    (folder,) = find_runs(tmp_path)
    assert run_command(["play", str(folder), "episodes=1"]) == 0
    captured = capsys.readouterr()
    assert captured.err == (
        f"note: {folder} was trained with another definition of its task: the constraint's bound: 0.05 then, 0.9 now\n"
    )
    assert not recwarn


def test_the_last_line_on_a_terminal_starts_at_its_left(tmp_path):
    words = CHECKPOINTED.replace("3,5", "3")
    terminal, end = pty.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "run.py", *words.split(), f"results={tmp_path}", "jobs=1"], cwd=ROOT, stdout=end, stderr=end
    )
    os.close(end)
    said = b""
    try:
        while part := os.read(terminal, 4096):
            said += part
    except OSError:  # the other end is closed
        pass
    assert process.wait(timeout=120) == 0
    os.close(terminal)
    before, line, _ = said.partition(b"1 of 1 cell done\r\n")
    assert line and b"%|" in before and before.endswith(b"\r"), said[-400:]
