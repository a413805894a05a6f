"""Pictures of maps and actions (plots/illustrations.py), the tables made from definitions (plots/definitions.py), and
the runtime experiment from its measurement (bench/runtime.py) to its bars (plots/runtime.py)."""

import csv
import importlib.util
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from helpers import refused_by_plot, run_command

import envs
import plot
import tables
from algos import ALGORITHMS, PAPER, Algorithm
from algos.td3 import TD3
from core.maps import Project
from plots import definitions, illustrations, runtime
from store.folder import read_run

ROOT = Path(__file__).parents[1]

# ---- maps ----


def test_the_samples_show_what_the_maps_differ_in():
    constraint, obs = illustrations.polygon(), torch.zeros(1, dtype=torch.float64)
    samples = torch.tensor(illustrations.SAMPLES, dtype=torch.float64, requires_grad=True)
    projected = constraint.project(obs, samples)
    torch.testing.assert_close(projected[0], projected[1])
    (gradient,) = torch.autograd.grad(projected.sum(), samples)
    assert gradient.abs().max() < 1e-9
    alpha, radial = (constraint.alpha_map(obs, samples), constraint.radial_map(obs, samples))
    assert (alpha[0] - alpha[1]).norm() > 0.1
    assert constraint.violation(obs, alpha).abs().max() < 1e-9
    assert (constraint.violation(obs, radial) < -1e-3).all()


@pytest.mark.parametrize("task", ["R+N", "R+L2", "R+O10", "R+M", "R+T"])
def test_the_outline_is_the_boundary(task):
    constraint = envs.constraint(task)
    obs = torch.from_numpy(np.random.default_rng(0).normal(size=9))
    outline = torch.from_numpy(illustrations.boundary(constraint, obs))
    assert outline.shape == (1440, 2)
    assert constraint.violation(obs, outline).abs().max() < 1e-6


def test_maps(tmp_path):
    assert plot.main(["maps", f"out={tmp_path}"]) == 0
    assert (tmp_path / "figures" / "maps.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "figures" / "maps.pdf").read_bytes().startswith(b"%PDF")


# ---- actions ----


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a short run with one evaluation of one episode."""
    root = tmp_path_factory.mktemp("results")
    words = "algo=SRad env=R+M seed=5 steps=60 learning_starts=40 batch_size=8 hidden=16,16 eval_every=60"
    assert run_command([*words.split(), "eval_episodes=1", "final_episodes=1", f"results={root}"]) == 0
    (folder,) = root.glob("R+M/*/seed=5")
    return folder


def test_the_episode_is_the_first_evaluation(trained):
    finished = read_run(trained)
    episode = illustrations.play(finished)
    assert episode.obs.shape == (150, 9) and episode.action.shape == (150, 2)
    assert episode.reward.sum() == pytest.approx(finished.evaluations.returns[0, 0], rel=1e-5)
    obs, action = torch.from_numpy(episode.obs), torch.from_numpy(episode.action).double()
    assert envs.constraint("R+M").violation(obs, action).max() <= envs.TOLERANCE


def test_actions(trained, tmp_path, capsys):
    assert plot.main(["actions", str(trained)]) == 0
    results = trained.parents[2]
    name = f"actions-R+M,{trained.parent.name},seed=5"
    assert sorted(path.name for path in (results / "figures").iterdir()) == [f"{name}.pdf", f"{name}.png"]
    assert f"2 files in {results / 'figures'}" in capsys.readouterr().out
    assert plot.main(["actions", str(trained), f"out={tmp_path}", "format=png"]) == 0
    assert (tmp_path / "figures" / f"{name}.png").exists()


def test_actions_of_what_cannot_be_played(trained, tmp_path, capsys):
    def copy(task, variant):
        folder = tmp_path / task / variant / "seed=5"
        shutil.copytree(trained, folder)
        return folder

    assert "one folder of a run" in refused_by_plot(capsys, "actions")
    assert "is not the folder of a run" in refused_by_plot(capsys, "actions", tmp_path / "nowhere")
    assert "W+M does not have two-dimensional actions (choices: R+N, R+L2" in refused_by_plot(
        capsys, "actions", copy("W+M", "SRad")
    )
    assert "unknown algorithm or task, Mine on R+M" in refused_by_plot(capsys, "actions", copy("R+M", "Mine"))
    assert "best.pt does not fit" in refused_by_plot(capsys, "actions", copy("R+M", "DRad"))
    parameters = copy("R+L2", "SRad") / "best.pt"
    parameters.write_bytes(b"")
    assert "best.pt is damaged" in refused_by_plot(capsys, "actions", parameters.parent)
    parameters.unlink()
    assert "no best parameters" in refused_by_plot(capsys, "actions", parameters.parent)


def test_actions_of_a_run_that_a_gpu_trained(trained, tmp_path):
    folder = tmp_path / "R+M" / "SRad" / "seed=5"
    shutil.copytree(trained, folder)
    config = yaml.safe_load((folder / "config.yaml").read_text()) | {"device": "cuda"}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    assert plot.main(["actions", str(folder), "format=png"]) == 0


# ---- tables of definitions ----


def test_tables_of_definitions(tmp_path, capsys):
    assert plot.main(["tables", f"out={tmp_path}"]) == 0
    printed = capsys.readouterr().out
    files = sorted(path.name for path in (tmp_path / "tables").iterdir())
    assert files == [f"{name}.{suffix}" for name in ("hyperparameters", "tasks") for suffix in ("csv", "md", "tex")]
    assert all(task in printed for task in envs.TASKS) and "fw_learning_rate" in printed
    for name in ("hyperparameters", "tasks"):
        text = (tmp_path / "tables" / f"{name}.tex").read_text()
        assert text.count(r"\begin") == text.count(r"\end") == 2 and r"\toprule" in text


def test_task_table():
    table = definitions.task_table()
    assert [record["task"] for record in table.records] == list(envs.TASKS)
    assert [len(section) for section in table.sections] == [7, 2, 2, 2]
    latex = tables.to_latex(table)
    for task in envs.TASKS.values():
        assert f"${task.formula}$" in latex
    assert r"Hopper (d = 3) & H+M & $\sum_{i=1}^3 \max\{w_i a_i, 0\} \leq 10$ & 1,000,000 \\" in latex


def test_hyperparameter_table():
    table = definitions.hyperparameter_table()
    values = {(r["setting"], r["robot"], r["base"]): r["value"] for r in table.records}
    agents = [algorithm.agent for algorithm in ALGORITHMS.values()]
    for agent in agents:
        for robot, settings in agent.paper.items():
            for key, value in settings.items():
                assert values[key, robot, agent.family] == value
    assert values["action_noise", "Others", "SAC"] is None and values["policy_delay", "Hopper", "TD3"] == 2
    assert values["penalty", "Reacher", "SAC"] == 1.0 and values["final_episodes", "Hopper", "TD3"] == 50
    published, further = ({row[0].lines[0]: [cell.lines[0] for cell in row] for row in s} for s in table.sections)
    paper = [ALGORITHMS[name].agent.paper for name in PAPER]
    assert set(published) == {key for table in paper for settings in table.values() for key in settings}
    assert further["reward_shift"][2:] == ["–", "–", "0.2", "–", "–", "0.0", "–", "–", "0.0"]
    assert "policy_delay" in further and not {"seed", "results", "steps"} & set(further)
    assert published["hidden"][2:] == ["400, 300"] * 4 + ["256, 256"] * 2 + ["400, 300"] + ["256, 256"] * 2
    assert published["gsde"][2:] == ["–", "True", "–", "–", "False", "–", "–", "False", "–"]
    latex = tables.to_latex(table)
    assert r"\multicolumn{3}{c}{Reacher} & \multicolumn{3}{c}{Hopper} & \multicolumn{3}{c}{Others}" in latex
    assert "Setting & Meaning & TD3 & SAC & ARAM & TD3 & SAC & ARAM & TD3 & SAC & ARAM" in latex


def test_an_algorithm_of_ones_own_with_other_values_has_columns_of_its_own(monkeypatch):
    values = {group: settings | {"learning_rate": 0.5} for group, settings in TD3.paper.items()}
    monkeypatch.setitem(ALGORITHMS, "DMine", Algorithm(type("Mine", (TD3,), {"paper": values}), Project(), "layer"))
    table = definitions.hyperparameter_table()
    rates = {(r["robot"], r["base"]): r["value"] for r in table.records if r["setting"] == "learning_rate"}
    assert rates["Hopper", "DMine"] == 0.5 and rates["Hopper", "TD3"] == TD3.paper["Hopper"]["learning_rate"]
    assert "Hopper DMine" in table.header and len(table.header) == 2 + 3 * 4


def test_names_of_other_people_break_no_table():
    cells = [tables.text_cells("a|b", r"x_1^2 \ ~ <5")]
    table = tables.Table("name", "title", ["|", "^"], 1, [cells], [{"a": 1}])
    assert tables.to_markdown(table).splitlines()[2:] == [r"| \| | ^ |", "| :-- | --: |", r"| a\|b | x_1^2 \ ~ <5 |"]
    escaped = r"x\_1\textasciicircum{}2 \textbackslash{} \textasciitilde{} $<$5"
    assert rf"a|b & {escaped} \\" in tables.to_latex(table)


# ---- runtime ----


@pytest.fixture
def bench(monkeypatch):
    """bench/runtime.py as a module, with a small replay buffer."""
    monkeypatch.setattr(sys, "path", list(sys.path))  # the script changes it
    spec = importlib.util.spec_from_file_location("bench_runtime", ROOT / "bench" / "runtime.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "FILL", 20)
    return module


def test_runtime_from_measurement_to_bars(bench, tmp_path, capsys):
    words = ["algo=DPre,SRad", "batch=2,16", "trials=2", "steps=3", "seeds=2", f"out={tmp_path}"]
    assert bench.main(words) == 0
    printed = capsys.readouterr().out
    assert "first 3 gradient steps of each of 2 seeds in lockstep, mean of 2 trials" in printed
    assert [line.split()[0] for line in printed.splitlines() if "±" in line] == ["DPre", "SRad"]
    records = runtime.read_runtime(tmp_path / "runtime.csv")
    cells = [(r["trial"], r["algo"], r["batch"]) for r in records]
    assert cells == [(t, algo, b) for t in (0, 1) for b in (2, 16) for algo in ("DPre", "SRad")]
    assert all(r["cpu_seconds"] > 0 and r["gpu_seconds"] == 0 and r["task"] == "HC+O" for r in records)
    assert plot.main(["runtime", str(tmp_path / "runtime.csv"), f"out={tmp_path}"]) == 0
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"runtime.png", "runtime.pdf"}


def test_the_replay_buffer_holds_real_steps(bench):
    for name in ("DPre", "DPro"):
        agent = bench.make_agent(name, 16, [3, 4])
        batch = bench.fill_replay(agent, 20).sample(64)
        assert agent.config.batch_size == 16 and batch.obs.shape == (2, 64, 17)
        step = batch.next_obs - batch.obs
        assert 1e-3 < step.abs().mean() < 10 and batch.reward.std() > 0 and batch.terminated.sum() == 0
        violation = envs.constraint("HC+O").violation(batch.obs.double(), batch.action.double())
        if name == "DPro":  # its critic sees what was executed
            assert violation.max() < 1e-5


def test_an_interrupted_measurement_is_of_use(bench, tmp_path, capsys, monkeypatch):
    times = iter([{"DPro": (1.0, 0.25), "DRad": (2.0, 0.5)}])

    def measure(*arguments):
        try:
            return next(times)
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(bench, "measure", measure)
    assert bench.main(["algo=DPro,DRad", "batch=1", "trials=2", f"out={tmp_path}"]) == 130
    captured = capsys.readouterr()
    assert "interrupted" in captured.err and "DPro" in captured.out and "2.50" in captured.out
    records = runtime.read_runtime(tmp_path / "runtime.csv")
    assert [(r["algo"], r["cpu_seconds"], r["gpu_seconds"]) for r in records] == [("DPro", 1, 0.25), ("DRad", 2, 0.5)]


def test_runtime_options(bench, tmp_path, capsys):
    for words, complaint in (
        (["algo=Srad"], "did you mean SRad?"),
        (["batch=1,x"], "bad value 'x' for batch"),
        (["trials=0"], "bad value '0' for trials"),
        (["device=tpu"], "bad value 'tpu' for device"),
        (["seeds"], "expected key=value"),
    ):
        assert bench.main(words) == 2
        error = capsys.readouterr().err
        assert complaint in error and error.count("\n") == 1


def write_runtime(path, rows):
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, runtime.COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def row(algo, batch, trial, cpu, gpu=0.0, **fixed):
    settings = {"task": "HC+O", "seeds": 1, "steps": 1000, "machine": "one"} | fixed
    return settings | {"algo": algo, "batch": batch, "trial": trial, "cpu_seconds": cpu, "gpu_seconds": gpu}


def test_bars(tmp_path, monkeypatch):
    """CPU on top of GPU; the paper's batch sizes only; standard error over trials."""
    path = tmp_path / "runtime.csv"
    write_runtime(path, [row("DPro", b, t, 1.0 + t, 2.0) for b in (1, 16, 100, 256) for t in range(3)])
    drawn = []
    monkeypatch.setattr(runtime, "save", lambda figure, *rest: drawn.append(figure) or [])
    runtime.draw_runtime(path, tmp_path, ["png"])
    (axes,) = drawn[0].axes
    bars = [(bar.get_y(), bar.get_height()) for bar in axes.patches]
    assert bars == [(0.0, 2.0), (2.0, 2.0)] * 3
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["CPU", "GPU"]
    table = runtime.runtime_table(path)
    assert table.sections[0][0][4].lines == (f"4.00 ± {1 / math.sqrt(3):.2f}",)


def test_files_that_are_no_measurement(tmp_path, capsys):
    path = tmp_path / "runtime.csv"
    assert "runtime.csv" in refused_by_plot(capsys, "runtime", path)
    path.write_text("a,b\n1,2\n")
    assert "is not a file of bench/runtime.py" in refused_by_plot(capsys, "runtime", path)
    write_runtime(path, [])
    assert "no measurements" in refused_by_plot(capsys, "runtime", path)
    write_runtime(path, [row("DPro", 1, 0, 1.0), row("DPro", 1, 1, 1.0, machine="two")])
    assert "different machine: one, two" in refused_by_plot(capsys, "runtime", path)
    write_runtime(path, [row("DPro", 1, 0, "soon")])
    assert "row 1 lacks a number" in refused_by_plot(capsys, "runtime", path)
