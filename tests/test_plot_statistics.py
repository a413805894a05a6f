"""Aggregates over tasks (plots/statistics.py, plots/aggregates.py) against their definitions and SciPy."""

import csv
import math

import numpy as np
import pytest
from helpers import write_run
from scipy import stats

import plot
from plots import statistics
from plots.grouping import group_runs
from store.folder import read_results


@pytest.fixture
def two():
    """Scores of two algorithms on three tasks, four to six runs each."""
    rng = np.random.default_rng(1)
    sizes = {"R+N": 4, "R+L2": 6, "R+M": 5}
    first = {task: rng.normal(1.0, 0.2, n) for task, n in sizes.items()}
    return first, {task: rng.normal(0.9, 0.2, n + 1) for task, n in sizes.items()}


def write_cell(root, task, algo, returns, **settings):
    for seed, value in enumerate(returns):
        write_run(root, task, algo, seed, result=float(value), evaluations=0, **settings)


def scores_of(root):
    return statistics.normalised_scores(group_runs(read_results(root)[0])[0])


def test_interquartile_mean(two):
    pooled = np.sort(np.concatenate(list(two[0].values())))  # 15 runs: three cut off at each end
    estimate = statistics.interquartile_mean(two[0])
    assert estimate.value == pytest.approx(pooled[3:-3].mean())
    assert estimate.low < estimate.value < estimate.high


def test_the_bootstrap_is_stratified(two):
    """If tasks differ widely but the runs of a task do not, the interval is a single point."""
    scores = {task: np.full(5, float(level)) for level, task in enumerate(two[0])}
    estimate = statistics.interquartile_mean(scores)
    assert estimate.low == estimate.high == estimate.value == pytest.approx(1.0)


def test_intervals_cover_the_truth():
    """Of 95 % intervals about 95 % hold the true value; a wrong resampling would be far off."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(60):
        estimate = statistics.interquartile_mean({task: rng.normal(0.5, 0.1, 20) for task in "abc"})
        hits += estimate.low <= 0.5 <= estimate.high
    assert 50 <= hits <= 60


def test_performance_profile(two):
    thresholds = np.array([-1.0, 0.9, 1.0, 5.0])
    pooled = np.concatenate(list(two[0].values()))
    estimate = statistics.performance_profile(two[0], thresholds)
    np.testing.assert_allclose(estimate.value, [(pooled > t).mean() for t in thresholds])
    assert estimate.value[0] == 1.0 and estimate.value[-1] == 0.0
    assert (estimate.low <= estimate.value).all() and (estimate.value <= estimate.high).all()
    assert estimate.low[1] < estimate.high[1]


def test_probability_of_improvement(two):
    first, second = two
    second["R+N"][:2] = first["R+N"][:2]  # ties count half
    expected = np.mean(
        [stats.mannwhitneyu(first[t], second[t]).statistic / (len(first[t]) * len(second[t])) for t in first]
    )
    estimate = statistics.probability_of_improvement(first, second)
    assert estimate.value == pytest.approx(expected)
    assert estimate.low < estimate.value < estimate.high
    assert statistics.probability_of_improvement(second, first).value == pytest.approx(1 - expected)
    del second["R+M"]  # over common tasks only
    only = {task: first[task] for task in second}
    assert statistics.probability_of_improvement(first, second).value == pytest.approx(
        statistics.probability_of_improvement(only, second).value
    )


def test_scores_are_normalised_by_the_best_cell_of_the_papers_row(tmp_path):
    assert statistics.reference("R+L2") == 19.70 and statistics.reference("HC+O") == 9973
    assert statistics.reference("R+CBF") is None
    write_cell(tmp_path, "R+L2", "SRad", [19.70, 0.0])
    write_cell(tmp_path, "HC+O", "SRad", [9973, -9973], overrides={"batch_size": 16})
    write_cell(tmp_path, "R+CBF", "SRad", [1.0, 2.0])
    write_cell(tmp_path, "R+M", "SRad", [1.0])  # a single run has no spread
    write_run(tmp_path, "R+L2", "SRad", 7)  # unfinished
    scores = scores_of(tmp_path)
    assert {settings: {a: list(t) for a, t in s.items()} for settings, s in scores.items()} == {
        "": {"SRad": ["R+L2"]},
        "batch_size=16": {"SRad": ["HC+O"]},
    }
    assert scores[""]["SRad"]["R+L2"].tolist() == [1.0, 0.0]
    assert scores["batch_size=16"]["SRad"]["HC+O"].tolist() == [1.0, -1.0]


def test_where_algorithms_coincide_they_share_runs(tmp_path):
    write_cell(tmp_path, "R+N", "DPro", [10.0, 12.0])
    write_cell(tmp_path, "R+N", "DOpt", [14.0, 15.0])
    for algo in ("DPro", "DOpt", "DPre+"):
        write_cell(tmp_path, "R+L2", algo, [18.0, 19.0])
    scores = scores_of(tmp_path)[""]
    assert set(scores) == {"DPro", "DOpt", "DPre+"}
    np.testing.assert_array_equal(scores["DPre+"]["R+N"], scores["DPro"]["R+N"])
    assert scores["DOpt"]["R+N"][0] == pytest.approx(14.0 / 18.61)
    assert statistics.comparable(scores) == {("R+N", "R+L2"): ["DPro", "DPre+", "DOpt"]}


def test_a_failed_run_is_worse_than_any_other(tmp_path):
    write_cell(tmp_path, "R+L2", "SRad", [math.nan, 10.0, 11.0, 12.0, 13.0])
    write_cell(tmp_path, "R+L2", "SPre", [-100.0] * 5)
    scores = scores_of(tmp_path)[""]
    assert scores["SRad"]["R+L2"][0] == -math.inf
    assert statistics.interquartile_mean(scores["SRad"]).value == pytest.approx(11.0 / 19.70)
    assert statistics.probability_of_improvement(scores["SRad"], scores["SPre"]).value == pytest.approx(0.8)


def test_what_is_written(tmp_path, capsys):
    """Only algorithms on the same tasks share a section; other settings are never mixed in."""
    write_cell(tmp_path, "R+L2", "SRad", [10.0, 11.0, 12.0])
    write_cell(tmp_path, "R+L2", "DRad", [15.0, 16.0, 17.0])
    write_cell(tmp_path, "R+M", "DRad", [15.0, 16.0, 17.0])
    write_cell(tmp_path, "R+L2", "NFW", [1.0, 2.0], overrides={"tau": 0.5})
    assert plot.main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "Probability of improvement" in printed and "R+L2, tau=0.5" in printed

    def read(name):
        with open(tmp_path / "tables" / f"{name}.csv", newline="") as file:
            return list(csv.DictReader(file))

    means = {(row["settings"], row["algo"]): row for row in read("aggregate")}
    assert {key: (row["tasks"], row["runs"]) for key, row in means.items()} == {
        ("", "DRad"): ("R+L2 R+M", "6"),
        ("", "SRad"): ("R+L2", "3"),
        ("tau=0.5", "NFW"): ("R+L2", "2"),
    }
    assert float(means["", "SRad"]["interquartile_mean"]) == pytest.approx(11.0 / 19.70)
    pairs = {(row["algo"], row["over"]): row for row in read("improvement")}
    assert set(pairs) == {("DRad", "SRad"), ("SRad", "DRad")}
    for bound, other in (("probability", "probability"), ("low", "high"), ("high", "low")):
        assert float(pairs["DRad", "SRad"][bound]) == pytest.approx(1 - float(pairs["SRad", "DRad"][other]))
    assert pairs["DRad", "SRad"]["probability"] == "1.0" and pairs["DRad", "SRad"]["tasks"] == "1"
    text = (tmp_path / "tables" / "improvement.md").read_text()
    assert "|  | DRad | – | **1.00** |" in text and "| SRad | 0.00 | – |" in text
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert {"aggregate.png", "aggregate.pdf", "aggregate,tau=0.5.png", "improvement.png"} <= names
    assert "improvement,tau=0.5.png" not in names
