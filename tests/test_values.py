"""Values that a command takes literally, folder names that must be short, and runs for a first look."""

import json
import os

import pytest
import yaml
from helpers import CHECKPOINTED, Breaks, cells_of, config_of, outcome, run_command, train, train_through, write_run

import plot
from constraints import Ball
from envs import TASKS, Task
from envs.reacher import Reacher
from store.folder import LONGEST_NAME, find_runs, read_run
from sweep.settings import parse_sweep
from sweep.status import find_cells

ODD = ["${oc.env:HOME}", "???", "${", "a${b}c", "\\${x}", "$HOME", "{a: 1}", "a: 1", "[1"]


@pytest.mark.parametrize("text", ODD)
def test_texts_are_taken_as_they_are(text):
    words = ["algo=DPre", "env=R+N", f"results={text}"]
    assert config_of(words).results == text
    sweep, _ = parse_sweep([*words, f"slurm.partition={text}", f"slurm.account={text}", "launcher=slurm"])
    assert (sweep.slurm.partition, sweep.sbatch["account"]) == (text, text)
    (cell,) = cells_of(words)
    assert f"results={os.path.abspath(text)}" in cell.words


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "???", "${oc.create:[1]}", "${gamma}"])
@pytest.mark.parametrize("key", ["steps", "gamma", "hidden", "train_freq", "overwrite", "jobs", "seed", "device"])
def test_a_value_is_never_looked_up_elsewhere(capsys, key, text):
    assert run_command(["algo=DPre", "env=R+N", f"{key}={text}"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and f"bad {'seed' if key == 'seed' else 'value'} {text!r}" in err


def many_settings():
    words = "gamma=0.98765432 learning_rate=0.000123456789 tau=0.00123456789 action_noise=0.123456789"
    words += " target_noise=0.2123456789 target_noise_clip=0.51234567 buffer_size=54321 policy_delay=3"
    return f"{CHECKPOINTED} {words}"


def test_a_name_that_is_too_long_for_a_folder(tmp_path, capsys):
    words = many_settings()
    (cell,) = cells_of(f"{words} results={tmp_path}")
    assert len(cell.full_variant) > LONGEST_NAME > len(cell.variant) and cell.variant.startswith("DPre,settings=")
    assert cells_of(cell.words) == [cell] and cells_of(cell.words)[0].config == cell.config
    (other,) = cells_of(words.replace("gamma=0.98765432", "gamma=0.98765431"))
    assert other.variant != cell.variant
    assert train_through(tmp_path, words, Breaks(77)) == 1
    assert run_command([*words.split(), f"results={tmp_path}"]) == 0
    assert capsys.readouterr().out.count("already finished") == 2
    run = read_run(find_runs(tmp_path)[0])
    assert run.overrides["gamma"] == "0.98765432" and len(run.overrides) == len(cell.full_variant.split("=")) - 1
    assert yaml.safe_load((run.folder / "config.yaml").read_text())["variant"] == cell.full_variant
    assert plot.main([str(tmp_path), "format=md,png"]) == 0
    assert "gamma=0.98765432" in (tmp_path / "tables" / "rewards.md").read_text()
    assert [cell.variant for cell in find_cells(tmp_path)] == [cell.variant]


def test_quick_evaluates_little_and_says_so_everywhere(tmp_path, capsys):
    config = config_of("algo=DPre env=R+N quick=true")
    assert (config.eval_episodes, config.final_episodes, config.quick) == (1, 2, True)
    config = config_of("algo=DPre env=R+N quick=true final_episodes=7")
    assert (config.eval_episodes, config.final_episodes) == (1, 7)
    config = config_of("algo=DPre env=R+N")
    assert (config.eval_episodes, config.final_episodes, config.quick) == (5, 50, False)

    words = CHECKPOINTED.replace(" eval_episodes=1", "").replace(" final_episodes=1", "")
    assert run_command([*words.split(), "quick=true", f"results={tmp_path / 'quick'}"]) == 0
    assert capsys.readouterr().out.count("over 2 episodes") == 2
    (run, _) = map(read_run, find_runs(tmp_path / "quick"))
    assert run.overrides["quick"] == "true" and run.result["quick"] is True and len(run.result["returns"]) == 2
    assert plot.main([str(tmp_path / "quick"), "format=md,png"]) == 0
    assert "quick=true" in (tmp_path / "quick" / "tables" / "rewards.md").read_text()
    figures = [path.name for path in (tmp_path / "quick" / "figures").iterdir()]
    assert all("quick=true" in name for name in figures if name != "R+N-training.png") and len(figures) >= 2
    train(tmp_path / "whole", words + " eval_episodes=2 final_episodes=1")
    quick, whole = outcome(tmp_path / "quick"), outcome(tmp_path / "whole")
    for seed in quick:  # both runs learn the same
        ours, others = quick[seed]["parameters"]["last"], whole[seed]["parameters"]["last"]
        assert all(ours[name].equal(others[name]) for name in others)
    assert "quick" not in yaml.safe_load((find_runs(tmp_path / "whole")[0] / "config.yaml").read_text())


def test_a_misspelt_command_of_plot(capsys):
    assert plot.main(["tabels"]) == 2
    assert capsys.readouterr().err == "plot.py: tabels is not a folder; did you mean tables?\n"


def test_a_plan_does_not_guess_the_time_of_a_set_that_nobody_has_measured(tmp_path, capsys):
    TASKS["R+Slow"] = Task(Reacher, Ball(0.5, 2), "a task", "a formula", 300_000)
    try:
        words = ["algo=DPre", "env=R+N,R+Slow", "dry=true", f"results={tmp_path}"]
        assert run_command(words) == 0
        out = capsys.readouterr().out
        lines = {line.split()[0]: line for line in out.splitlines() if line.startswith("R+")}
        assert " unknown " in lines["R+Slow"] and " min " in lines["R+N"]
        assert "the time of 1 cell is unknown" in out and "estimate without these: " in out
        assert run_command(["algo=DPre", "env=R+Slow", "dry=true", f"results={tmp_path}"]) == 0
        out = capsys.readouterr().out
        assert "one core" not in out and "GB of memory" in out

        writer = write_run(tmp_path, "R+Slow", "DPre", 7, result=1.0, steps=300_000)
        result = {"return_mean": 1.0, "seeds_in_lockstep": 1, "seconds": {"total": 7200.0}, "gradient_steps": 200_000}
        (writer.folder / "result.json").write_text(json.dumps(result))
        config = yaml.safe_load((writer.folder / "config.yaml").read_text())
        (writer.folder / "config.yaml").write_text(yaml.safe_dump(config | {"hidden": [400, 300], "device": "cpu"}))
        assert run_command(["algo=DPre", "env=R+Slow", "dry=true", f"results={tmp_path}"]) == 0
        out = capsys.readouterr().out
        assert "unknown" not in out and "2.0 h on one core" in out
    finally:
        del TASKS["R+Slow"]
