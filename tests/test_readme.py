"""The examples in README and docs run as printed, and the docs describe what is there."""

import re
from pathlib import Path

import pytest

from algos import ALGORITHMS
from envs import TASKS

ROOT = Path(__file__).parents[1]
# The examples of other-agents.md train no cells; tests/test_other_agents.py runs them.
PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.stem != "other-agents")]
EXAMPLES = [(page, code) for page in PAGES for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)]
SHORTENED = " steps=300 learning_starts=100 batch_size=8 eval_episodes=1 final_episodes=1"
ROOMS = ("algos", "constraints", "envs", "core", "store", "sweep", "plots", "bench")


@pytest.mark.parametrize(
    "page, code", EXAMPLES, ids=[f"{page.name}-{code.splitlines()[0]}-{len(code)}" for page, code in EXAMPLES]
)
def test_an_example_runs_and_trains_every_cell_that_it_names(page, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tasks, algorithms = dict(TASKS), dict(ALGORITHMS)
    shortened = re.sub(r" steps=\d+(?=[ \"])", SHORTENED, re.sub(r" (learning_starts|batch_size)=\d+", "", code))
    try:
        exec(compile(shortened, page.name, "exec"), {"__name__": "example"})
    finally:
        for table, before in ((TASKS, tasks), (ALGORITHMS, algorithms)):
            table.clear()
            table.update(before)
    named = re.findall(r'train_words\("algo=(\S+) env=(\S+)', code)
    assert len(named) == code.count("train_words(")
    cells = {(task, algo) for algos, tasks in named for algo in algos.split(",") for task in tasks.split(",")}
    trained = [path.parts[-4:-2] for path in tmp_path.glob("results/*/*/seed=0/result.json")]
    assert {(task, variant.partition(",")[0]) for task, variant in trained} == cells


def test_every_task_and_algorithm_is_described():
    readme = (ROOT / "README.md").read_text()
    for name in [*TASKS, *ALGORITHMS]:
        assert re.search(rf"(?<![\w+]){re.escape(name)}(?![\w+])", readme), name


def test_the_tree_of_the_code_is_the_one_on_disk():
    tree = re.search(r"```\n(run\.py.*?)```", (ROOT / "docs" / "code.md").read_text(), re.DOTALL).group(1)
    described, folders = set(), []
    for line in filter(str.strip, tree.splitlines()):
        name, depth = line.split()[0], (len(line) - len(line.lstrip())) // 4
        folders[depth:] = [name] if name.endswith("/") else []
        if not name.endswith("/"):
            described.add("".join([*folders[:depth], name]))
    files = {path.relative_to(ROOT).as_posix() for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    assert described == files | {"run.py", "plot.py", "tables.py"}
