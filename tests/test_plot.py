"""Run folders (store/folder.py), and the tables and curves made from them (plot.py, plots/)."""

import csv
import hashlib
import io
import json
import math
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refused_by_plot, write_run
from scipy import stats
from synthetic import CONDITIONS, write_results

import plot
import tables
from plots import figures, grouping, paper, rewards
from store import folder as results
from store import origin, provenance
from store.writer import RunWriter

ROOT = Path(__file__).parents[1]
STEPS = 20_000

# (task, batch): sum of the means, sum of the standard errors, best three as printed in bold in the paper.
PAPER_ROWS = {
    ("R+N", "default"): (122.87, 3.60, {"NFW", "SPre", "SRad"}),
    ("R+L2", "default"): (210.90, 7.61, {"DPre+", "NFW", "SPre+"}),
    ("R+O03", "default"): (235.92, 4.34, {"NFW", "SPre", "SRad"}),
    ("R+O10", "default"): (234.09, 4.47, {"NFW", "SPre+", "SRad"}),
    ("R+O30", "default"): (225.34, 5.73, {"NFW", "SPre", "SPre+"}),
    ("R+M", "default"): (232.01, 5.74, {"NFW", "SPre+", "SRad"}),
    ("R+T", "default"): (156.80, 9.06, {"DPro+", "DPre+", "SPre+"}),
    ("HC+O", "default"): (90636, 3365, {"SPre", "SPre+", "SAlpha"}),
    ("HC+MA", "default"): (104884, 3368, {"SPre", "SPre+", "SAlpha"}),
    ("H+M", "default"): (35838, 453, {"DPre", "NFW", "DRad"}),
    ("H+O+S", "default"): (30384, 1373, {"DPre+", "DAlpha", "SRad"}),
    ("W+M", "default"): (46025, 1618, {"DPro+", "DPre+", "SPre+"}),
    ("W+O+S", "default"): (36121, 1100, {"DPre+", "SPre+", "SAlpha"}),
    ("HC+O", "16"): (87336, 4008, {"SPre", "SAlpha", "SRad"}),
    ("H+M", "16"): (41840, 671, {"DOpt+", "DAlpha", "SPre"}),
    ("W+M", "16"): (43790, 2864, {"DPre+", "DRad", "SAlpha"}),
}


def records(root, table):
    with open(Path(root, "tables", f"{table}.csv"), newline="") as file:
        return list(csv.DictReader(file))


# ---- run folders ----


def test_round_trip(tmp_path):
    folder = results.run_folder(tmp_path, "W+M", results.variant_name("SRad", {"steps": 50_000}), 3)
    config = {
        "algo": "SRad",
        "learning_rate": 1e-5,
        "hidden": [256, 256],
        "gsde": False,
        "action_noise": None,
    }
    writer = RunWriter(folder, config, {"commit": "abc"}, eval_episodes=2)
    unfinished = results.read_run(folder)
    assert not unfinished.finished and unfinished.result is None
    assert unfinished.evaluations.returns.shape == (0, 2)

    returns = np.array([[0.1, -2.0], [1 / 3, np.float32(7.7)]])
    writer.append_evaluation(5_000, returns[0], 1.5)
    writer.append_evaluation(10_000, list(returns[1]), 3.25)
    weights = {"weight": torch.arange(6.0).reshape(2, 3)}
    writer.save_parameters("best", weights)
    writer.save_parameters("last", {"weight": torch.zeros(1)})
    writer.save_parameters("last", weights)
    assert not results.is_finished(folder)
    writer.finish({"return_mean": np.float32(2.5), "returns": np.ones(2), "best_step": torch.tensor(5_000)})
    assert results.is_finished(folder)

    run = results.read_run(folder)
    assert folder == tmp_path / "W+M" / "SRad,steps=50000" / "seed=3"
    assert (run.task, run.algo, run.variant, run.seed) == ("W+M", "SRad", "SRad,steps=50000", 3)
    assert run.overrides == {"steps": "50000"} and run.config == config
    assert run.finished and run.result == {"return_mean": 2.5, "returns": [1.0, 1.0], "best_step": 5_000}
    assert run.evaluations.step.tolist() == [5_000, 10_000]
    np.testing.assert_array_equal(run.evaluations.returns, returns)
    np.testing.assert_allclose(run.evaluations.return_mean, returns.mean(axis=1), rtol=1e-15)
    assert run.evaluations.seconds.tolist() == [1.5, 3.25]
    for name in ("best", "last"):
        torch.testing.assert_close(torch.load(folder / f"{name}.pt", weights_only=True), weights)
    files = {"config.yaml", "info.json", "evaluations.csv", "best.pt", "last.pt", "result.json"}
    assert {path.name for path in folder.iterdir()} == files


def test_variant_names():
    overrides = {
        "steps": 50_000,
        "hidden": [64, 32],
        "gsde": True,
        "learning_rate": 1e-4,
        "train_freq": "episode",
    }
    name = results.variant_name("DPre+", overrides)
    assert name == "DPre+,gsde=true,hidden=[64,32],learning_rate=0.0001,steps=50000,train_freq=episode"
    algo, settings = results.parse_variant(name)
    assert algo == "DPre+" and results.variant_name(algo, settings) == name
    assert settings["hidden"] == "[64,32]"
    assert results.parse_variant("NFW") == ("NFW", {})
    for task, variant in (("a/b", "SRad"), ("R+N", "SRad,x=/tmp"), ("..", "SRad"), ("R+N", "")):
        with pytest.raises(ValueError, match="for a run's folder"):
            results.run_folder("results", task, variant, 0)


def test_earlier_runs_are_moved_aside_and_never_lost(tmp_path):
    first = write_run(tmp_path, "R+N", "SRad", 3, evaluations=1)
    write_run(tmp_path, "R+N", "SRad", 3, evaluations=2)
    write_run(tmp_path, "R+N", "SRad", 3, evaluations=3, result=1.0)
    with pytest.raises(FileExistsError, match="finished"):
        write_run(tmp_path, "R+N", "SRad", 3)
    RunWriter(first.folder, {"algo": "SRad"}, {}, 3, replace_finished=True)

    aside = [first.folder.with_name(f"seed=3.old-{i}") for i in (1, 2, 3)]
    assert [len(results.read_evaluations(old).step) for old in aside] == [1, 2, 3]
    assert results.is_finished(aside[2]) and not results.is_finished(first.folder)
    assert results.find_runs(tmp_path) == [first.folder]


def test_a_death_while_writing_leaves_the_old_file_or_none(tmp_path, monkeypatch):
    writer = write_run(tmp_path, "R+N", "SRad", 0)
    writer.save_parameters("best", {"weight": torch.ones(2)})

    def die(descriptor):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", die)
        with pytest.raises(KeyboardInterrupt):
            writer.save_parameters("best", {"weight": torch.zeros(2)})
        with pytest.raises(KeyboardInterrupt):
            writer.finish({"return_mean": 1.0})
    assert torch.load(writer.folder / "best.pt")["weight"].tolist() == [1.0, 1.0]
    assert not results.is_finished(writer.folder)
    with open(writer.folder / "best.pt", "rb") as opened_before:
        writer.save_parameters("best", {"weight": torch.zeros(2)})
        assert torch.load(opened_before)["weight"].tolist() == [1.0, 1.0]  # replaced, not written over
    writer.finish({"return_mean": 1.0})
    assert results.read_run(writer.folder).result == {"return_mean": 1.0}


def test_the_writer_refuses_what_it_could_not_read_back(tmp_path):
    writer = write_run(tmp_path, "R+N", "SRad", 0)
    with pytest.raises(ValueError, match="3 returns"):
        writer.append_evaluation(25_000, [1.0, 2.0], 1.0)
    with pytest.raises(ValueError, match="best"):
        writer.save_parameters("final", {})
    assert len(results.read_run(writer.folder).evaluations.step) == 4


@pytest.mark.parametrize("torn", ["25000", "25000,1.0,1.0,1.0,1.0,25", "25000,1.0,1."])
def test_a_row_being_written_is_not_read(tmp_path, torn):
    folder = write_run(tmp_path, "R+N", "SRad", 0).folder
    with open(folder / "evaluations.csv", "a") as file:
        file.write(torn)
    assert results.read_run(folder).evaluations.step.tolist() == [5_000, 10_000, 15_000, 20_000]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("evaluations.csv", b"step,return_mean,return_1,seconds\n5000,1.0\n"),
        ("evaluations.csv", b"step,return_mean,return_1,seconds\n5000,1.0,what,2\n"),
        ("evaluations.csv", b""),
        ("evaluations.csv", b"\xff\xfe\x00"),
        ("config.yaml", b"a: [1, 2"),
        ("config.yaml", b"just text"),
        ("config.yaml", None),
        ("result.json", b'{"return_mean": 1'),
        ("result.json", b'{"returns": []}'),
    ],
)
def test_corrupt_files_are_named_and_their_runs_skipped(tmp_path, capsys, name, content):
    write_run(tmp_path, "R+N", "SRad", 0, result=10.0)
    path = write_run(tmp_path, "R+N", "SRad", 1, result=20.0).folder / name
    path.unlink() if content is None else path.write_bytes(content)

    runs, problems = results.read_results(tmp_path)
    assert [run.seed for run in runs] == [0]
    assert len(problems) == 1 and problems[0].startswith(f"{path}: ") and "\n" not in problems[0]

    assert plot.main([str(tmp_path), "format=csv"]) == 0
    assert f"skipped {path}" in capsys.readouterr().err
    assert [(row["mean"], row["n"]) for row in records(tmp_path, "rewards")] == [("10.0", "1")]


def test_description_of_the_environment(monkeypatch):
    command = ["/home/someone/repository/run.py", "algo=SRad", "results=/data/runs", "seed=0-9"]
    monkeypatch.delenv("LD_PRELOAD", raising=False)
    assert provenance.describe_environment(command)["preloaded"] == []
    monkeypatch.setenv("LD_PRELOAD", "/home/someone/libfirst.so:second.so third.so")
    info = provenance.describe_environment(command)
    assert info["command"] == "run.py algo=SRad results=runs seed=0-9"
    assert info["preloaded"] == ["libfirst.so", "second.so", "third.so"]
    assert info["versions"]["torch"] == torch.__version__
    assert info["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", info["started"])
    assert str(Path.home()) not in json.dumps(info) and str(ROOT) not in json.dumps(info)

    monkeypatch.setenv("PATH", "")
    without_git = provenance.describe_environment(command)
    assert without_git["commit"] is None and without_git["dirty"] is None


def test_description_names_the_commit(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    code = tmp_path / "provenance.py"
    code.write_text("first\n")
    monkeypatch.setattr(provenance, "__file__", str(code))
    (tmp_path / "other.py").write_text("")
    git("init")
    git("add", "other.py")
    git("commit", "-m", "without it", "--no-verify")
    assert provenance.describe_environment([])["commit"] is None  # not a file of that repository
    git("add", ".")
    git("commit", "-m", "first", "--no-verify")
    git("tag", "-a", "v1", "-m", "a tag is not a commit's name")
    info = provenance.describe_environment([])
    assert info["commit"] == git("rev-parse", "HEAD") and info["dirty"] is False
    code.write_text("second\n")
    info = provenance.describe_environment([])
    assert info["commit"] == git("rev-parse", "HEAD") and info["dirty"] is True


def test_description_names_a_module_of_the_project_that_the_commit_does_not_have(tmp_path, monkeypatch):
    def git(*arguments):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True, capture_output=True)

    for name in ("run.py", "provenance.py", "constraints/ball.py", "constraints/mine.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    git("init")
    git("add", "run.py", "provenance.py", "constraints/ball.py")
    for module in (provenance, origin):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(origin, "_commands", set)  # the real function is cached, so it would keep old results
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "provenance.py"))
    for name in ("ball", "mine"):
        module = types.ModuleType(f"constraints.{name}")
        module.__file__ = str(tmp_path / "constraints" / f"{name}.py")
        monkeypatch.setitem(sys.modules, module.__name__, module)
    sha256 = hashlib.sha256(b"constraints/mine.py").hexdigest()
    expected = {"file": "constraints/mine.py", "sha256": sha256, "commit": None, "dirty": None}
    assert expected in provenance.describe_environment([])["sources"]
    assert "constraints/ball.py" not in {s["file"] for s in provenance.describe_environment([])["sources"]}


# ---- statistics ----


def test_statistics_against_scipy():
    values = np.random.default_rng(0).normal(5, 3, size=10)
    stat = grouping.statistic(values)
    assert stat.n == 10
    np.testing.assert_allclose([stat.mean, stat.se], [stats.tmean(values), stats.sem(values)], rtol=1e-12)
    alone = grouping.statistic([3.0])
    assert alone.mean == 3.0 and math.isnan(alone.se) and alone.n == 1


def test_learning_curve_averages_over_the_seeds_that_are_there(tmp_path):
    lengths = [4, 4, 3, 1]
    for seed, length in enumerate(lengths):
        write_run(tmp_path, "R+N", "SRad", seed, evaluations=length)
    runs, _ = results.read_results(tmp_path)
    steps, mean, error = figures.learning_curve(runs)
    values = np.full((4, 4), np.nan)
    for row, run in zip(values, runs, strict=True):
        row[: len(run.evaluations.step)] = run.evaluations.return_mean
    assert steps.tolist() == [5_000, 10_000, 15_000, 20_000]
    np.testing.assert_allclose(mean, np.nanmean(values, axis=0), rtol=1e-12)
    np.testing.assert_allclose(error, stats.sem(values, axis=0, nan_policy="omit"), rtol=1e-12)

    steps, mean, error = figures.learning_curve(runs[:1])
    np.testing.assert_array_equal(mean, runs[0].evaluations.return_mean)
    assert np.isnan(error).all()


def test_a_diverged_seed_is_not_averaged_away(tmp_path):
    write_run(tmp_path, "R+N", "SRad", 0)
    write_run(tmp_path, "R+N", "SRad", 1).append_evaluation(25_000, [math.nan] * 3, 1.0)
    runs, _ = results.read_results(tmp_path)
    _, mean, _ = figures.learning_curve(runs)
    assert math.isnan(mean[-1]) and np.isfinite(mean[:-1]).all()


def test_best_of_a_row():
    assert rewards.best_of_row({"a": 1.0, "b": 4.0, "c": 3.0, "d": 2.0}) == {"b", "c", "d"}
    assert rewards.best_of_row({"a": -1.0, "b": -4.0, "c": -3.0, "d": -2.0}) == {"a", "d", "c"}
    assert rewards.best_of_row({"a": 1.0, "b": 4.0, "c": 3.0, "d": 1.0}) == {"a", "b", "c", "d"}  # tied third
    # With three names, all would be among the best three.
    assert rewards.best_of_row({"a": 1.0, "b": 4.0, "c": 3.0}) == {"b"}
    assert rewards.best_of_row({"a": 1.0, "b": 1.0}) == {"a", "b"}
    assert rewards.best_of_row({"a": 1.0}) == {"a"}


def test_the_papers_table_is_typed_right():
    table = paper.read_paper()
    assert len(table) == 188
    assert {algo for _, _, algo in table} == set(paper.COLORS)
    assert list(dict.fromkeys((task, batch) for task, batch, _ in table)) == list(PAPER_ROWS)
    for (task, batch), (means, errors, bold) in PAPER_ROWS.items():
        row = {algo: stat for (t, b, algo), stat in table.items() if (t, b) == (task, batch)}
        assert sum(stat.mean for stat in row.values()) == pytest.approx(means, abs=1e-9)
        assert sum(stat.se for stat in row.values()) == pytest.approx(errors, abs=1e-9)
        assert rewards.best_of_row({algo: stat.mean for algo, stat in row.items()}) == bold
    assert table["R+L2", "default", "DPro"][:2] == (-4.65, 0.59)
    assert table["HC+O", "16", "SRad"][:2] == (7459, 169)


# ---- tables and figures ----


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """The folder of an unfinished benchmark's results after plotting, and the printed output."""
    root = tmp_path_factory.mktemp("results")
    for seed in range(10):
        write_run(root, "R+L2", "DPro", seed, result=-5.0 + 0.1 * seed)
    for algo, value in (("SRad", 15.0), ("DOpt", 19.0), ("NFW", 19.5), ("Mine", 12.0)):
        for seed in range(3):
            write_run(root, "R+L2", algo, seed, result=value + 0.1 * seed)
    write_run(root, "R+L2", "SRad", 3, evaluations=2)
    write_run(root, "R+L2", "SRad", 4, evaluations=0)
    write_run(root, "R+N", "DPro", 0, result=17.0)
    write_run(root, "W+M", "DRad", 0, result=4000.0, overrides={"batch_size": 16})
    write_run(root, "W+M", "DRad", 0, result=4400.0)
    write_run(root, "X+Y", "DRad", 0, evaluations=1)
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", printed)
        assert plot.main([str(root)]) == 0
    return root, printed.getvalue()


def test_reward_records(mixed):
    root, _ = mixed
    cells = {(r["task"], r["settings"], r["algo"]): r for r in records(root, "rewards")}
    assert set(cells) == {
        *(("R+L2", "", algo) for algo in ("DPro", "DOpt", "NFW", "SRad", "Mine")),
        ("R+N", "", "DPro"),
        ("W+M", "", "DRad"),
        ("W+M", "batch_size=16", "DRad"),
    }
    dpro = cells["R+L2", "", "DPro"]
    returns = [-5.0 + 0.1 * seed for seed in range(10)]
    assert float(dpro["mean"]) == pytest.approx(np.mean(returns))
    assert float(dpro["se"]) == pytest.approx(stats.sem(returns))
    assert (dpro["n"], dpro["bold"]) == ("10", "0")
    assert (cells["R+L2", "", "SRad"]["n"], cells["R+L2", "", "SRad"]["bold"]) == ("3", "1")
    assert cells["R+L2", "", "Mine"]["bold"] == "0"
    assert float(cells["W+M", "batch_size=16", "DRad"]["mean"]) == 4000


def test_markdown(mixed):
    root, _ = mixed
    text = (root / "tables" / "rewards.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|\n").split("|")] for line in text.splitlines() if "|" in line]
    # Columns are for algorithms with results, and for those that coincide with one of them without a constraint.
    same = [algo for algo in paper.COLORS if paper.SAME_WITHOUT_CONSTRAINT.get(algo) == "DPro"]
    used = [algo for algo in paper.COLORS if algo in ("DPro", "NFW", "DRad", "SRad", *same)]
    assert rows[0] == ["Condition", *used, "Mine"]
    row = dict(zip(rows[0], rows[3], strict=True))
    assert [r[0] for r in rows[2:]] == ["R+N", "R+L2", "W+M", "W+M batch_size=16"]
    assert row["DPro"] == "-4.55 ± 0.10"
    assert row["NFW"] == "**19.60** ± 0.06 n=3"
    assert row["SRad"] == "**15.10** ± 0.06 n=3"
    assert row["Mine"] == "12.10 ± 0.06 n=3"
    assert row["DPre"] == "–"
    unconstrained = dict(zip(rows[0], rows[2], strict=True))
    assert (unconstrained["DPro"], unconstrained["DOpt+"]) == ("**17.00** n=1", "Same as DPro")
    assert unconstrained["NFW"] == "–" and "SPre+" not in unconstrained
    assert "R+L2 SRad: seed 3, 4, evaluated to step 0 to 10,000 of 20,000" in text
    assert "X+Y DRad: seed 0, evaluated to step 5,000 of 20,000" in text


def test_comparison_with_the_paper(mixed):
    root, printed = mixed
    cells = {(r["task"], r["settings"], r["algo"]): r for r in records(root, "comparison")}
    nfw = cells["R+L2", "", "NFW"]
    assert (nfw["paper_mean"], nfw["paper_se"]) == ("19.7", "0.33")
    assert float(nfw["difference"]) == pytest.approx(19.6 - 19.7)
    assert float(nfw["joint_errors"]) == pytest.approx(-0.1 / math.hypot(0.33, stats.sem([19.5, 19.6, 19.7])))
    assert cells["W+M", "batch_size=16", "DRad"]["paper_mean"] == "4013.0"
    assert cells["W+M", "", "DRad"]["paper_mean"] == "4341.0"
    assert cells["R+L2", "", "Mine"]["paper_mean"] == "" and cells["R+L2", "", "Mine"]["mean"] == "12.1"
    assert re.search(r"R\+L2 +Mine +12\.10 ± 0\.06 n=3 +– +– +–", printed)
    assert re.search(r"R\+N +DPro +17\.00 n=1 +17\.57 ± 0\.27 +-0\.57 +–", printed)
    assert re.search(r"R\+L2 +DPro +-4\.55 ± 0\.10 +-4\.65 ± 0\.59 +\+0\.10 +\+0\.2", printed)


def test_terminal(mixed):
    _, printed = mixed
    assert "\x1b" not in printed  # not a terminal
    assert "R+L2 SRad: seed 3, 4" in printed
    table = printed[printed.index("Rewards:") :]
    header = next(line for line in table.splitlines() if line.startswith("Condition"))
    assert header.split() == ["Condition", "DPro", "DOpt", "NFW", "DRad", "SRad", "Mine"]
    assert "tables" in printed.splitlines()[-2] and "figures" in printed.splitlines()[-1]


def test_terminal_wraps_and_prints_bold(mixed):
    root, _ = mixed
    runs, _ = results.read_results(root)
    table = rewards.reward_table(grouping.group_runs(runs)[0])
    narrow = tables.to_terminal(table, bold=True, width=40)
    plain = re.sub(r"\x1b\[\d?m", "", narrow)
    assert max(map(len, plain.splitlines()[1:])) <= 40
    assert all(algo in plain for algo in ("DPro", "DOpt", "NFW", "DRad", "SRad", "Mine"))
    bold = [text.strip() for text in re.findall(r"\x1b\[1m(.*?)\x1b\[0m", narrow)]
    assert sorted(bold) == sorted(["17.00", "19.60", "19.10", "15.10", "4400", "4000"])


def test_latex(mixed):
    root, _ = mixed
    text = (root / "tables" / "rewards.tex").read_text()
    assert text.count(r"\begin") == text.count(r"\end") == 2
    body = text[text.index("Condition &") : text.index(r"\bottomrule")]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert r" & \multicolumn{5}{c}{Same as DPro} & " in next(line for line in rows if line.startswith("R+N"))
    widths = [1 + line.count("&") + sum(int(n) - 1 for n in re.findall(r"multicolumn{(\d+)}", line)) for line in rows]
    assert set(widths) == {11}
    assert r"\textbf{19.60}" in body and r"$\pm$ 0.06" in body and "$-$4.55" in body
    assert r"batch\_size=16" in body and "±" not in body and "–" not in body
    assert (
        r"\multicolumn{8}{c}{TD3 family} & \multicolumn{1}{c}{SAC family} & \multicolumn{1}{c}{beyond the paper}"
        in text
    )
    assert r"\cmidrule(lr){10-10}\cmidrule(lr){11-11}" in text


def test_figures(mixed):
    root, _ = mixed
    names = ["R+L2", "R+N", "W+M", "W+M,batch_size=16", "W+M-training", "X+Y", "aggregate", "improvement"]
    files = sorted(path.name for path in (root / "figures").iterdir())
    assert files == sorted(f"{name}.{suffix}" for name in names for suffix in ("png", "pdf"))
    for name in names:
        assert (root / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert (root / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    labels = {
        algo: figures._legend(algo, runs)
        for condition, by_algo in grouping.group_runs(results.read_results(root)[0])[0].items()
        for algo, runs in by_algo.items()
        if condition == ("R+L2", "")
    }
    assert labels["SRad"] == "SRad (3 of 5 seeds finished)"
    assert (labels["DPro"], labels["NFW"]) == ("DPro", "NFW (n=3)")


def test_different_configurations_are_never_averaged(tmp_path):
    write_run(tmp_path, "R+N", "SRad", 0, result=10.0, threads=1)
    write_run(tmp_path, "R+N", "SRad", 1, result=20.0, threads=2)  # does not change what is learned
    write_run(tmp_path, "R+N", "SRad", 2, result=1000.0, gamma=0.5)
    write_run(tmp_path, "R+N", "SRad", 0, result=50.0, overrides={"batch_size": 16})
    write_run(tmp_path, "R+N", "DRad", 0, result=30.0)
    assert plot.main([str(tmp_path)]) == 0
    found = {(r["settings"], r["algo"], float(r["mean"]), r["n"]) for r in records(tmp_path, "rewards")}
    assert found == {
        ("", "DRad", 30.0, "1"),
        ("batch_size=16", "SRad", 50.0, "1"),
        ("gamma=0.5", "SRad", 1000.0, "1"),
        ("gamma=0.99", "SRad", 15.0, "2"),
    }
    names = ["R+N", "R+N,batch_size=16", "R+N,gamma=0.5", "R+N,gamma=0.99", "R+N-training", "aggregate,gamma=0.99"]
    assert sorted(path.stem for path in (tmp_path / "figures").glob("*.png")) == names


def test_an_override_and_an_older_default_keep_rows_of_their_own(tmp_path):
    write_run(tmp_path, "R+N", "SRad", 0, result=10.0, tau=0.1, gamma=0.99)
    write_run(tmp_path, "R+N", "SRad", 1, result=20.0, tau=0.2, gamma=0.99)
    write_run(tmp_path, "R+N", "SRad", 2, result=30.0, overrides={"tau": 0.1}, gamma=0.5)
    groups, repeated = grouping.group_runs(results.read_results(tmp_path)[0])
    assert not repeated
    cells = {condition.settings: [run.seed for run in by_algo["SRad"]] for condition, by_algo in groups.items()}
    assert cells == {"gamma=0.99, tau=0.1": [0], "tau=0.2": [1], "gamma=0.5, tau=0.1": [2]}


def test_a_setting_that_came_later_divides_only_who_has_it(tmp_path):
    """Runs older than a setting lack its key; algorithms without it have None. Labels distinguish 1 and 1.0."""
    write_run(tmp_path, "R+N", "DRad", 0, result=10.0)
    write_run(tmp_path, "R+N", "DRad", 1, result=10.0, entropy=None)
    write_run(tmp_path, "R+N", "SRad", 0, result=10.0)
    write_run(tmp_path, "R+N", "SRad", 1, result=10.0, entropy="paper")
    write_run(tmp_path, "R+N", "NFW", 0, result=10.0, tau=1)
    write_run(tmp_path, "R+N", "NFW", 1, result=10.0, tau=1.0)
    groups, _ = grouping.group_runs(results.read_results(tmp_path)[0])
    cells = {(c.settings, algo): [run.seed for run in runs] for c, row in groups.items() for algo, runs in row.items()}
    assert cells == {
        ("", "DRad"): [0, 1],
        ("entropy=null", "SRad"): [0],
        ("entropy=paper", "SRad"): [1],
        ("tau=1", "NFW"): [0],
        ("tau=1.0", "NFW"): [1],
    }


def test_a_repeated_seed_counts_once(tmp_path, capsys):
    write_run(tmp_path, "R+N", "SRad", 0, result=10.0)
    write_run(tmp_path, "R+N", "SRad", 0, result=30.0, overrides={"gamma": 0.99})
    assert plot.main([str(tmp_path), "format=csv"]) == 0
    assert "the same configuration and seed as" in capsys.readouterr().err
    assert [(r["mean"], r["n"]) for r in records(tmp_path, "rewards")] == [("10.0", "1")]


def test_a_failed_run_is_listed_and_marked(tmp_path, capsys):
    for seed, value in enumerate((10.0, 12.0, math.nan)):
        write_run(tmp_path, "R+N", "SRad", seed, result=value)
    assert plot.main([str(tmp_path)]) == 0
    assert "R+N SRad: seed 2 failed, its return is not a number" in capsys.readouterr().out
    (cell,) = records(tmp_path, "rewards")
    assert (cell["mean"], cell["n"], cell["failed"]) == ("11.0", "2", "1")
    assert "**11.00** ± 1.00 n=2 1 failed" in (tmp_path / "tables" / "rewards.md").read_text()


def test_one_run_in_progress_is_enough(tmp_path, capsys):
    write_run(tmp_path, "R+N", "SRad", 0, evaluations=2)
    assert plot.main([str(tmp_path)]) == 0
    assert "R+N SRad: seed 0, evaluated to step 10,000" in capsys.readouterr().out
    assert (tmp_path / "figures" / "R+N.png").exists()
    assert not (tmp_path / "tables").exists()


def test_a_run_is_plotted_while_it_writes(tmp_path):
    """A run can be plotted at every moment between two writes, and at one moment within a write."""
    writer = write_run(tmp_path, "R+L2", "SPre", 0, evaluations=0)
    assert plot.main([str(tmp_path), "format=png"]) == 0
    for step in (5_000, 10_000):
        writer.append_evaluation(step, [1.0, 2.0, 3.0], 1.0)
        assert plot.main([str(tmp_path), "format=png"]) == 0
        assert results.read_run(writer.folder).evaluations.step[-1] == step
        writer.append_statistics(step, {"temperature": 0.5, "entropy": -1.0})
        assert plot.main([str(tmp_path), "format=png"]) == 0
    for name in ("evaluations.csv", "training.csv"):
        with open(writer.folder / name, "a") as file:
            file.write("15000,1.")
    assert plot.main([str(tmp_path), "format=png"]) == 0
    run = results.read_run(writer.folder)
    assert run.training["step"].tolist() == run.evaluations.step.tolist() == [5_000, 10_000]
    names = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert names == ["R+L2-training.png", "R+L2.png"]


def test_training_measures_side_by_side(tmp_path, monkeypatch):
    for seed in range(2):
        writer = write_run(tmp_path, "R+L2", "SRad", seed)
        for i, step in enumerate((10_000, 15_000)):
            writer.append_statistics(step, {"temperature": 0.1 + i, "entropy": -1.0 - seed})
    writer = write_run(tmp_path, "R+L2", "SRad", 0, overrides={"log_det_floor": 1e-6})
    writer.append_statistics(10_000, {"temperature": 0.7, "entropy": -3.0})
    write_run(tmp_path, "R+L2", "DRad", 0)
    drawn = {}
    with monkeypatch.context() as patch:
        patch.setattr(figures, "save", lambda figure, folder, name, formats: drawn.setdefault(name, figure) and [])
        assert plot.main([str(tmp_path)]) == 0
    returns, temperature, entropy = drawn["R+L2-training"].axes
    assert "return" in returns.get_ylabel() and "Temperature" in temperature.get_ylabel()
    assert temperature.get_yscale() == "log" and entropy.get_yscale() == "linear"
    np.testing.assert_allclose(temperature.lines[0].get_xydata(), [[10_000, 0.1], [15_000, 1.1]])
    np.testing.assert_allclose(entropy.lines[0].get_ydata(), [-1.5, -1.5])
    np.testing.assert_allclose(entropy.lines[1].get_xydata(), [[10_000, -3.0]])
    first, second = (line.get_label() for line in returns.lines)  # DRad has no such measures
    assert first.startswith("SRad (0 of 2") and second.endswith("log_det_floor=1e-06")
    assert returns.lines[0].get_linestyle() != returns.lines[1].get_linestyle()
    assert plot.main([str(tmp_path), "format=pdf"]) == 0
    assert (tmp_path / "figures" / "R+L2-training.pdf").exists()


def test_measures_in_another_order_share_their_panels(tmp_path, monkeypatch):
    write_run(tmp_path, "R+L2", "SRad", 0).append_statistics(10_000, {"temperature": 0.1, "entropy": -1.0})
    write_run(tmp_path, "R+L2", "SPre", 0).append_statistics(10_000, {"entropy": -2.0, "temperature": 0.2})
    drawn = {}
    monkeypatch.setattr(figures, "save", lambda figure, folder, name, formats: drawn.setdefault(name, figure) and [])
    assert plot.main([str(tmp_path)]) == 0
    panels = {axes.get_ylabel(): axes for axes in drawn["R+L2-training"].axes}
    assert len(panels) == 3
    (entropy,) = [axes for label, axes in panels.items() if "ntropy" in label]
    assert sorted(line.get_ydata()[0] for line in entropy.lines) == [-2.0, -1.0]


@pytest.mark.parametrize("longer", ["SRad", "DRad"])
def test_no_curve_is_cut_where_the_rows_of_a_figure_have_different_lengths(tmp_path, monkeypatch, longer):
    for algo, measure in (("SRad", "temperature"), ("DRad", "mean_q")):
        writer = write_run(tmp_path, "R+L2", algo, 0, evaluations=12 if algo == longer else 3)
        writer.append_statistics(10_000, {measure: 1.0})
    drawn = {}
    monkeypatch.setattr(figures, "save", lambda figure, folder, name, formats: drawn.setdefault(name, figure) and [])
    assert plot.main([str(tmp_path)]) == 0
    panels = drawn["R+L2-training"].axes
    last = max(line.get_xdata().max() for axes in panels for line in axes.lines)
    assert all(axes.get_xlim()[0] == 0 and last <= axes.get_xlim()[1] <= 1.1 * last for axes in panels)


@pytest.mark.parametrize("last", [0.2, 40.0, 1e17])
def test_temperatures_have_ticks_over_any_range(tmp_path, monkeypatch, last):
    writer = write_run(tmp_path, "R+T", "SRad", 0)
    for step, temperature in ((10_000, 0.1), (15_000, last)):
        writer.append_statistics(step, {"temperature": temperature, "entropy": -1.0})
    drawn = {}
    monkeypatch.setattr(figures, "save", lambda figure, folder, name, formats: drawn.setdefault(name, figure) and [])
    assert plot.main([str(tmp_path)]) == 0
    axes = drawn["R+T-training"].axes[1]
    low, high = axes.get_ylim()
    assert 2 <= sum(low <= tick <= high for tick in axes.get_yticks()) <= 12


@pytest.mark.parametrize("content", ["what\n1\n", "step,temperature\n1\n", "step,temperature\nx,y\n"])
def test_a_corrupt_training_file_is_named(tmp_path, content):
    path = write_run(tmp_path, "R+N", "SRad", 0).folder / "training.csv"
    path.write_text(content)
    runs, problems = results.read_results(tmp_path)
    assert not runs and len(problems) == 1 and problems[0].startswith(f"{path}: ")


def test_the_whole_benchmark_in_small(tmp_path, capsys):
    """All 13 algorithms under all 16 conditions, fewer seeds and evaluations than the paper."""
    write_results(tmp_path, seeds=2, evaluations=22)
    assert plot.main([str(tmp_path), "format=csv,tex,pdf"]) == 0
    printed = capsys.readouterr().out
    assert "Not in the tables" not in printed
    rows = records(tmp_path, "rewards")
    assert len(rows) == 13 * len(CONDITIONS) == 208 and {row["n"] for row in rows} == {"2"}
    # The paper's own settings come first, then a rule and the rows of batch size 16.
    body = (tmp_path / "tables" / "rewards.tex").read_text().split(r"\midrule")
    assert [re.findall(r"^([RHW]\S*) &", part, flags=re.MULTILINE) for part in body[1:]] == [
        [task for task, batch in CONDITIONS if batch == size] for size in ("default", "16")
    ]
    assert body[2].count(r"batch\_size=16") == 3
    names = {path.stem for path in (tmp_path / "figures").glob("*.pdf")}
    tasks = {task if batch == "default" else f"{task},batch_size=16" for task, batch in CONDITIONS}
    assert names == {
        *tasks,
        *(f"{task}-training" for task, _ in CONDITIONS),
        *(f"{kind}{suffix}" for kind in ("aggregate", "improvement") for suffix in ("", ",batch_size=16")),
    }


def test_options(tmp_path):
    root, out = tmp_path / "results", tmp_path / "out"
    for task in ("R+N", "W+M"):
        for algo in ("DPre+", "SRad", "NFW"):
            write_run(root, task, algo, 0, result=1.0)
    assert plot.main([str(root), "env=W+M", "algo=SRad,DPre+", f"out={out}", "format=csv,png"]) == 0
    assert {(r["task"], r["algo"]) for r in records(out, "rewards")} == {("W+M", "DPre+"), ("W+M", "SRad")}
    files = {str(path.relative_to(out)) for path in out.rglob("*.*")}
    assert files == {"tables/rewards.csv", "tables/comparison.csv", "figures/W+M.png"}
    assert not (root / "tables").exists()


def test_usage(capsys):
    for arguments in ([], ["--help"], ["results", "--help"]):
        assert plot.main(arguments) == 0
        printed = capsys.readouterr().out
        assert "python plot.py results/" in printed and "env=" in printed


def test_refusals(tmp_path, capsys):
    assert "not a folder" in refused_by_plot(capsys, tmp_path / "nowhere")
    assert "no runs in" in refused_by_plot(capsys, tmp_path)
    write_run(tmp_path, "W+M", "SRad", 0, result=1.0)
    write_run(tmp_path, "R+N", "DPre+", 0, result=1.0)
    assert "'evn'" in (line := refused_by_plot(capsys, tmp_path, "evn=W+M")) and "did you mean env?" in line
    assert "did you mean SRad?" in (line := refused_by_plot(capsys, tmp_path, "algo=srat")) and "DPre+" in line
    assert "choices: R+N, W+M" in refused_by_plot(capsys, tmp_path, "env=HC+O")
    assert "choices: md, csv, tex, png, pdf" in refused_by_plot(capsys, tmp_path, "format=jpg")
    assert "given twice" in refused_by_plot(capsys, tmp_path, "env=W+M", "env=R+N")
    assert "expected key=value, got 'env='" in refused_by_plot(capsys, tmp_path, "env=")
    assert "more is not a folder" in refused_by_plot(capsys, tmp_path, "more")
    assert "unexpected 'more'" in refused_by_plot(capsys, "maps", "more")
    assert "env= applies to a folder of results, not to tables" in refused_by_plot(capsys, "tables", "env=W+M")
    assert "choices: png, pdf" in refused_by_plot(capsys, "maps", "format=md")
    assert "expected a folder of results, got none" in refused_by_plot(capsys, "env=W+M")
    assert "no readable runs" in refused_by_plot(capsys, tmp_path, "env=W+M", "algo=DPre+")
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "file" in refused_by_plot(capsys, tmp_path, f"out={blocked}")
    assert not (tmp_path / "tables").exists()


def test_command_line(tmp_path):
    command = [sys.executable, str(ROOT / "plot.py")]
    done = subprocess.run([*command, "nowhere"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "plot.py: nowhere is not a folder\n")
    write_run(tmp_path / "results", "R+N", "SRad", 0, result=18.0)
    done = subprocess.run([*command, "results/"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "results" / "figures" / "R+N.pdf").exists()
