"""README's examples run as printed, and its commands are those that the project stands by."""

import re
from pathlib import Path

import pytest

from algos import ALGORITHMS
from envs import TASKS

README = (Path(__file__).parents[1] / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
SHORTENED = " steps=300 learning_starts=100 batch_size=8 eval_episodes=1 final_episodes=1"


@pytest.mark.parametrize("code", EXAMPLES, ids=[code.splitlines()[0] for code in EXAMPLES])
def test_example(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tasks, algorithms = dict(TASKS), dict(ALGORITHMS)
    try:
        exec(compile(re.sub(r" steps=\d+ learning_starts=\d+", SHORTENED, code), "README.md", "exec"), {})
    finally:
        for table, before in ((TASKS, tasks), (ALGORITHMS, algorithms)):
            table.clear()
            table.update(before)
    trained = code.count("train_words(")
    assert len(list(tmp_path.glob("results/*/*/seed=0/result.json"))) == 4 * trained


def test_every_task_and_algorithm_is_described():
    for name in [*TASKS, *ALGORITHMS]:
        assert re.search(rf"(?<![\w+]){re.escape(name)}(?![\w+])", README), name
