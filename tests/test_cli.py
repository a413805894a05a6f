"""run.py from the command line: usage, wrong input, results, and interrupts."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from helpers import cells_of, config_of, run_command

from algos import ALGORITHMS, PAPER, setting_keys
from core.config import parse_seeds
from core.words import ConfigError
from envs import TASKS
from store.folder import read_run

ROOT = Path(__file__).parents[1]
SHORT = ["steps=40", "learning_starts=20", "batch_size=8", "hidden=[16,16]", "eval_episodes=1", "final_episodes=2"]


def python(*arguments, **options):
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120, **options
    )


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_usage_names_every_algorithm_task_and_key(capsys, arguments):
    assert run_command(arguments) == 0
    out = capsys.readouterr().out
    for name in [*ALGORITHMS, *TASKS, *setting_keys()]:
        assert name in out


@pytest.mark.parametrize(
    "words, said",
    [
        ("algo=SRad", "env= is missing"),
        ("env=W+M", "algo= is missing"),
        ("algo=SRat env=W+M", "did you mean SRad?"),
        ("algo=SRad env=w+m", "did you mean W+M?"),
        ("algo=SRad env=X", "choices: R+N"),
        ("algo=SRad,Foo env=W+M", "'Foo'"),
        ("algo=SRad env=W+M sed=3", "did you mean seed?"),
        ("algo=SRad env=W+M seed", "expected key=value, got 'seed'"),
        ("algo=SRad env=W+M seed=", "expected key=value"),
        ("algo=SRad env=W+M seed=x", "bad seed 'x'"),
        ("algo=SRad env=W+M seed=5-2", "is empty"),
        ("algo=SRad env=W+M seed=-1", "bad seed '-1'"),
        ("algo=SRad env=W+M seed=1 seed=2", "given twice"),
        ("algo=SRad env=W+M steps=ten", "bad value 'ten' for steps: expected int"),
        ("algo=SRad env=W+M steps=0", "at least 1"),
        ("algo=SRad env=W+M steps=1.5", "bad value '1.5' for steps"),
        ("algo=SRad env=W+M gamma=2", "in [0, 1]"),
        ("algo=SRad env=W+M gamma=nan", "must be finite"),
        ("algo=SRad env=W+M tau=0", "in (0, 1]"),
        ("algo=SRad env=W+M learning_rate=-1", "must be positive"),
        ("algo=SRad env=W+M hidden=[]", "bad value '[]' for hidden: expected list"),
        ("algo=SRad env=W+M hidden=[8,0]", "positive widths"),
        ("algo=SRad env=W+M hidden=[a]", "bad value '[a]' for hidden"),
        ("algo=SRad env=W+M hidden=[1,2]]", "bad value '[1,2]]' for hidden"),
        ("algo=SRad env=W+M gamma={", "bad value '{' for gamma: expected float"),
        ("algo=SRad env=W+M steps=1:30", "bad value '1:30' for steps: expected int"),
        ("algo=SRad env=W+M gamma=", "expected key=value"),
        ("algo=SRad env=W+M train_freq=never", ">= 1 or 'episode'"),
        ("algo=SRad env=W+M gradient_steps=-2", "-1 or at least 1"),
        ("algo=SRad env=W+M batch_size=null", "a value is needed"),
        ("algo=SRad env=W+M action_noise=0.1", "does not apply to SRad"),
        ("algo=DPre env=W+M penalty=2", "does not apply to DPre"),
        ("algo=DPre env=W+M fw_learning_rate=0.1", "does not apply to DPre"),
        ("algo=SRad env=W+M entropy=disc", "bad value 'disc' for entropy: must be 'paper' or 'ball'"),
        ("algo=SRad env=W+M boundary_weight=2", "does not apply to SRad"),
        ("algo=SAlpha env=W+M boundary_weight=0", "must be positive"),
        ("algo=SRad env=W+M log_det_floor=-1", "must not be negative"),
        ("algo=SPre env=W+M entropy=ball", "does not apply to SPre"),
        ("algo=SRad env=W+M overwrite=maybe", "bad value 'maybe' for overwrite"),
    ],
)
def test_wrong_input_gets_one_line_and_exit_code_2(capsys, tmp_path, words, said):
    assert run_command([*words.split(), f"results={tmp_path}"]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and said in captured.err and captured.err.startswith("run.py: ")
    assert not list(tmp_path.iterdir())


def test_results_folder_that_cannot_be_made(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    assert run_command(["algo=DPre", "env=R+N", f"results={tmp_path / 'file'}", *SHORT]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_numbers_as_people_write_them():
    config = config_of(["algo=SRad", "env=W+M", "steps=3e5", "hidden=64,32", "learning_rate=1e-3"])
    assert (config.steps, config.hidden, config.learning_rate) == (300_000, [64, 32], 1e-3)
    config = config_of(["algo=SRad", "env=W+M", "steps=010", "hidden=[1e2,32]", "train_freq=08"])
    assert (config.steps, config.hidden, config.train_freq) == (10, [100, 32], 8)


def test_seeds():
    assert parse_seeds("3") == (3,)
    assert parse_seeds("0-4,7,2") == (0, 1, 2, 3, 4, 7)
    with pytest.raises(ConfigError):
        parse_seeds("1;2")


def configs(words):
    return [cell.config for cell in cells_of(words)]


def test_lists_and_all_make_the_product():
    cells = cells_of(["algo=DRad,DPre", "env=all"])
    assert len(cells) == 2 * len(TASKS)
    # A key that only some algorithms have is applied to those only.
    by_name = {config.algo: config for config in configs(["algo=all", "env=R+N", "fw_learning_rate=0.5"])}
    assert by_name["NFW"].fw_learning_rate == 0.5 and not hasattr(by_name["DPre"], "fw_learning_rate")


def test_the_papers_hyperparameters():
    """Spot checks of the paper's Table "Hyperparameters used in the experiments", in the cells of commands."""
    cells = {(c.algo, c.env): c for c in configs(["algo=all", "env=all"])}
    assert len(cells) == len(TASKS) * len(ALGORITHMS)
    assert [config.algo for config in configs(["algo=paper", "env=R+N"])] == list(PAPER) and len(PAPER) == 13
    nfw, srad = cells["NFW", "R+L2"], cells["SRad", "R+L2"]
    assert (nfw.gamma, nfw.batch_size, nfw.buffer_size, nfw.fw_learning_rate) == (0.98, 100, 200_000, 0.05)
    assert (nfw.train_freq, nfw.gradient_steps, nfw.steps, nfw.action_noise) == ("episode", -1, 300_000, 0.1)
    assert (srad.tau, srad.learning_rate, srad.gsde, srad.train_freq, srad.gradient_steps) == (
        0.02,
        7.3e-4,
        True,
        8,
        8,
    )
    hopper = cells["DPre+", "H+M"]
    assert (hopper.batch_size, hopper.learning_rate, hopper.train_freq, hopper.penalty) == (256, 3e-4, 1, 1.0)
    walker = cells["SAlpha", "W+O+S"]
    assert (walker.hidden, walker.tau, walker.gsde, walker.steps) == ([256, 256], 0.005, False, 1_000_000)
    assert all(config.learning_starts == 100_000 for config in cells.values())


def test_a_run_from_the_shell_and_what_it_leaves(tmp_path):
    words = ["algo=SRad", "env=R+L2", "seed=4,6", f"results={tmp_path}", *SHORT]
    done = python("run.py", *words)
    assert done.returncode == 0, done.stderr
    assert "training" in done.stderr and done.stdout.count("return ") == 2
    variant = "SRad,batch_size=8,eval_episodes=1,final_episodes=2,hidden=[16,16],learning_starts=20,steps=40"
    for seed in (4, 6):
        finished = read_run(tmp_path / "R+L2" / variant / f"seed={seed}")
        assert finished.finished and len(finished.result["returns"]) == 2
        assert finished.config["seed"] == str(seed) and finished.config["tau"] == 0.02
        assert finished.evaluations.step.tolist() == [40]
        assert {p.name for p in finished.folder.iterdir()} >= {"best.pt", "last.pt", "info.json"}
        seconds = finished.result["seconds"]
        assert set(seconds) == {"environment", "acting", "update", "evaluation", "checkpoint", "total"}
        assert 0 < sum(seconds.values()) - seconds["total"] <= seconds["total"]

    again = python("run.py", *words)
    assert again.returncode == 0 and again.stdout.count("already finished") == 2
    before = (finished.folder / "result.json").read_bytes()
    assert python("run.py", *words, "overwrite=true").returncode == 0
    assert (finished.folder.parent / "seed=6.old-1" / "result.json").read_bytes() == before

    plot = python("plot.py", str(tmp_path))
    assert plot.returncode == 0, plot.stderr
    assert "SRad" in plot.stdout and list((tmp_path / "figures").glob("*.png"))


def test_interrupted_by_signals_it_resumes_and_a_second_process_keeps_off(tmp_path, capsys):
    words = ["algo=DPre", "env=R+N", "learning_starts=10", "batch_size=8", "eval_every=20", "eval_episodes=1"]
    words.append(f"results={tmp_path}")

    def start():
        return subprocess.Popen(
            [sys.executable, "run.py", *words],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            # A shell that runs the tests in the background may ignore the signal, and child processes inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def wait_for(evaluations):
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            for folder in tmp_path.glob("*/*/seed=0"):
                if (folder / "best.pt").exists() and len(read_run(folder).evaluations.step) >= evaluations:
                    return folder
            time.sleep(0.1)
        raise AssertionError("no evaluation within a minute")

    process = start()
    folder = wait_for(evaluations=1)
    assert run_command(words) == 2
    assert f"{folder} is being trained by process {process.pid} on " in capsys.readouterr().err
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT
    assert "Traceback" not in err and "interrupted" in err
    assert (folder / "last.pt").is_file() and not (folder / "result.json").exists()
    before = len(read_run(folder).evaluations.step)
    assert before >= 1 and yaml.safe_load((folder / "config.yaml").read_text())["algo"] == "DPre"

    process = start()
    wait_for(evaluations=before + 1)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM and "Traceback" not in err
    assert f"{folder}: resuming from step" in out and len(read_run(folder).evaluations.step) > before
    assert not folder.with_name("seed=0.lock").exists() and not list(folder.parent.glob("*.old-*"))
