"""Tables and figures of a user's own algorithms, of several settings, and of diverged seeds."""

import csv
import math

from helpers import refused_by_plot, write_run

import plot
from algos import ALGORITHMS, PAPER
from plots import style
from plots.grouping import group_runs
from plots.paper import COLORS, LATER, first_beyond, order_algos
from plots.rewards import comparison_table, reward_table
from store.folder import read_results


def records(root, table):
    with open(root / "tables" / f"{table}.csv", newline="") as file:
        return list(csv.DictReader(file))


def failed_run(root, task, algo, seed, result):
    """Write a run that diverged; `result` has the form that the trainer writes."""
    writer = write_run(root, task, algo, seed, evaluations=2)
    writer.fail({"step": 12_345, "quantity": "critic loss is not finite", "result": result})
    return writer


def test_own_algorithms_can_be_told_apart(tmp_path, drawn):
    names = [f"Mine{i}" for i in range(30)]
    own = style.own_algos([*names, "SRad", *LATER])
    assert own == sorted(names)
    looks = {(line["color"], line["linestyle"]) for line in (style.line_of(name, own, 100) for name in names)}
    assert len(looks) == 30 and len({style.color_of(name, own) for name in names[:10]}) >= 8
    taken = {*COLORS.values(), *LATER.values()}
    assert len(taken) == len(COLORS) + len(LATER)
    assert not taken & set(style.OWN_COLORS) and len(set(style.OWN_COLORS)) == len(style.OWN_COLORS)
    for task, algos in {"R+L2": ("Mine", "Other", "SRad"), "R+N": ("Other", "Zeta")}.items():
        for algo in algos:
            for seed in range(2):
                write_run(tmp_path, task, algo, seed, result=1.0 + seed)
    assert plot.main([str(tmp_path)]) == 0
    colors = [
        {line.get_label().split(" ")[0]: line.get_color() for line in drawn[task].axes[0].lines}
        for task in ("R+L2", "R+N")
    ]
    assert len(set(colors[0].values())) == 3
    assert colors[0]["Other"] == colors[1]["Other"] != colors[1]["Zeta"]  # the same in every figure
    lines = [line for axes in drawn["aggregate"].axes for line in axes.lines]
    profiles = {line.get_label(): line.get_color() for line in lines}
    assert profiles["Mine"] == colors[0]["Mine"]


def test_methods_beyond_the_paper_stand_apart_after_the_papers(tmp_path, drawn):
    names = ["DPre", "SRad", "DGauge", "SGauge", "ARAM", "A"]
    assert {*COLORS, *LATER} == {*ALGORITHMS} and list(COLORS) == list(PAPER)
    assert order_algos(reversed(names)) == names
    assert first_beyond(names) == 2 and first_beyond(names[:2]) is None and first_beyond(names[2:]) is None
    for algo in names:
        for seed in range(2):
            write_run(tmp_path, "R+L2", algo, seed, result=1.0 + seed)
    assert plot.main([str(tmp_path)]) == 0
    groups = group_runs(read_results(tmp_path)[0])[0]
    assert reward_table(groups).spans == {"TD3 family": 1, "SAC family": 1, "beyond the paper": 4}
    legend = [text.get_text().split(" (")[0] for text in drawn["R+L2"].legends[0].get_texts()]
    assert legend == ["DPre", "SRad", "beyond the paper", *names[2:]]
    means, profiles = drawn["aggregate"].axes
    texts = [text.get_text() for text in profiles.get_legend().get_texts()]
    assert texts == ["DPre", "SRad", "beyond the paper", *names[2:]]
    assert any(set(line.get_ydata()) == {1.5} for line in means.lines)


def test_the_comparison_lists_own_algorithms_beside_the_papers(tmp_path):
    write_run(tmp_path, "R+L2", "SRad", 0, result=15.0)
    write_run(tmp_path, "R+L2", "Mine", 0, result=16.0)
    assert plot.main([str(tmp_path), "format=csv"]) == 0
    mine, srad = sorted(records(tmp_path, "comparison"), key=lambda record: record["algo"])
    assert (mine["algo"], mine["mean"], mine["paper_mean"], mine["difference"]) == ("Mine", "16.0", "", "")
    assert srad["algo"] == "SRad" and float(srad["paper_mean"]) > 0
    (tmp_path / "other").mkdir()
    write_run(tmp_path / "other", "My+Task", "Mine", 0, result=16.0)
    assert plot.main([str(tmp_path / "other"), "format=csv"]) == 0
    assert not (tmp_path / "other" / "tables" / "comparison.csv").exists()  # there is nothing to compare with


def test_columns_are_those_with_results_and_the_papers_on_request(tmp_path, capsys):
    for algo in ("SRad", "Mine"):
        write_run(tmp_path, "R+L2", algo, 0, result=15.0)
    write_run(tmp_path, "R+L2", "SRad", 0, result=14.0, overrides={"batch_size": 16})
    groups = group_runs(read_results(tmp_path)[0])[0]
    table = reward_table(groups)
    assert table.header == ["Condition", "SRad", "Mine"] and table.spans == {"SAC family": 1, "beyond the paper": 1}
    beside = reward_table(groups, beside=True)
    printed = [f"{algo} (paper)" for algo in COLORS]
    assert [head for head in beside.header if head.endswith("(paper)")] == printed
    assert [head for head in beside.header if not head.endswith("(paper)")] == ["Condition", "SRad", "Mine"]
    (row,), (other,) = beside.sections
    assert all(len(cells) == len(beside.header) for cells in (row, other))
    values = dict(zip(beside.header, row, strict=True))
    assert values["SRad"].lines[0] == "15.00" and float(values["SRad (paper)"].lines[0]) > 0
    assert beside.header.index("SRad (paper)") == beside.header.index("SRad") + 1
    assert other[beside.header.index("SRad (paper)")].missing  # the paper has no such batch size on this task
    assert sum(beside.spans.values()) == len(beside.header) - 1
    assert plot.main([str(tmp_path), "paper=beside", "format=md,tex,csv"]) == 0
    assert "SRad (paper)" in (tmp_path / "tables" / "rewards.md").read_text()
    capsys.readouterr()
    assert "unknown value of paper 'yes'" in refused_by_plot(capsys, tmp_path, "paper=yes")


def test_settings_of_all_rows_are_in_the_title_and_other_rows_stand_below(tmp_path, capsys):
    short = {"steps": 1500, "hidden": [32, 32]}
    for seed in range(2):
        for task in ("R+L2", "W+M"):
            for algo in ("SRad", "DPre"):
                write_run(tmp_path, task, algo, seed, result=15.0 + seed, overrides=short)
        write_run(tmp_path, "R+L2", "Mine", seed, result=11.0 + seed, overrides=short | {"distance": 1.0})
        for algo in ("SRad", "DPre", "Mine"):
            write_run(tmp_path, "R+L2", algo, seed, result=12.0 + seed, overrides=short | {"tau": 0.1})
    assert plot.main([str(tmp_path), "format=md,tex,csv"]) == 0
    said = "; all runs with hidden=[32,32], steps=1500"
    groups = group_runs(read_results(tmp_path)[0])[0]
    sections = reward_table(groups).sections
    labels = [[" ".join(row[0].lines) for row in rows] for rows in sections]
    assert labels == [["R+L2", "W+M"], ["R+L2 tau=0.1"], ["R+L2 distance=1.0"]]
    assert [rows[0][0].lines[0] for rows in comparison_table(groups).sections] == [
        "R+L2",
        "R+L2, tau=0.1",
        "R+L2, distance=1.0",
    ]
    for name in ("rewards", "comparison", "adjusted", "aggregate", "improvement"):
        for suffix in ("md", "tex"):
            head, *body = (tmp_path / "tables" / f"{name}.{suffix}").read_text().splitlines()
            # Only the title has these settings.
            assert head.endswith(said) and "steps" not in "".join(body), (name, suffix)
    full = {record["settings"] for record in records(tmp_path, "rewards")}
    plain = "hidden=[32,32], steps=1500"
    assert full == {plain, f"distance=1.0, {plain}", f"{plain}, tau=0.1"}
    settings = [record["settings"] for record in records(tmp_path, "aggregate")]
    assert list(dict.fromkeys(settings)) == [plain, f"{plain}, tau=0.1", f"distance=1.0, {plain}"]
    # With a row of the paper's settings, no setting is shared, so every row names its own.
    write_run(tmp_path, "R+N", "SRad", 0, result=15.0)
    table = reward_table(group_runs(read_results(tmp_path)[0])[0])
    assert "all runs with" not in table.title and table.sections[0][0][0].lines == ("R+N",)
    assert table.sections[1][0][0].lines == ("R+L2", "hidden=[32,32]", "steps=1500")


def test_settings_of_one_algorithm_stand_in_one_figure_with_the_default(tmp_path, drawn):
    for overrides in ({}, {"learning_rate": 1e-4}, {"learning_rate": 1e-5}):
        config = {"learning_rate": overrides.get("learning_rate", 1e-3), "tau": 0.005}
        writer = write_run(tmp_path, "R+L2", "DPre", 0, overrides=overrides, **config)
        writer.append_statistics(10_000, {"critic_loss": 0.5, "actor_loss": -1.0, "mean_q": 2.0})
        write_run(tmp_path, "R+L2", "Mine", 0, overrides=overrides, **config)  # has no training measures
    write_run(tmp_path, "R+L2", "Other", 0, learning_rate=1e-3)  # no measures either, and only one setting
    assert plot.main([str(tmp_path)]) == 0
    figure = drawn["R+L2-training"]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    wanted = {f"{algo} (0 of 1 seed finished), learning_rate={value}" for algo in ("DPre", "Mine") for value in VALUES}
    assert set(labels) == wanted and len(labels) == 6
    quantities = [axes.get_ylabel() for axes in figure.axes]
    assert quantities == ["Evaluation return", "Critic loss", "Actor loss", "Mean q", "Evaluation return"]
    assert [len(axes.lines) for axes in figure.axes] == [3, 3, 3, 3, 3]
    assert figure.axes[1].get_yscale() == "log" and figure.axes[2].get_yscale() == "linear"


VALUES = ("0.001", "0.0001", "1e-05")


def test_a_diverged_seed_counts_with_its_best_parameters_and_a_dagger(tmp_path, capsys, drawn):
    for seed in range(3):
        write_run(tmp_path, "R+T", "SRad", seed, result=10.0)
    failed_run(tmp_path, "R+T", "SRad", 3, {"return_mean": 6.0, "returns": [6.0] * 50, "best_step": 5_000})
    failed_run(tmp_path, "R+T", "SRad", 4, None)
    failed_run(tmp_path, "R+T", "SRad", 5, "final evaluation: refused")
    assert plot.main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    (cell,) = records(tmp_path, "rewards")
    assert (cell["mean"], cell["n"], cell["failed"], cell["diverged"]) == ("9.0", "4", "2", "1")
    text = (tmp_path / "tables" / "rewards.md").read_text()
    assert "**9.00†** ± 1.00 n=4 1 of 6 diverged 2 failed" in text
    assert (
        "† In the tables:\n- R+T SRad: 1 of 6 seeds diverged and count with their best parameters before: seed 3"
        in text
    )
    assert "seed 3 failed at step 12345: critic loss is not finite (best parameters before: return 6.00)" in printed
    assert "R+T SRad: seed 4 failed at step 12345" in text.partition("†\nIn the tables")[0]
    assert r"9.00$^\dagger$" in (tmp_path / "tables" / "rewards.tex").read_text()
    assert "SRad†" in (tmp_path / "tables" / "aggregate.md").read_text()
    (line,) = drawn["R+T"].axes[0].lines
    assert line.get_label() == "SRad† (n=6, 3 of 6 diverged)"
    assert drawn["aggregate"].axes[1].lines[0].get_label() == "SRad†"
    assert not math.isnan(float(records(tmp_path, "aggregate")[0]["interquartile_mean"]))
