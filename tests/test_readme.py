"""The examples in README and docs run as printed, and the docs describe what is there."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from algos import ALGORITHMS, PAPER
from envs import TASKS
from plots import reproduced
from plots.paper import read_paper
from plots.reproduced import DATA, TABLES, details, overview, read_cells, replace_table
from store.published import PublishedRun, read_published, write_published

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
# The examples of other-agents.md train no cells; tests/test_other_agents.py runs them.
EXAMPLES = [
    (page, code)
    for page in PAGES
    if page.stem != "other-agents"
    for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
]
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


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_the_tables_of_what_is_reproduced_are_those_of_the_runs(path):
    table = TABLES[path](read_cells(DATA))
    assert replace_table(path.read_text(), table, path.name) == path.read_text(), "run python -m plots.reproduced"


def test_a_run_with_other_settings_or_without_result_is_not_reproduced(tmp_path):
    runs = {published.run.algo: published for published in read_published(DATA, ["R+L2"], ["DPro", "DPre", "DAlpha"])}
    pro, pre, alpha = runs["DPro"], runs["DPre"], runs["DAlpha"]
    other = replace(pre.run, variant="DPre,batch_size=16", overrides={"batch_size": "16"})
    unfinished = replace(alpha.run, result=None)
    write_published(tmp_path / "R+L2", [pro, PublishedRun(other, pre.info), PublishedRun(unfinished, alpha.info)])
    cells = read_cells(tmp_path)
    assert {task: list(by_algo) for task, by_algo in cells.items()} == {"R+L2": ["DPro"]}
    result = pro.run.result["return_mean"]
    assert overview(cells).splitlines()[2:] == [f"| Pro | **{result:.2f}** (n=1) / -4.65 ± 0.59 |"]


def test_methods_that_the_paper_has_not_are_in_the_detailed_table_alone(tmp_path):
    pro = next(published for published in read_published(DATA, ["R+L2"], ["DPro"]))
    later = replace(pro.run, algo="DFlow", variant="DFlow", config=pro.run.config | {"algo": "DFlow"})
    write_published(tmp_path / "R+L2", [pro, PublishedRun(later, pro.info)])
    cells = read_cells(tmp_path)
    assert [row.split(" | ")[0] for row in overview(cells).splitlines()[2:]] == ["| Pro"]
    assert re.search(r"\| DPro \| .* \| -4.65 ± 0.59 \| – \|", details(cells).splitlines()[2])
    assert re.search(r"\| DFlow \| .* \| – \| – \|", details(cells).splitlines()[3])


def test_runs_that_diverged_count_with_their_best_parameters_and_are_marked(tmp_path):
    published = next(published for published in read_published(DATA, ["R+L2"], ["DPre"]))
    finished = published.run
    failure = {"step": 9, "quantity": "critic loss", "largest_violation": 2e-7}
    failure["result"] = {"return_mean": 1.0, "returns": [1.0], "best_step": 5}
    diverged = replace(finished, seed=1000, result=None, failure=failure)
    without = replace(diverged, seed=1001, failure={"step": 9, "quantity": "critic loss"})
    write_published(tmp_path / "R+L2", [PublishedRun(run, published.info) for run in (finished, diverged, without)])
    cells = read_cells(tmp_path)
    assert [run.seed for run in cells["R+L2"]["DPre"]] == [finished.seed, 1000]
    mean = (finished.result["return_mean"] + 1.0) / 2
    assert re.search(rf"\*\*{mean:.2f} ± [\d.]+\*\*† \(n=2\)", overview(cells))
    assert re.search(
        rf"\| DPre \| {finished.seed}, 1000† \| {mean:.2f} ± [\d.]+† \| – \| 17.81 ± 0.33 \| -[\d.]+ \| 2.0e-07 ",
        details(cells),
    )


def test_a_cell_of_mixed_settings_is_refused(tmp_path):
    run = next(published for published in read_published(DATA, ["R+L2"]) if not published.run.overrides)
    other = replace(run.run, seed=run.run.seed + 1000, config=run.run.config | {"gamma": 0.5})
    write_published(tmp_path / "R+L2", [run, PublishedRun(other, run.info)])
    with pytest.raises(ValueError, match="settings differ"):
        read_cells(tmp_path)


def test_the_command_changes_a_table_only_if_the_data_has(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{reproduced.BEGIN}| old |\n{reproduced.END}after\n")
    monkeypatch.setattr(reproduced, "ROOT", tmp_path)
    monkeypatch.setattr(reproduced, "TABLES", {page: overview})
    assert reproduced.main([]) == 0 and "| Pro | **" in page.read_text()
    assert reproduced.main([]) == 0
    assert capsys.readouterr().out == "the table of page.md is replaced\nthe table of page.md is up to date\n"
    assert reproduced.main(["--help"]) == 0 and reproduced.main(["results"]) == 2
    monkeypatch.setattr(reproduced, "DATA", tmp_path)
    before = page.read_text()
    capsys.readouterr()
    assert reproduced.main([]) == 2 and page.read_text() == before
    assert capsys.readouterr().err == f"plots.reproduced: no full-length runs in {tmp_path}\n"


def test_a_text_without_a_place_for_the_table_is_refused():
    with pytest.raises(ValueError, match="^page.md: no table between"):
        replace_table("no marks", "| |\n", "page.md")


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
