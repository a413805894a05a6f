"""`log=tensorboard,wandb`: what the loggers record, also when a run resumes; a missing package; loggers that fail.

TensorBoard's files are read with its own reader. Weights & Biases writes offline, without a network.
"""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import assert_identical, outcome, run_command, train
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from store import loggers
from store.folder import find_runs, last_evaluated, read_run

ROOT = Path(__file__).resolve().parents[1]
WORDS = (
    "env=R+L2 steps=60 learning_starts=20 batch_size=4 hidden=[8,8] eval_every=10 eval_episodes=1 final_episodes=1"
    " checkpoint_every=30 train_freq=1 gradient_steps=1"
)
MEASURES = {
    "DRad": {"critic_loss", "mean_q", "actor_loss"},
    "SRad": {"critic_loss", "actor_loss", "temperature", "entropy"},
}


class Crash:
    """A `stop_if_asked` that crashes the training once, after the evaluation at `step`."""

    def __init__(self, root, step):
        self.root, self.step, self.happened = root, step, False

    def __call__(self):
        if not self.happened and any(last_evaluated(folder) >= self.step for folder in find_runs(self.root)):
            self.happened = True
            raise ZeroDivisionError


def scalars(folder):
    """What TensorBoard shows of a run: tag -> steps and values."""
    reader = EventAccumulator(str(folder / "tensorboard"))
    reader.Reload()
    events = {tag: reader.Scalars(tag) for tag in reader.Tags()["scalars"]}
    return {tag: ([event.step for event in found], [event.value for event in found]) for tag, found in events.items()}


def assert_shows_the_files(folder, algo):
    """TensorBoard has the numbers of the run's own files, every step once."""
    shown, run = scalars(folder), read_run(folder)
    steps, returns = shown["evaluation/return"]
    assert steps == run.evaluations.step.tolist() == [10, 20, 30, 40, 50, 60]
    assert returns == pytest.approx(run.evaluations.return_mean.tolist())
    measures = MEASURES[algo] | {"suggested_violation", "suggested_infeasible"}
    assert run.training.keys() == {"step"} | measures
    for name in measures:
        steps, values = shown[f"training/{name}"]
        assert steps == run.training["step"].tolist() == [30, 40, 50, 60]
        assert values == pytest.approx(run.training[name].tolist())
    assert shown["result/return"] == ([60], [pytest.approx(run.result["return_mean"])])
    return shown


@pytest.mark.parametrize("algo", MEASURES)
def test_tensorboard_shows_what_the_files_of_the_run_have(tmp_path, algo):
    train(tmp_path / "logged", f"algo={algo} {WORDS} seed=3,5 log=tensorboard,csv")
    train(tmp_path / "plain", f"algo={algo} {WORDS} seed=3,5")
    for folder in find_runs(tmp_path / "logged"):
        shown = assert_shows_the_files(folder, algo)
        steps, rates = shown["speed/steps_per_second"]
        assert steps == [10, 20, 30, 40, 50, 60] and min(rates) > 0
    logged, plain = outcome(tmp_path / "logged"), outcome(tmp_path / "plain")
    for seed in logged:
        logged[seed]["files"].remove("tensorboard")
    assert_identical(logged, plain)  # the logger changes no bit, and without it there are only the run's own files


def test_a_run_that_resumes_continues_the_same_page_without_a_step_twice(tmp_path):
    words = f"algo=SRad {WORDS} seed=3,5 log=tensorboard"
    with pytest.raises(ZeroDivisionError):
        train(tmp_path, words, Crash(tmp_path, 50))  # the newest checkpoint is of step 30
    train(tmp_path, words)
    for folder in find_runs(tmp_path):
        files = sorted((folder / "tensorboard").iterdir())
        returns = [
            event.step
            for file in files
            for event in EventFileLoader(str(file)).Load()
            if any(value.tag == "evaluation/return" for value in event.summary.value)
        ]
        assert len(files) == 2 and len(returns) > len(set(returns)) == 6  # both processes have written these steps
        assert_shows_the_files(folder, "SRad")


def test_weights_and_biases_offline_keeps_one_run_over_resumptions(tmp_path):
    """In a separate process, because Weights & Biases starts further ones."""
    code = f"""
import sys, time
sys.path.insert(0, {str(ROOT / "tests")!r})
from pathlib import Path
from helpers import train
from test_loggers import Crash, WORDS
root, words = Path({str(tmp_path)!r}), "algo=DRad " + WORDS + " seed=3,5 log=wandb"
try:
    train(root, words, Crash(root, 50))
except ZeroDivisionError:
    time.sleep(1.5)  # the names of Weights & Biases' folders have seconds
    train(root, words)
"""
    environment = os.environ | {"WANDB_MODE": "offline", "PYTHONPATH": str(ROOT)}
    process = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert process.returncode == 0 and "log=wandb ends" not in process.stderr, process.stderr
    names = set()
    for folder in find_runs(tmp_path):
        name = (folder / "wandb-id.txt").read_text()
        files = sorted((folder / "wandb").glob(f"offline-run-*-{name}/run-{name}.wandb"))
        assert len(files) == 2  # a file for each process, of the same run
        kept = b"".join(file.read_bytes() for file in files)
        for tag in ("evaluation/return", "training/suggested_violation", "result/return", "speed/steps_per_second"):
            assert tag.encode() in kept
        assert (
            repr(read_run(folder).evaluations.return_mean[-1]).removeprefix("np.float64(").rstrip(")").encode() in kept
        )
        names.add(name)
    assert len(names) == 2  # each seed is a run


@pytest.mark.parametrize("name, module", [("tensorboard", "torch.utils.tensorboard"), ("wandb", "wandb")])
@pytest.mark.parametrize("more", ["", "jobs=2", "launcher=slurm"])
def test_a_missing_package_is_one_line_before_the_training(tmp_path, monkeypatch, capsys, name, module, more):
    monkeypatch.setitem(sys.modules, module, None)  # importing it fails
    words = f"algo=DRad {WORDS} log=csv,{name} results={tmp_path} {more}"
    assert run_command(words.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"log={name} needs the package {name}" in said and f"pip install {name}" in said
    assert not list(tmp_path.iterdir())


def test_a_missing_login_is_one_line_before_the_training(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WANDB")}
    environment |= {"HOME": str(tmp_path), "NETRC": str(tmp_path / "netrc")}
    words = f"algo=DRad {WORDS} log=wandb results={tmp_path / 'results'}"
    process = subprocess.run(
        [sys.executable, "run.py", *words.split()],
        env=environment, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert process.returncode == 2 and process.stderr.count("\n") == 1, process.stderr
    assert "run.py: log=wandb: No API key configured" in process.stderr and "WANDB_MODE=offline" in process.stderr
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("value", ["tensorbord", "csv,", "wandb;csv", "[csv]"])
def test_an_unknown_logger_is_refused(tmp_path, capsys, value):
    assert run_command(f"algo=DRad {WORDS} log={value} results={tmp_path}".split()) == 2
    assert (
        capsys.readouterr().err
        == f"run.py: bad value {value!r} for log: must be one or several of csv, tensorboard, wandb, comma separated\n"
    )


class Failing:
    """A logger that fails after `calls` successful calls. Opening, logging and closing count."""

    def __init__(self, calls):
        self.calls = calls

    def __call__(self, folder, config, first_step):
        self.log()
        return self

    def log(self, step=0, values=None):
        self.calls -= 1
        if self.calls < 0:
            raise OSError(28, "No space left on device")

    close = log

    def check(self):
        pass


@pytest.mark.parametrize("calls", [0, 3])
def test_a_logger_that_fails_is_named_once_and_the_training_goes_on(tmp_path, monkeypatch, capsys, calls):
    monkeypatch.setitem(loggers.LOGGERS, "wandb", Failing(calls))
    assert run_command(f"algo=DRad {WORDS} seed=3 log=wandb,tensorboard results={tmp_path}".split()) == 0
    (folder,) = find_runs(tmp_path)
    said = [line for line in capsys.readouterr().err.splitlines() if "log=wandb" in line]
    assert len(said) == 1 and f"{folder}: log=wandb stops after step" in said[0]
    assert "no space left on device (the training continues" in said[0]
    assert_shows_the_files(folder, "DRad")  # the other logger is complete


def test_a_logger_that_fails_at_the_end_leaves_the_result(tmp_path, monkeypatch, capsys):
    calls = 1 + 6 + 4 + 1  # opening, evaluations, training, result
    monkeypatch.setitem(loggers.LOGGERS, "wandb", Failing(calls))
    assert run_command(f"algo=DRad {WORDS} seed=3 log=wandb results={tmp_path}".split()) == 0
    assert "log=wandb stops after step 60" in capsys.readouterr().err
    assert read_run(*find_runs(tmp_path)).finished


def test_a_run_says_which_loggers_it_has_but_is_no_other_experiment(tmp_path):
    train(tmp_path, f"algo=DRad {WORDS} seed=3 log=tensorboard")
    (folder,) = find_runs(tmp_path)
    assert read_run(folder).config["log"] == "tensorboard" and "log" not in folder.parent.name
    with open(folder / "training.csv", newline="") as file:
        assert "suggested_violation" in next(csv.reader(file))
