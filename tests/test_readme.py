"""The examples in README and docs run as printed, and the docs describe what is there."""

import re
import shutil
from pathlib import Path

import pytest

from algos import ALGORITHMS, PAPER
from envs import TASKS
from plots.paper import read_paper
from plots.reproduced import README, replace_table, reproduced_table
from store.folder import read_results

ROOT = Path(__file__).parents[1]
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
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


def test_readme_is_one_door():
    lines = README.read_text().splitlines()
    assert len(lines) <= 130
    for command in (r"pip install .* && python run\.py .* && python plot\.py results/", r"pip install .* && pytest"):
        assert sum(re.fullmatch(command, line) is not None for line in lines) == 1  # what CI looks for


@pytest.mark.parametrize("page", [README, ROOT / "docs" / "tasks.md"], ids=["README", "tasks"])
def test_the_tables_have_every_task_and_algorithm_of_the_paper_and_no_unknown_one(page):
    table = "".join(line for line in page.read_text().splitlines(keepends=True) if line.startswith("| "))
    first_cells = re.findall(r"^\|([^|]*)\|([^|]*)\|", table, re.MULTILINE)
    words = {word for cells in first_cells for cell in cells for word in re.split(r"[,\s]+", cell)}
    names = {word for word in words if re.fullmatch(r"(R|HC|H|W)\+[A-Z0-9+]+|[DS][A-Z][a-z]+\+?|NFW", word)}
    assert {*PAPER, *(task for task, _, _ in read_paper())} <= names <= {*ALGORITHMS, *TASKS}


def test_the_table_of_what_is_reproduced_is_that_of_the_runs():
    assert replace_table(README.read_text(), reproduced_table(ROOT / "docs" / "full-runs")) == README.read_text()


def test_a_run_with_other_settings_or_without_result_is_not_reproduced(tmp_path):
    runs = ROOT / "docs" / "full-runs" / "R+L2"
    for source, target in (("DPro", "DPro"), ("DPre", "DPre,batch_size=16"), ("DAlpha", "DAlpha")):
        shutil.copytree(runs / source, tmp_path / "R+L2" / target)
    (tmp_path / "R+L2" / "DAlpha" / "seed=0" / "result.json").unlink()
    assert reproduced_table(tmp_path).splitlines()[2:] == ["| DPro | **17.18** (n=1) / -4.65 ± 0.59 |"]


def test_a_text_without_a_place_for_the_table_is_refused():
    with pytest.raises(ValueError, match="no table between"):
        replace_table("no marks", "| |\n")


def test_the_results_page_has_the_numbers_of_the_runs():
    page = (ROOT / "docs" / "results.md").read_text()
    runs, _ = read_results(ROOT / "docs" / "full-runs", ["R+L2"])
    for run in runs:
        late = run.evaluations.return_mean[run.evaluations.step > 200_000]
        assert len(late) == 20
        assert f"| {run.algo} | {run.result['return_mean']:.2f} | {late.mean():.2f} |" in page


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
