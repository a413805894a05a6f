"""Training imports only what its task needs."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = "steps=24 learning_starts=16 batch_size=4 hidden=[8] eval_every=24 eval_episodes=1 final_episodes=1"


@pytest.mark.parametrize(
    "algo, task, absent",
    [("DRad", "W+M", []), ("SPre", "R+L2", ["mujoco"]), ("NFW", "R+T", ["mujoco"])],
)
def test_a_task_trains_without_what_only_other_tasks_or_plots_need(algo, task, absent, tmp_path):
    code = f"""
import sys
for name in {[*absent, "pybullet", "osqp", "scipy", "pandas", "matplotlib"]!r}:
    sys.modules[name] = None  # importing it fails
import run
sys.exit(run.main("algo={algo} env={task} seed=3,5 {SETTINGS} results={tmp_path}".split()))
"""
    process = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    assert len(list(tmp_path.rglob("result.json"))) == 2


def test_tables_stand_on_the_standard_library_alone():
    """The lint rule on imports covers packages only; tables.py is in none."""
    tree = ast.parse((ROOT / "tables.py").read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert names and {name.partition(".")[0] for name in names} <= sys.stdlib_module_names
