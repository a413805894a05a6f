"""Sweeps: settings, plans, estimates, the queue on this machine, records, states, and the requests to Slurm."""

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers import assert_identical, cells_of, outcome_of, run_command

import plot
from algos import ALGORITHMS, Algorithm
from algos.td3 import TD3, TD3Config
from core.config import Config, parse_seeds, setting
from core.maps import Project
from store import slurm
from store.checkpoint import saved_step
from store.folder import find_runs
from store.interrupt import Interrupted, Interrupts
from store.lock import LockedError, lock_owner, run_lock
from sweep import estimates
from sweep.cells import Cell, CellFolders, format_seeds
from sweep.plan import make_plan
from sweep.progress import Display, End
from sweep.settings import parse_sweep
from sweep.states import Stage, job_states, state_of
from sweep.status import find_cells
from sweep.train import on_this_machine

ROOT = Path(__file__).parents[1]
SHORT = (
    "steps=300 learning_starts=100 batch_size=4 hidden=[8,8] eval_every=100 eval_episodes=1 final_episodes=1"
    " checkpoint_every=20 train_freq=1 gradient_steps=1"
)


def start(words, root, **options):
    return subprocess.Popen(
        [sys.executable, "run.py", *words.split(), f"results={root}"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell that runs the tests in the background may ignore the signal, and child processes inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


def wait_until(condition, process=None):
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline and (process is None or process.poll() is None)
        time.sleep(0.05)


def outcomes(root):
    return {str(folder.relative_to(root)): outcome_of(folder) for folder in find_runs(root)}


def plan_of(words, root, jobs=()):
    cells = cells_of([*words.split(), f"results={root}"])
    return make_plan([Cell.of(on_this_machine(cell.config, 1)) for cell in cells], dict(jobs))  # as the launcher does


# ---------------------------------------------------------------- settings


def test_settings_of_a_sweep_are_no_settings_of_its_runs():
    words = ["algo=SRad", "jobs=3", "dry=true", "env=W+M", "seed=1"]
    sweep, left = parse_sweep(words)
    assert left == {"algo": "SRad", "env": "W+M", "seed": "1"} and sweep.wanted
    assert (sweep.settings.jobs, sweep.settings.dry, sweep.settings.launcher) == (3, True, "local")
    words = "algo=SRad env=W+M launcher=slurm slurm.hours=1.5 slurm.cpus=4 slurm.account=me slurm.mail_type=END"
    sweep, left = parse_sweep(words.split())
    assert (sweep.slurm.hours, sweep.slurm.cpus, sweep.slurm.gpus) == (1.5, 4, 0)
    assert sweep.sbatch == {"account": "me", "mail-type": "END"} and left == {"algo": "SRad", "env": "W+M"}
    assert not parse_sweep(["algo=SRad", "env=W+M"])[0].wanted
    parse_sweep(["launcher=slurm", "slurm.hours=0.03", "slurm.signal=USR2@30"])


@pytest.mark.parametrize(
    "words, said",
    [
        ("job=2", "unknown key 'job'; did you mean jobs?"),
        ("jbos=2 dry=true", "did you mean jobs?"),
        ("sluurm.cpus=2", "did you mean slurm.cpus?"),
        ("jobs=0", "bad value 0 for jobs: must be at least 1"),
        ("jobs=two", "bad value 'two' for jobs: expected int"),
        ("jobs=", "expected key=value, got 'jobs='"),
        ("jobs", "expected key=value, got 'jobs'"),
        ("jobs=1 jobs=2", "key 'jobs' given twice: '1' and '2'"),
        ("dry=maybe", "bad value 'maybe' for dry: expected bool"),
        ("launcher=slrum", "unknown launcher 'slrum'; did you mean slurm? (choices: local, slurm)"),
        ("launcher=slurm jobs=2", "slurm.parallel="),
        ("launcher=slurm slurm.cpus=x", "bad value 'x' for slurm.cpus: expected int"),
        ("launcher=slurm slurm.cpus=0", "bad value 0 for slurm.cpus: must be at least 1"),
        ("launcher=slurm slurm.hours=0", "bad value 0.0 for slurm.hours"),
        ("launcher=slurm slurm.hours=0.06", "bad value 0.06 for slurm.hours: must be more than 240 s ("),
        ("launcher=slurm slurm.hours=nan", "bad value nan for slurm.hours"),
        ("launcher=slurm slurm.=1", "expected key=value"),
        ("launcher=slurm device=cuda", "device=cuda with launcher=slurm needs slurm.gpus= of at least 1"),
        ("launcher=slurm slurm.gpus=2 device=cpu", "slurm.gpus=2 needs device=cuda"),
        ("launcher=slurm slurm.gpus=1 device=gpu", "bad value 'gpu' for device: must be auto, cpu, cuda or cuda:N"),
        ("device=cuda:", "bad value 'cuda:' for device: must be auto, cpu, cuda or cuda:N"),
        ("launcher=slurm overwrite=true", "overwrite=true cannot be used with launcher=slurm"),
        ("jobs=2 slurm.cpus=2", "slurm.cpus= needs launcher=slurm"),
        ("jobs=2 seed=1-0", "is empty"),
    ],
)
def test_wrong_settings(capsys, tmp_path, words, said):
    assert run_command(["algo=SRad", "env=W+M", *words.split(), f"results={tmp_path}"]) == 2
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1 and captured.err.startswith("run.py: ")
    assert not captured.out and not list(tmp_path.iterdir())


def test_usage_names_the_settings_of_sweeps(capsys):
    assert run_command([]) == 0
    out = capsys.readouterr().out
    for name in ("jobs", "launcher", "dry", "slurm.partition", "slurm.gpus", "slurm.hours", "status results/"):
        assert f" {name}" in out


# ---------------------------------------------------------------- cells


@pytest.mark.parametrize("text", ["3", "0-9", "0-2,4,7-8", "1,3"])
def test_seeds_as_words(text):
    assert format_seeds(tuple(parse_seeds(text))) == text


def test_the_words_of_a_cell_are_the_same_cell(tmp_path):
    words = "algo=paper env=R+L2,W+M seed=0-9 hidden=[64,32] gamma=0.5 fw_learning_rate=0.5 gsde=false train_freq=7"
    words += " simulator=pybullet"
    cells = cells_of([*words.split(), f"results={tmp_path}", "threads=3"])
    assert len(cells) == 26
    quick = ["algo=DPre", "env=R+N", "quick=true", f"results={tmp_path}"]
    cells += cells_of([*quick, "eval_episodes=5", "final_episodes=50"]) + cells_of([*quick, "final_episodes=1"])
    for cell in cells:
        (same,) = cells_of(cell.words)
        pickled = pickle.loads(pickle.dumps(cell))
        for other in (same, pickled):
            assert (other, other.config, other.paper) == (cell, cell.config, cell.paper)


@dataclass
class TextConfig(TD3Config):
    source: str = setting("none", "a text")


def test_a_text_that_cannot_name_a_folder_is_refused(tmp_path, monkeypatch, capsys):
    mine = type("Mine", (TD3,), {"config_class": TextConfig})
    monkeypatch.setitem(ALGORITHMS, "DMine", Algorithm(mine, Project(), "layer"))
    assert run_command(["algo=DMine", "env=R+N", "source=data/a.csv", f"results={tmp_path}"]) == 2
    assert "bad value 'data/a.csv' for source: it is part of the run's folder name" in capsys.readouterr().err


def test_a_folder_of_a_user_that_nobody_knows_is_a_name_like_any_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(["status", "~no-such-user"]) == 2
    assert "~no-such-user is not a folder" in capsys.readouterr().err
    (cell,) = cells_of(["algo=DPre", "env=R+N", "results=~/results"])
    assert cell.root == Path.home() / "results"


# ---------------------------------------------------------------- plans and estimates


def test_the_longest_cell_comes_first_and_what_is_done_shortens_it(tmp_path):
    names = [
        (e.cell.config.env, e.cell.config.algo) for e in plan_of("algo=DPre,SAlpha env=R+N,HC+O seed=0-9", tmp_path)
    ]
    assert names == [("HC+O", "SAlpha"), ("HC+O", "DPre"), ("R+N", "SAlpha"), ("R+N", "DPre")]
    (whole,) = plan_of("algo=SAlpha env=HC+O seed=0-9", tmp_path)
    for folder in whole.cell.folders:
        (folder / "checkpoint").mkdir(parents=True)
        (folder / "checkpoint" / "replay-0-900000.f32").touch()
    (entry,) = plan_of("algo=SAlpha env=HC+O seed=0-9", tmp_path)
    assert (entry.state.stage, entry.state.step) == (Stage.INTERRUPTED, 900_000)
    assert 0.05 < entry.remaining / whole.remaining < 0.15 and 0.85 < entry.progress() < 0.95
    assert whole.seconds(0) == whole.remaining and whole.seconds(1_000_000) < 0.01 * whole.seconds(0)


def test_estimates_grow_with_what_there_is_to_do(tmp_path):
    def entry(words):
        return plan_of(f"env=W+M {words}", tmp_path)[0]

    base = entry("algo=SRad seed=0")
    assert base.seconds(0) > 3600
    for more in ("seed=0-9", "batch_size=512", "gradient_steps=4", "eval_every=100", "steps=2e6"):
        words = f"algo=SRad {more}" if more.startswith("seed") else f"algo=SRad seed=0 {more}"
        assert entry(words).seconds(0) > 1.05 * base.seconds(0)
    # 17 numbers of the observation twice, 6 of the action thrice, reward and end, of four bytes each
    ten, one = entry("algo=SRad seed=0-9").memory, base.memory
    per_seed = (ten - one) / 9
    assert 1e6 * 4 * (2 * 17 + 3 * 6 + 2) <= per_seed <= 1e6 * 4 * (2 * 17 + 3 * 6 + 2) + 50e6
    assert entry("algo=DPre seed=0 buffer_size=10").memory < one
    # ARAM's second buffer has 17 + 6 numbers a row.
    larger, smaller = (entry(f"algo=ARAM seed=0 rejected_kept={kept}").memory for kept in (100_000, 1))
    assert larger - smaller == pytest.approx(4 * 23 * 99_999)
    assert {row for row in estimates._rates()} == {(c.task, c.config.algo) for c in cells_of(["algo=paper", "env=all"])}


def test_makespan():
    assert estimates.makespan([5, 3, 2, 2], jobs=2) == 7
    assert estimates.makespan([5, 3, 2, 2], jobs=9) == 5
    assert estimates.makespan([], jobs=2) == 0


def test_times_in_words():
    assert [estimates.in_words(t) for t in (0.4, 75, 120, 7200, 40 * 3600, 30 * 86400)] == [
        "0 s", "75 s", "2.0 min", "2.0 h", "1.7 d", "30 d",
    ]  # fmt: skip


def after_a_run_of(steps, result, folder, words, root, before):
    """Whether a finished run of `steps` gradient steps changes the estimate of another cell."""
    (folder / "result.json").write_text(json.dumps(result | {"gradient_steps": steps}))
    return {e.cell.name: e.remaining for e in plan_of(words, root)}["DRad R+N"] != before["DRad R+N"]


def test_finished_runs_correct_the_estimates(tmp_path):
    words = "algo=DPre,DRad,SRad env=R+N,R+L2 seed=0"
    before = {entry.cell.name: entry.remaining for entry in plan_of(words, tmp_path)}
    (entry,) = plan_of("algo=DPre env=R+N seed=0", tmp_path)
    folder = entry.cell.folders[0]
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("algo: DPre\nenv: R+N\nseed: '0'\nsteps: 300000\n")
    (folder / "evaluations.csv").write_text("step,return_mean,return_1,seconds\n")
    took = 3.0 * estimates.seconds(Config("DPre", "R+N", steps=300_000), entry.cell.paper, 1)
    result = {"return_mean": 1.0, "seeds_in_lockstep": 1, "seconds": {"total": took}}
    for steps in (estimates.TELLING_STEPS - 1, estimates.TELLING_STEPS):
        assert after_a_run_of(steps, result, folder, words, tmp_path, before) == (steps >= estimates.TELLING_STEPS)
    result["gradient_steps"] = 200_000
    (folder / "result.json").write_text(json.dumps(result))
    after = {entry.cell.name: entry.remaining for entry in plan_of(words, tmp_path)}
    assert after.pop("DPre R+N") == 0 and before.pop("DPre R+N") > 0
    for name, seconds in after.items():
        assert seconds == pytest.approx(3.0 * before[name])
    (folder / "result.json").write_text(json.dumps({"return_mean": 1.0, "seeds_in_lockstep": 1}))
    after = {entry.cell.name: entry.remaining for entry in plan_of(words, tmp_path)}
    assert {name: after[name] for name in before} == before
    (folder / "result.json").write_text(json.dumps(result))
    config_text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(config_text + "hidden: [16, 16]\n")
    after = {entry.cell.name: entry.remaining for entry in plan_of(words, tmp_path)}
    assert {name: after[name] for name in before} == before
    (folder / "config.yaml").write_text(config_text + "device: cuda:0\n")
    after = {entry.cell.name: entry.remaining for entry in plan_of(words, tmp_path)}
    assert {name: after[name] for name in before} == before
    after = {entry.cell.name: entry.remaining for entry in plan_of(f"{words} device=cuda", tmp_path)}
    assert after["DRad R+N"] == pytest.approx(3.0 * before["DRad R+N"])


def test_the_time_left_follows_the_pace_so_far(tmp_path):
    entries = plan_of("algo=DPre,DRad,NFW env=R+N seed=0", tmp_path)
    display = Display(entries, jobs=1)
    first, *others = entries
    assert display._eta({first: 0.0}, {first: 0.0}) == pytest.approx(sum(entry.remaining for entry in entries))
    display.end(first, End(0, 3.0 * first.remaining, ""))
    rest = sum(entry.remaining for entry in others)
    assert display._eta({}, {}) == pytest.approx(3.0 * rest)
    running = {others[0]: 1.5 * others[0].remaining}
    assert display._eta(running, {others[0]: 0.5}) == pytest.approx(3.0 * (rest - 0.5 * others[0].remaining))
    display.end(others[0], End(2, 1.0, "a reason"))
    display.end(others[1], End(3, others[1].remaining, ""))
    assert display.summary() == "2 of 3 cells done, 1 of them with a seed that diverged, 1 failed"


def test_a_dry_run_prints_the_plan_and_leaves_nothing(capsys, tmp_path):
    words = f"algo=DPre,SRad env=R+N,H+M seed=0-4 jobs=2 dry=true results={tmp_path / 'none'}"
    assert run_command(words.split()) == 0
    out = capsys.readouterr().out
    assert out.count(" new ") == 4 and "4 cells: 4 new" in out and "0-4" in out and " GB" in out
    assert "on one core in all" in out and "with 2 cells at a time" in out
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- the queue on this machine


def test_a_cell_that_fails_is_reported_and_the_others_are_carried_on(tmp_path):
    words = f"algo=DPre,SRad env=R+N seed=3,5 {SHORT} jobs=2"
    broken = next(e.cell for e in plan_of(words.replace(" jobs=2", ""), tmp_path) if e.cell.config.algo == "SRad")
    lock = broken.folders[1].with_name("seed=5.lock")
    lock.mkdir(parents=True)  # a folder in place of a file: this cell's process fails
    process = start(words, tmp_path)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 4, err
    assert "1 of 2 cells done, 1 failed" in out
    assert f"SRad R+N seed=3,5 failed: run.py: {lock}: is a directory\n    {broken.record('log')}" in err
    assert state_of(broken, {}).stage is Stage.FAILED and "is a directory" in state_of(broken, {}).detail
    (done,) = [cell for cell in find_cells(tmp_path) if cell.variant != broken.variant]
    assert state_of(done, {}).stage is Stage.FINISHED
    assert done.record("log").read_text().count("return ") == 2 and not done.record("end").exists()

    assert plot.main([str(tmp_path), "format=md"]) == 0

    lock.rmdir()
    again = start(words, tmp_path)
    out, err = again.communicate(timeout=240)
    assert again.returncode == 0 and "cells: 2, finished already: 1" in err and "2 of 2 cells done" in out
    assert not broken.record("end").exists() and done.record("log").read_text().count("+ ") == 1
    whole = tmp_path / "whole"
    assert run_command([*words.replace("jobs=2", "threads=1").split(), f"results={whole}"]) == 0
    assert_identical({k: v for k, v in outcomes(tmp_path).items() if not k.startswith("whole")}, outcomes(whole))


def test_ctrl_c_checkpoints_all_and_the_same_command_goes_on_bit_by_bit(tmp_path):
    words = f"algo=DPre,SRad,DAlpha env=R+L2 seed=3,5 {SHORT.replace('steps=300', 'steps=800')} jobs=2 threads=1"
    root = tmp_path / "broken"
    process = start(words, root)
    wait_until(lambda: len([f for f in root.glob("*/*/seed=3") if saved_step(f) > 100]) == 2, process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all processes of the session
    out, err = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGINT, err
    assert "3 not done" in out and "the same command resumes" in err and "Traceback" not in err
    assert not list(root.rglob("seed=*.lock"))
    states = sorted(state_of(cell, {}).stage.value for cell in find_cells(root))
    assert states == ["interrupted", "interrupted", "new"]
    assert sum("interrupted at step" in log.read_text() for log in root.glob("sweep/*/*/*.log")) == 2

    again = start(words, root)
    out, err = again.communicate(timeout=240)
    assert again.returncode == 0 and "3 of 3 cells done" in out, err
    assert sum("resuming from step" in log.read_text() for log in root.glob("sweep/*/*/*.log")) == 2
    assert run_command([*words.replace(" jobs=2", "").split(), f"results={tmp_path / 'whole'}"]) == 0
    assert_identical(outcomes(root), outcomes(tmp_path / "whole"))


def test_a_killed_process_and_a_diverging_seed_leave_the_others_alone(tmp_path):
    words = f"algo=DPre,DRad env=R+L2 seed=3,5 {SHORT.replace('steps=300', 'steps=800')} learning_rate=1e6 jobs=2"
    process = start(words, tmp_path)
    folder = next(
        e.cell for e in plan_of(words.replace(" jobs=2", ""), tmp_path) if e.cell.config.algo == "DRad"
    ).folders[0]
    lock = folder.with_name("seed=3.lock")
    wait_until(lambda: lock.exists() and lock_owner(folder), process)
    os.kill(json.loads(lock.read_text())["pid"], signal.SIGKILL)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 4, err
    assert "DRad R+L2 seed=3,5 failed: killed by SIGKILL" in err
    assert "1 of 2 cells done, 1 of them with a seed that diverged, 1 failed" in out
    assert "seed 3: failed at step" in state_of(next(c for c in find_cells(tmp_path) if "DPre" in c.variant), {}).detail


def test_cells_that_others_have_are_left_out(tmp_path, monkeypatch, capsys):
    words = [*f"algo=DPre,SRad,NFW env=R+N seed=3 {SHORT} jobs=1 threads=1".split(), f"results={tmp_path / 'results'}"]
    cells = {
        e.cell.config.algo: e.cell for e in plan_of(f"algo=DPre,SRad,NFW env=R+N seed=3 {SHORT}", tmp_path / "results")
    }
    fake(tmp_path, monkeypatch, squeue="echo 7 PENDING")
    cells["SRad"].write("job", {"job": "7", "log": "x"})
    lock = cells["NFW"].folders[0].with_name("seed=3.lock")
    lock.parent.mkdir(parents=True)
    lock.write_text(json.dumps({"pid": 7, "host": "elsewhere"}))
    for more in ([], ["overwrite=true"]):
        assert run_command([*words, *more]) == 2
        captured = capsys.readouterr()
        assert "1 of 1 cell done" in captured.out and "failed" not in captured.err
        (line,) = [line for line in captured.err.splitlines() if "skipped" in line]
        assert line.startswith("2 cells skipped because another process or job trains them")
        assert "is queued: job 7" in line or "on elsewhere" in line
        assert not cells["SRad"].record("log").exists() and not cells["NFW"].record("log").exists()


# ---------------------------------------------------------------- states


def fake(tmp_path, monkeypatch, **programs):
    """Put shell scripts with the names of Slurm's programs first in PATH."""
    folder = tmp_path / "bin"
    folder.mkdir(exist_ok=True)
    for name, script in programs.items():
        path = folder / name
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def test_states(tmp_path):
    cell = CellFolders(tmp_path, "R+N", "DPre", (0, 1))
    assert state_of(cell, {}).stage is Stage.NEW
    cell.write("job", {"job": "12_3", "log": "12_3.err"})
    assert state_of(cell, {"12_3": "PENDING"}).stage is Stage.QUEUED
    assert state_of(cell, {"12_3": "RUNNING", "12_4": "PENDING"}).stage is Stage.RUNNING
    assert state_of(cell, {"12_4": "RUNNING"}).stage is Stage.NEW
    for folder in cell.folders:
        folder.mkdir(parents=True)
    assert "job 12_3 ended early" in state_of(cell, {}).detail
    (cell.folders[0] / "checkpoint").mkdir()
    (cell.folders[0] / "checkpoint" / "replay-20-40.f32").touch()
    (cell.folders[1] / "result.json").touch()
    assert (state_of(cell, {}).stage, state_of(cell, {}).step) == (Stage.INTERRUPTED, 40)
    log = tmp_path / "log"
    log.write_text("  5%|bar\r 10%|bar\nrun.py: the reason\nsrun: error: vm: task 0: Exited\n\n")
    cell.note_end(2, log)
    assert state_of(cell, {}).detail == f"run.py: the reason (log: {log})"
    cell.note_end(-9, log)
    assert "killed by SIGKILL" in state_of(cell, {}).detail
    info, end = cell.folders[0] / "info.json", cell.record("end")
    info.touch()
    os.utime(info, ns=(0, end.stat().st_mtime_ns - 1))
    assert state_of(cell, {}).stage is Stage.FAILED
    os.utime(info, ns=(0, end.stat().st_mtime_ns + 1))  # a separate run.py has started since
    assert (state_of(cell, {}).stage, state_of(cell, {}).step) == (Stage.INTERRUPTED, 40)
    info.unlink()
    lock = cell.folders[0].with_name("seed=0.lock")
    lock.write_text(json.dumps({"pid": os.getppid(), "host": socket.gethostname()}))
    running = state_of(cell, {})
    assert (running.stage, running.detail) == (Stage.RUNNING, f"process {os.getppid()} on {socket.gethostname()}")
    lock.write_text(json.dumps({"pid": os.getppid(), "host": "elsewhere"}))
    assert state_of(cell, {}).detail == f"process {os.getppid()} on elsewhere"
    lock.unlink()
    (cell.folders[0] / "failed.json").write_text(json.dumps({"step": 7, "quantity": "loss"}))
    (cell.folders[0] / "config.yaml").write_text("{}")
    (cell.folders[0] / "evaluations.csv").write_text("step,return_mean,return_1,seconds\n")
    assert state_of(cell, {}).stage is Stage.FINISHED and "seed 0: failed at step 7: loss" in state_of(cell, {}).detail
    cell.note_end(3, log)
    assert not cell.record("end").exists()


def test_status_of_a_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    root = tmp_path / "results"
    queued = CellFolders(root, "H+M", "SRad,steps=10", (0, 1, 2))
    queued.write("job", {"job": "7_0", "log": "x"})
    queued.record("log").with_name("seed=0 (copy).log").touch()
    run_command(["algo=DPre", "env=R+N", "seed=3,5", *SHORT.split(), f"results={root}"])
    started = root / "R+N" / "DPre,steps=900" / "seed=4"
    started.mkdir(parents=True)
    (started / "config.yaml").write_text("steps: 900\n")
    (started / "evaluations.csv").write_text("step,return_mean,return_1,seconds\n300,1.0,1.0,1.0\n")
    capsys.readouterr()
    assert run_command(["status", str(root)]) == 0
    out = capsys.readouterr().out
    assert (
        "3 cells: 1 unknown, 1 finished, 1 interrupted" in out and "300/900" in out and "squeue does not answer" in out
    )
    fake(tmp_path, monkeypatch, squeue="echo 7_0 PENDING")
    assert run_command(["status", str(root)]) == 0
    out = capsys.readouterr().out
    assert "1 queued" in out and "job 7_0" in out and "squeue does not answer" not in out
    assert run_command(["status", f"results={root}"]) == 0
    assert capsys.readouterr().out == out


@pytest.mark.parametrize("words", [["status"], ["status", "a", "b"], ["status", "nowhere"], ["status", "."]])
def test_status_of_what_is_no_folder_of_results(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    assert run_command(words) == 2
    err = capsys.readouterr().err
    assert err.startswith("run.py: ") and err.count("\n") == 1


# ---------------------------------------------------------------- without a real Slurm


def test_jobs_that_slurm_knows(tmp_path, monkeypatch):
    assert slurm.queue([]) == {}
    fake(tmp_path, monkeypatch, squeue='echo "$@" >&2; echo 7_0 RUNNING; echo 7_1 PENDING; echo 8 COMPLETING')
    assert slurm.queue(["7_1", "8", "9_0"]) == {"7_1": "PENDING", "8": "COMPLETING"}
    fake(tmp_path, monkeypatch, squeue='case "$*" in *--states=all*) echo 7_0 SUSPENDED; echo 7_1 TIMEOUT;; esac')
    assert slurm.queue(["7_0", "7_1"]) == {"7_0": "SUSPENDED"}
    fake(tmp_path, monkeypatch, squeue="echo slurm_load_jobs error: Invalid job id specified >&2; exit 1")
    assert slurm.queue(["7_1"]) == {}
    fake(tmp_path, monkeypatch, squeue="echo Unable to contact slurm controller >&2; exit 1")
    assert slurm.queue(["7_1"]) is None
    monkeypatch.setenv("PATH", "")
    assert slurm.queue(["7_1"]) is None


@pytest.mark.parametrize(
    "squeue, here, taken",
    [
        ("echo 7_1 RUNNING", {}, False),  # the job still runs elsewhere
        ("echo 7_1 SUSPENDED", {}, False),
        ("echo 7_1 CANCELLED", {}, True),
        ("echo 7_0 RUNNING", {}, True),  # only its neighbour in the array runs
        ("", {"SLURM_CLUSTER_NAME": "small"}, False),  # this process asks another cluster
        ("", {"SLURM_CLUSTERS": "small"}, False),
        ("exit 1", {}, False),  # squeue fails
        ("exit 1", {"SLURM_ARRAY_TASK_ID": "1", "SLURM_RESTART_COUNT": "1"}, True),  # this is the job, requeued
        ("exit 1", {"SLURM_ARRAY_TASK_ID": "1"}, False),  # this is the job, not requeued
        ("exit 1", {"SLURM_ARRAY_TASK_ID": "2", "SLURM_RESTART_COUNT": "1"}, False),
    ],
)
def test_the_lock_of_a_job_on_a_node_that_died_is_taken_over(tmp_path, monkeypatch, squeue, here, taken):
    fake(tmp_path, monkeypatch, squeue=squeue, scontrol="echo 'ClusterName             = big'")
    for name in ("SLURM_JOB_ID", "SLURM_ARRAY_JOB_ID", "SLURM_CLUSTER_NAME", "SLURM_CLUSTERS", "SLURM_RESTART_COUNT"):
        monkeypatch.delenv(name, raising=False)
    lock = tmp_path / "seed=1.lock"
    job = {"cluster": "big", "id": "7_1", "restarts": 0}
    lock.write_text(json.dumps({"pid": 7, "host": "node-12", "job": job}))
    if here:
        slurm_variables = {"SLURM_JOB_ID": "9", "SLURM_ARRAY_JOB_ID": "7", "SLURM_CLUSTER_NAME": "big"}
        for name, value in (slurm_variables | here).items():
            monkeypatch.setenv(name, value)
    assert (lock_owner(tmp_path / "seed=1") is None) == taken
    if not taken:
        with pytest.raises(LockedError, match="by process 7 on node-12"):
            run_lock(tmp_path / "seed=1").__enter__()
        return
    with run_lock(tmp_path / "seed=1"):
        owner = json.loads(lock.read_text())
        assert owner["pid"] == os.getpid() and owner.get("job", {}).get("restarts") == (1 if here else None)


def test_a_lock_that_another_host_takes_over_while_slurm_is_asked_is_left_to_it(tmp_path, monkeypatch):
    lock, other = tmp_path / "seed=1.lock", tmp_path / "other"
    job = {"cluster": "big", "id": "7_1", "restarts": 0}
    lock.write_text(json.dumps({"pid": 7, "host": "node-12", "job": job}))
    other.write_text(json.dumps({"pid": 8, "host": "node-13"}))
    fake(tmp_path, monkeypatch, squeue=f"cat {other} > {lock}")
    monkeypatch.setenv("SLURM_CLUSTERS", "big")
    with pytest.raises(LockedError, match="by process 8 on node-13"):
        run_lock(tmp_path / "seed=1").__enter__()


@pytest.mark.parametrize("signum", [signal.SIGUSR1, signal.SIGUSR2])
def test_the_signals_of_batch_systems_are_noted(signum):
    with Interrupts() as interrupts:
        os.kill(os.getpid(), signum)
        with pytest.raises(Interrupted):
            interrupts.stop_if_asked()


def test_without_slurm_or_submitit_one_line_says_so(tmp_path, monkeypatch, capsys):
    words = ["algo=DPre", "env=R+N", "launcher=slurm", f"results={tmp_path / 'results'}"]
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))
        assert run_command(words) == 2
    assert "there is no sbatch on the PATH" in capsys.readouterr().err
    fake(tmp_path, monkeypatch, sbatch="exit 1")
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert run_command(words) == 2
    assert "pip install -e '.[slurm]'" in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Stand-ins for Slurm's programs: jobs are accepted, but never run."""
    pytest.importorskip("submitit")
    (tmp_path / "queue").write_text("")
    number = f'n=$(($(cat {tmp_path}/n 2>/dev/null || echo 40) + 1)); echo $n > {tmp_path}/n; cp "$1" {tmp_path}/$n.sh'
    fake(
        tmp_path, monkeypatch, srun="", squeue=f"cat {tmp_path}/queue", sbatch=f"{number}; echo Submitted batch job $n",
        scontrol="echo 'ClusterName             = big'",
    )  # fmt: skip
    for name in ("SLURM_CLUSTERS", "SLURM_CLUSTER_NAME", "SBATCH_CLUSTERS"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_only_what_is_neither_finished_nor_queued_is_submitted(cluster, capsys):
    root = cluster / "results"
    words = [
        *f"algo=DPre,SRad,NFW env=R+N,R+L2 seed=3,5 {SHORT} launcher=slurm slurm.partition=short".split(),
        *[
            "slurm.hours=2.5",
            "slurm.cpus=3",
            "slurm.gpus=1",
            "device=cuda",
            "slurm.parallel=4",
            "slurm.account=me",
            "slurm.exclusive=true",
        ],
        f"results={root}",
    ]
    run_command(["algo=NFW", "env=R+L2", "seed=3,5", *SHORT.split(), f"results={root}"])
    capsys.readouterr()
    assert run_command(words) == 0
    out = capsys.readouterr().out
    assert "6 cells: 5 new, 1 finished" in out and "submitted 5 as job 41" in out
    script = (cluster / "41.sh").read_text()
    for said in (
        "--array=0-4%4", "--partition=short", "--time=150", "--cpus-per-task=3", "--gpus-per-node=1", "--account=me",
        "--exclusive\n", "--requeue\n", "--signal=USR2@120", "--mem=1GB",
    ):  # fmt: skip
        assert f"#SBATCH {said}" in script
    cells = {cell.read("job")["job"]: cell for cell in find_cells(root) if cell.read("job")}
    assert sorted(cells) == [f"41_{task}" for task in range(5)]

    (cluster / "queue").write_text("".join(f"41_{task} PENDING\n" for task in range(5)))
    assert run_command(words) == 0
    assert "nothing to submit" in capsys.readouterr().out and not (cluster / "42.sh").exists()

    (cluster / "queue").write_text("41_0 RUNNING\n41_1 PENDING\n41_2 RUNNING\n41_4 COMPLETING\n")
    assert run_command(words) == 0
    assert "submitted 1 as job 42" in capsys.readouterr().out
    assert cells["41_3"].read("job")["job"] == "42" and "--array" not in (cluster / "42.sh").read_text()
    assert len(list(root.glob("*/*/seed=*/result.json"))) == 2


def test_a_job_of_another_cluster_is_not_taken_for_gone(cluster, monkeypatch, capsys):
    words = ["algo=DPre", "env=R+N", f"results={cluster / 'results'}"]
    assert run_command([*words, "launcher=slurm"]) == 0
    (cell,) = find_cells_of(cluster)
    assert cell.read("job")["cluster"] == "big"
    assert state_of(cell, job_states([cell])).stage is Stage.NEW  # the job is over
    monkeypatch.setenv("SLURM_CLUSTER_NAME", "small")
    (cluster / "queue").write_text("41 RUNNING\n")  # another job with that number
    capsys.readouterr()
    assert run_command([*words, "launcher=slurm"]) == 0
    said = f"Slurm does not say here whether job 41 of cluster big is over; if it is, delete {cell.record('job')}"
    out = capsys.readouterr().out
    assert f"DPre R+N is not submitted: {said}" in out and "nothing to submit" in out
    assert not (cluster / "42.sh").exists()
    assert run_command(["status", str(cluster / "results")]) == 0
    out = capsys.readouterr().out
    assert "1 cell: 1 unknown" in out and said in out
    cell.note_end(2, cluster / "log")  # the job itself has recorded its end
    assert state_of(cell, job_states([cell])).stage is Stage.FAILED
    assert run_command([*words, "launcher=slurm", "slurm.clusters=huge"]) == 0
    assert cell.read("job")["cluster"] == "huge"


def test_a_submission_that_another_host_left_open_names_its_lock(cluster, capsys):
    lock = cluster / "results" / "sweep" / "submission.lock"
    lock.parent.mkdir(parents=True)
    lock.write_text(json.dumps({"pid": 7, "host": "elsewhere"}))
    assert run_command(["algo=DPre", "env=R+N", "launcher=slurm", f"results={cluster / 'results'}"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and f"by process 7 on elsewhere; if that process has ended, delete {lock}" in err


def test_what_sbatch_refuses_is_said_in_one_line(cluster, monkeypatch, capsys):
    words = ["algo=DPre", "env=R+N", "launcher=slurm", f"results={cluster / 'results'}"]
    fake(cluster, monkeypatch, sbatch="echo 'sbatch: error: invalid partition specified: x' >&2; exit 1")
    assert run_command([*words, "slurm.partition=x"]) == 2
    err = capsys.readouterr().err
    assert err == "run.py: sbatch: error: invalid partition specified: x\n"
    refusal = "if [ \"$1\" = --help ]; then echo '  --account=name --nice'; exit; fi"
    fake(cluster, monkeypatch, sbatch=f"{refusal}; echo \"sbatch: unrecognized option '--acount=me'\" >&2; exit 1")
    assert run_command([*words, "slurm.acount=me"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "unknown sbatch parameter 'acount'; did you mean account?" in err
    fake(cluster, monkeypatch, squeue="exit 1")
    next(iter(find_cells_of(cluster))).write("job", {"job": "41", "log": "x"})
    assert run_command(words) == 2
    assert "squeue does not answer" in capsys.readouterr().err


@pytest.fixture
def job(cluster, monkeypatch):
    """A cell's job: `end(code, step)` trains it up to a checkpoint at `step`, ends it with `code`, and returns whether
    it was requeued."""
    from sweep import slurm as module

    (cluster / "queue").write_text("41 RUNNING\n")
    fake(cluster, monkeypatch, scontrol=f'echo "$@" >> {cluster}/scontrol')
    for name in ("SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"SUBMITIT_EXECUTOR": "slurm", "SUBMITIT_FOLDER": str(cluster), "SLURM_JOB_ID": "41"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(module, "PATIENCE", 0.2)
    monkeypatch.setattr(module, "PAUSES", (0.01, 0.02))
    (cell,) = find_cells_of(cluster)
    previous = signal.signal(signal.SIGUSR2, lambda *_: subprocess.check_call(["scontrol", "requeue", "41"]))

    def end(code, step):
        def train_cells(cells, stop_if_asked):
            assert cells == [cell]
            (cell.folders[0] / "checkpoint").mkdir(parents=True, exist_ok=True)
            (cell.folders[0] / "checkpoint" / f"replay-0-{step}.f32").touch()
            raise Interrupted(code - 128)

        monkeypatch.setattr(module, "train_cells", train_cells)
        with pytest.raises((SystemExit, subprocess.CalledProcessError)):
            module.Job(cell)()
        signal.signal(signal.SIGUSR2, lambda *_: subprocess.check_call(["scontrol", "requeue", "41"]))
        requeued = (cluster / "scontrol").exists()
        (cluster / "scontrol").unlink(missing_ok=True)
        return requeued

    end.cell = cell
    yield end
    signal.signal(signal.SIGUSR2, previous)


USR2, TERM = 128 + signal.SIGUSR2, 128 + signal.SIGTERM


def test_a_job_requeues_itself_unless_it_was_cancelled(cluster, monkeypatch, job):
    assert job(USR2, 20) and job(TERM, 30) and not job.cell.record("end").exists()
    for queue in ("41 COMPLETING\n", "41 CANCELLED\n", ""):
        (cluster / "queue").write_text(queue)
        assert not job(TERM, 40)
    assert not job.cell.record("end").exists()
    once = f"[ -e {cluster}/asked ] && echo 41 COMPLETING || {{ touch {cluster}/asked; exit 1; }}"
    fake(cluster, monkeypatch, squeue=once)  # squeue does not answer at first
    assert not job(TERM, 50)
    fake(cluster, monkeypatch, squeue="exit 1")
    assert job(TERM, 60)


def test_a_job_that_cannot_be_requeued_says_so(cluster, monkeypatch, job):
    fake(cluster, monkeypatch, scontrol="exit 1")
    job(USR2, 20)
    state = state_of(job.cell, {})
    assert state.stage is Stage.FAILED and "could not be requeued: " in state.detail and "scontrol" in state.detail


def test_a_job_without_a_checkpoint_before_its_time_limit_is_not_requeued_for_ever(job):
    assert job(USR2, 20) and not job(USR2, 20)
    state = state_of(job.cell, {})
    assert state.stage is Stage.FAILED and "not requeued: the job wrote no new checkpoint before" in state.detail
    assert job(TERM, 20)  # preempted at once


def find_cells_of(cluster):
    return cells_of(["algo=DPre", "env=R+N", f"results={cluster / 'results'}"])
