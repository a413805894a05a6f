"""User files loaded by `plugin=`, and the tables to which they add entries."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import cells_of, run_command

from algos import ALGORITHMS, Algorithm
from algos.td3 import TD3
from core.maps import Project
from core.words import NameTable
from store.folder import find_runs, read_definition
from sweep import plugins

ROOT = Path(__file__).parents[1]
PLUGIN = """
import my_bounds
from algos import ALGORITHMS, Algorithm
from algos.td3 import TD3
from constraints import Ball
from core.maps import Project
from envs import TASKS, Task
from envs.reacher import Reacher

ALGORITHMS["DMine"] = Algorithm(TD3, Project(), "layer")
TASKS["R+Mine"] = Task(Reacher, Ball(my_bounds.BOUND, 2), "a small ball", "a formula", 300)
"""
SHORT = "learning_starts=20 batch_size=4 hidden=[8,8] eval_episodes=1 final_episodes=1"
CELL = f"algo=DMine env=R+Mine seed=0 steps=40 {SHORT}"


@pytest.fixture
def plugin(tmp_path):
    (tmp_path / "my_bounds.py").write_text("BOUND = 0.05\n")
    (tmp_path / "mine.py").write_text(PLUGIN)
    return tmp_path / "mine.py"


def python(*arguments, **options):
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=240, **options
    )


def test_all_commands_take_plugins(plugin, tmp_path):
    root = tmp_path / "results"
    done = python(
        "run.py", *CELL.split(), f"results={root}", "plugin=~/mine.py", env=os.environ | {"HOME": str(tmp_path)}
    )
    assert done.returncode == 0, done.stderr
    (folder,) = find_runs(root)
    info = json.loads((folder / "info.json").read_text())
    assert [source["file"] for source in info["sources"]] == ["mine.py", "my_bounds.py"]
    assert all(len(source["sha256"]) == 64 and source["commit"] is None for source in info["sources"])
    assert "plugin=" in info["command"] and str(tmp_path) not in json.dumps(info)
    assert read_definition(folder)["task"]["constraint.bound"] == "0.05"

    status = python("run.py", "status", root, f"plugin={plugin}")
    assert (status.returncode, "1 finished" in status.stdout) == (0, True)
    tables = python("plot.py", "tables", f"plugin={plugin}", f"out={tmp_path}", "format=md")
    assert tables.returncode == 0 and "a small ball" in tables.stdout
    assert python("plot.py", root, f"plugin={plugin}", "format=md").returncode == 0


def test_a_plugin_may_be_named_through_a_link(plugin, tmp_path):
    (tmp_path / "real").mkdir()
    for file in (plugin, tmp_path / "my_bounds.py"):
        file.rename(tmp_path / "real" / file.name)
    (tmp_path / "link").symlink_to("real")
    show = "import sys; from sweep.plugins import load_plugins; load_plugins(sys.argv[1:]); import mine; print(mine)"
    path = os.pathsep.join([str(tmp_path / "real"), str(ROOT)])  # the real path, as in a shell there
    done = python("-c", show, f"plugin={tmp_path / 'link' / 'mine.py'}", env=os.environ | {"PYTHONPATH": path})
    assert done.returncode == 0 and "mine.py" in done.stdout, done.stderr


def test_the_processes_of_a_sweep_load_them(plugin, tmp_path):
    root = tmp_path / "results"
    words = [*CELL.replace("seed=0", "seed=0,1").split(), f"results={root}", f"plugin={plugin}", "jobs=1"]
    done = python("run.py", *words)
    assert done.returncode == 0, done.stderr
    assert "1 of 1 cell done" in done.stdout and len(find_runs(root)) == 2
    (tmp_path / "my_bounds.py").write_text("BOUND = 0.9\n")
    done = python("run.py", *words)
    assert done.returncode == 2 and "the constraint's bound: 0.05 then, 0.9 now" in done.stderr


def test_a_pickled_cell_brings_its_plugins(plugin, tmp_path):
    """A job of submitit is pickled like this."""
    make = (
        "import pickle, sys; from sweep.plugins import load_plugins; from sweep.cells import make_cells;"
        "from core.words import parse_words; from algos import setting_keys;"
        "words = load_plugins(sys.argv[2:]); cells = make_cells(parse_words(words, setting_keys()));"
        "open(sys.argv[1], 'wb').write(pickle.dumps(cells))"
    )
    load = "import pickle, sys; print(pickle.load(open(sys.argv[1], 'rb'))[0].words)"
    done = python("-c", make, tmp_path / "cells.pkl", *CELL.split(), f"plugin={plugin}")
    assert done.returncode == 0, done.stderr
    done = python("-c", load, tmp_path / "cells.pkl")
    assert f"plugin={plugin}" in done.stdout and "algo=DMine" in done.stdout, done.stderr


def test_a_program_can_be_its_own_plugin(plugin):
    plugin.write_text(PLUGIN + "\nimport sys, run\nif __name__ == '__main__':\n    sys.exit(run.main(sys.argv[1:]))\n")
    words = [*CELL.split(), f"results={plugin.parent / 'results'}", f"plugin={plugin}", "jobs=1"]
    done = python(plugin, *words, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    assert len(find_runs(plugin.parent / "results")) == 1


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("other.py", None, "expected a Python file (.py), and there is no such file"),
        ("other.txt", "", "expected a Python file (.py)"),
        ("random.py", "", "has the same name as another module, random: rename it"),
        ("algos.py", "", "has the same name as another module, algos: rename it"),
        ("other.py", "x = 1\ny = (\n", "other.py, line 2: SyntaxError: "),
        ("other.py", "import os\n\nraise KeyError('a\\nb')\n", "other.py, line 3: KeyError: "),
        ("other.py", "import no_such_module\n", "other.py, line 1: ModuleNotFoundError: No module named"),
        ("other.py", "import json\njson.loads('{')\n", "other.py, line 2: JSONDecodeError: "),
        ("other.py", "import sys\nsys.exit(3)\n", "other.py, line 2: SystemExit: it ends the program (3)"),
        (
            "other.py",
            "from algos import ALGORITHMS\nALGORITHMS['DPre'] = 1\n",
            "line 2: ValueError: the algorithm 'DPre'",
        ),
        (
            "other.py",
            "from sweep.train import train_words\ntrain_words('algo=DPre env=R+N')\n",
            "line 2: ConfigError: a plugin must not train when it is imported: train below `if __name__",
        ),
    ],
)
def test_a_broken_plugin_is_one_line_with_its_place(tmp_path, capsys, name, text, said):
    if text is not None:
        (tmp_path / name).write_text(text)
    before = {**plugins._loaded}
    for command in (["algo=DPre", "env=R+N"], ["status", str(tmp_path)]):
        assert run_command([*command, f"plugin={tmp_path / name}"]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and said in err and err.startswith("run.py: ")
    assert plugins._loaded == before and cells_of("algo=DPre env=R+N")[0].words[-1].startswith("simulator=")


def test_plugin_twice(capsys):
    assert run_command(["algo=DPre", "env=R+N", "plugin=a.py", "plugin=b.py"]) == 2
    assert "one plugin= takes several files" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["", "a.py,", ","])
def test_a_plugin_without_a_name(tmp_path, monkeypatch, capsys, value):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.py").write_text("")
    assert run_command(["status", str(tmp_path), f"plugin={value}"]) == 2
    assert f"bad value {value!r} for plugin" in capsys.readouterr().err
    assert not plugins.plugin_words()  # nothing was imported


def test_a_name_is_registered_once_and_fits_on_a_command_line():
    with pytest.raises(
        ValueError, match="the algorithm 'DPre' exists already: choose another name, or delete it first"
    ):
        ALGORITHMS["DPre"] = ALGORITHMS["DPro"]
    for more in ({"DPre": ALGORITHMS["DPro"]}, {"a b": ALGORITHMS["DPro"]}):
        with pytest.raises(ValueError):
            ALGORITHMS.update(more)
        with pytest.raises(ValueError):
            ALGORITHMS.setdefault("c,d", ALGORITHMS["DPro"])
    table = NameTable("colour")
    table["red"] = 1
    table |= {"blue": 2}
    assert list(table) == ["red", "blue"] and table["blue"] == 2 and len(table) == 2
    for name in ("a,b", "a/b", "a b", "a=b", "", ".a", "all", "paper", 3, "a\n"):
        with pytest.raises(ValueError, match="cannot be the name of a colour"):
            table[name] = 3
    with pytest.raises(ValueError, match="the colour 'red' exists"):
        table |= {"red": 3}
    del table["red"]
    table["red"] = 3
    assert dict(table) == {"blue": 2, "red": 3}
    mine = Algorithm(TD3, Project(), "layer")
    ALGORITHMS["DOwn"] = mine
    assert ALGORITHMS.pop("DOwn") is mine
