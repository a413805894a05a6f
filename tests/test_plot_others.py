"""Several folders of results side by side, including published runs, and CSV files of other programs."""

import csv
from pathlib import Path

import pytest
from helpers import refused_by_plot, write_run

import plot
from plots.others import COLUMNS, parse_sources, read_csv
from plots.paper import labelled, order_algos, read_paper, same_without_constraint, unlabelled

ROOT = Path(__file__).parents[1]
THEIRS = """task,algorithm,seed,step,return
R+L2,SRad,0,5000,3.25
R+L2,SRad,0,10000,7.5
R+L2,SRad,1,5000,4.25
R+L2,SRad,1,10000,9.5
R+L2,FISOR,0,10000,11.0
Arm,FISOR,0,10000,2.0
"""


@pytest.fixture
def ours(tmp_path):
    """A folder of results with two seeds of SRad and of Mine on R+L2."""
    root = tmp_path / "results"
    for seed in range(2):
        write_run(root, "R+L2", "SRad", seed, result=15.0 + seed)
        write_run(root, "R+L2", "Mine", seed, result=16.0 + seed)
    return root


def records(root, table):
    with open(Path(root, "tables", f"{table}.csv"), newline="") as file:
        return list(csv.DictReader(file))


def means(root):
    return {(record["task"], record["algo"]): float(record["mean"]) for record in records(root, "rewards")}


def theirs(folder, content=THEIRS, name="theirs.csv"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(content)
    return folder / name


def labels(figure):
    return [line.get_label().rpartition(" (n=")[0] for line in figure.axes[0].lines]


# ---- names with labels


def test_names_with_labels():
    assert labelled("SRad", "") == "SRad" == unlabelled("SRad") == unlabelled(labelled("SRad", "a (b"))
    names = ["Mine", "SRad (b)", "DPre+ (a)", "SRad", "SRad (a)", "Mine (a)", "DPro"]
    assert order_algos(names) == ["DPro", "DPre+ (a)", "SRad", "SRad (a)", "SRad (b)", "Mine", "Mine (a)"]
    assert same_without_constraint("DPre+ (a)") == "DPro (a)" and same_without_constraint("SPre+") == "SPre"
    assert same_without_constraint("SRad") is None is same_without_constraint("Mine (a)")


def test_words_and_their_labels(tmp_path):
    def found(*words):
        return [(source.path.name, source.label) for source in parse_sources(words)]

    file = theirs(tmp_path / "other")
    (tmp_path / "lr=3").mkdir()
    assert found("results/") == [("results", "")]
    assert found("results/", "b/=theirs", "c/") == [("results", ""), ("b", "theirs"), ("c", "c")]
    assert found("results/=ours", f"{tmp_path}/other/") == [("results", "ours"), ("other", "other")]
    assert found("results/", str(file), f"{file}=of theirs") == [
        ("results", ""),
        ("theirs.csv", "theirs"),
        ("theirs.csv", "of theirs"),
    ]
    assert found("results/", f"{tmp_path}/lr=3", f"{tmp_path}/lr=3=x") == [
        ("results", ""),
        ("lr=3", "lr=3"),
        ("lr=3", "x"),
    ]


@pytest.mark.parametrize(
    "words, said",
    [
        (["b/="], "bad label '' for b"),
        (["b/=x (y)"], "bad label 'x (y)' for b"),
        (["b/= x"], "bad label ' x' for b"),
        (["b/=paper"], "bad label 'paper' for b"),
        (["b/=x", "c/=x"], "two folders have the label 'x': give c another one with c=LABEL"),
        (["b/", "c/b/"], "two folders have the label 'b'"),
    ],
)
def test_labels_that_are_none(capsys, ours, words, said):
    assert said in refused_by_plot(capsys, ours, *words)


# ---- side by side


def test_folders_stand_side_by_side(tmp_path, ours, drawn):
    other = tmp_path / "fork" / "results"
    for seed in range(2):
        write_run(other, "R+L2", "SRad", seed, result=5.0 + seed)
        write_run(other, "R+L2", "SRad", seed, result=1.0, overrides={"gamma": 0.5})
    assert plot.main([str(ours), f"{other}/=fork", "format=csv"]) == 0
    assert {(r["settings"], r["algo"], float(r["mean"])) for r in records(ours, "rewards")} == {
        ("", "SRad", 15.5),
        ("", "SRad (fork)", 5.5),
        ("", "Mine", 16.5),
        ("gamma=0.5", "SRad (fork)", 1.0),
    }
    assert labels(drawn["R+L2"]) == ["SRad", "SRad (fork)", "Mine"]
    colors = [line.get_color() for line in drawn["R+L2"].axes[0].lines]
    assert len(set(colors)) == 3
    assert labels(drawn["R+L2,gamma=0.5"]) == ["SRad (fork)"]
    # Both are compared with the paper's number.
    compared = {r["algo"]: r["paper_mean"] for r in records(ours, "comparison") if not r["settings"]}
    assert float(compared["SRad"]) == float(compared["SRad (fork)"]) == read_paper()["R+L2", "default", "SRad"].mean
    assert compared["Mine"] == ""
    assert {r["algo"] for r in records(ours, "improvement")} == {"SRad", "SRad (fork)", "Mine"}
    assert not (other / "tables").exists()


def test_published_runs_stand_beside_a_folder(ours, drawn):
    write_run(ours, "R+L2", "DPre", 0, result=15.0)
    assert plot.main([str(ours), str(ROOT / "docs" / "data"), "format=csv", "env=R+L2", "algo=DPre,Mine"]) == 0
    assert {algo for _, algo in means(ours)} == {"DPre", "DPre (data)", "Mine"}
    assert labels(drawn["R+L2"]) == ["DPre", "DPre (data)", "Mine"]
    assert {r["algo"] for r in records(ours, "adjusted")} == {"DPre", "DPre (data)", "Mine"}


def test_the_papers_columns_beside_a_forks_own_algorithm(ours, capsys):
    assert plot.main([str(ours), f"{ours}/=again", "paper=beside", "format=csv,tex", "algo=Mine,SRad"]) == 0
    assert "Mine (again)" in capsys.readouterr().out
    tex = (ours / "tables" / "rewards.tex").read_text()
    srad = [name for name in ("SRad (paper)", "SRad (again)") if name in tex]
    assert len(srad) == 2 and r"\multicolumn{6}{c}{SAC family}" in tex  # SPre, SPre+, SAlpha, SRad of the paper, 2 more
    beside = {r["algo"]: r["paper_mean"] for r in records(ours, "rewards")}
    assert beside["Mine"] == "" and float(beside["SRad"]) > 0


def test_without_a_constraint_the_same_runs_stand_for_another_algorithm_of_their_place(tmp_path, ours):
    other = tmp_path / "fork"
    for seed in range(2):
        write_run(other, "R+N", "DPro", seed, result=18.0)
        write_run(other, "R+L2", "DPre", seed, result=15.0)
        write_run(ours, "R+N", "DPro", seed, result=12.0)
    assert plot.main([str(ours), str(other), "format=csv,md"]) == 0
    tasks = {r["algo"]: r["tasks"] for r in records(ours, "aggregate")}
    assert tasks["DPre (fork)"] == "R+N R+L2" and tasks["DPro (fork)"] == "R+N"
    assert "Same as DPro (fork)" in (ours / "tables" / "rewards.md").read_text()


# ---- CSV files


@pytest.mark.parametrize("as_folder", [False, True])
def test_a_csv_file_stands_beside_a_folder(tmp_path, ours, drawn, as_folder):
    file = theirs(tmp_path / "elsewhere")
    place = f"{file.parent if as_folder else file}=theirs"
    assert plot.main([str(ours), place, "format=csv"]) == 0
    assert means(ours) == {
        ("R+L2", "SRad"): 15.5,
        ("R+L2", "SRad (theirs)"): 8.5,  # the mean over seeds of the returns at the last step
        ("R+L2", "Mine"): 16.5,
        ("R+L2", "FISOR (theirs)"): 11.0,
        ("Arm", "FISOR (theirs)"): 2.0,
    }
    assert labels(drawn["R+L2"]) == ["SRad", "SRad (theirs)", "FISOR (theirs)", "Mine"]
    line = drawn["R+L2"].axes[0].lines[1]
    assert line.get_xdata().tolist() == [5_000, 10_000] and line.get_ydata().tolist() == [3.75, 8.5]
    assert {r["algo"] for r in records(ours, "adjusted")} == {"SRad", "Mine"}  # the other runs' starts are not known


def test_a_csv_file_alone(tmp_path, drawn):
    file = theirs(tmp_path)
    assert plot.main([str(file), "env=R+L2", "format=csv"]) == 0
    assert means(tmp_path) == {("R+L2", "SRad"): 8.5, ("R+L2", "FISOR"): 11.0}
    assert plot.main([str(file), "algo=FISOR", f"out={tmp_path / 'out'}", "format=csv"]) == 0
    assert means(tmp_path / "out") == {("R+L2", "FISOR"): 11.0, ("Arm", "FISOR"): 2.0}


def test_what_spreadsheets_and_other_tools_write(tmp_path):
    columns = "wall_time,return,step,seed,algorithm,task"
    file = theirs(tmp_path, f"\ufeff{columns}\r\n1.0, 2.5,10,0,SRad, R+L2\r\n2.0,-1e-3,5,0,SRad,R+L2\r\n")
    (run,) = read_csv(file)
    assert (run.task, run.algo, run.seed, run.overrides, run.training) == ("R+L2", "SRad", 0, {}, {})
    assert run.evaluations.step.tolist() == [5, 10] and run.evaluations.returns.tolist() == [[-0.001], [2.5]]
    assert run.finished and run.result == {"return_mean": 2.5}


def test_a_return_that_is_not_a_number_fails_as_for_our_runs(tmp_path, capsys):
    file = theirs(tmp_path, THEIRS.replace("9.5", "nan"))
    assert plot.main([str(file), "format=csv"]) == 0
    assert "R+L2 SRad: seed 1 failed, its return is not a number" in capsys.readouterr().out
    assert means(tmp_path)["R+L2", "SRad"] == 7.5


@pytest.mark.parametrize(
    "row, said",
    [
        ("R+L2,SRad,0,10000,1.0", "line 8: SRad on R+L2, seed 0, has step 10000 twice"),
        ("R+L2,SRad,0.5,1,1.0", "line 8: bad value '0.5' for seed: expected a whole number of at least 0"),
        ("R+L2,SRad,0,-1,1.0", "line 8: bad value '-1' for step: expected a whole number of at least 0"),
        ("R+L2,SRad,0,1e3,1.0", "line 8: bad value '1e3' for step"),
        ("R+L2,SRad,0,1,much", "line 8: bad value 'much' for return: expected a number"),
        ("R+L2,SRad,0,1", "line 8: bad value '' for return: expected a number"),
        (",SRad,0,1,1.0", "line 8: task is empty"),
        ("R+L2, ,0,1,1.0", "line 8: algorithm is empty"),
    ],
)
def test_rows_that_do_not_fit(tmp_path, capsys, row, said):
    file = theirs(tmp_path, f"{THEIRS}{row}\n")
    assert refused_by_plot(capsys, file).startswith(f"plot.py: {file}: {said}")


def test_files_that_are_none(tmp_path, ours, capsys):
    file = theirs(tmp_path, THEIRS.replace("algorithm", "algo"))
    said = f"{file}: no column algorithm (expected {','.join(COLUMNS)})"
    assert refused_by_plot(capsys, file) == f"plot.py: {said}\n"
    assert refused_by_plot(capsys, ours, f"{tmp_path}/nowhere.csv").endswith("nowhere.csv: no such file or directory\n")
    assert "no column task, algorithm" in refused_by_plot(capsys, theirs(tmp_path, "", "empty.csv"))
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x01")
    assert "binary.csv: " in refused_by_plot(capsys, tmp_path / "binary.csv")
    # In a folder with runs, such a file is reported and left out.
    theirs(ours, THEIRS.replace("algorithm", "algo"), "notes.csv")
    assert plot.main([str(ours), "format=csv"]) == 0
    assert f"skipped {ours / 'notes.csv'}: no column algorithm" in capsys.readouterr().err
    assert set(means(ours)) == {("R+L2", "SRad"), ("R+L2", "Mine")}


def test_a_corrupt_published_file_is_one_line(tmp_path, ours, capsys):
    (tmp_path / "data" / "R+L2").mkdir(parents=True)
    (tmp_path / "data" / "R+L2" / "runs.csv").write_text("algo,seed\nSRad,0\n")
    assert "runs.csv: no column variant" in refused_by_plot(capsys, ours, f"{tmp_path}/data")
