"""How many threads a cell has where the command does not say."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
WORDS = "algo=DPre env=R+N steps=20 learning_starts=10 batch_size=4 hidden=8 eval_episodes=1 final_episodes=1"


@pytest.mark.parametrize(
    "more, threads", [("", 2), ("threads=1", 1), ("jobs=1", 1), ("jobs=1 threads=2", 2)], ids=lambda value: str(value)
)
def test_a_cell_alone_uses_the_machine_and_a_cell_of_a_sweep_one_core(tmp_path, more, threads):
    command = [sys.executable, "run.py", *WORDS.split(), *more.split(), f"results={tmp_path}"]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "2"}, check=True, capture_output=True)
    (info,) = (json.loads(path.read_text()) for path in tmp_path.glob("R+N/*/seed=0/info.json"))
    assert info["threads"] == threads


def test_small_networks_get_no_more_than_four_threads():
    for given, used in ((1, 1), (3, 3), (16, 4)):
        code = f"import torch; torch.set_num_threads({given}); from core.config import THREADS; print(THREADS)"
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
        assert int(done.stdout) == used
