"""Signals: a command ends with a checkpoint and an exit code that names the signal."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import CHECKPOINTED, Breaks, assert_identical, outcome, run_command

from store.interrupt import Interrupted, Interrupts
from sweep.train import train_words

ROOT = Path(__file__).parents[1]


def script(code):
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)


def test_a_second_signal_ends_the_process_at_once():
    done = script(
        "import os, signal, time\n"
        "from store.interrupt import SAME_EVENT, Interrupted, Interrupts\n"
        "with Interrupts() as interrupts:\n"
        "    interrupts.stop_if_asked()\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    try:\n"
        "        interrupts.stop_if_asked()\n"
        "    except Interrupted as interrupted:\n"
        "        print('noted', interrupted.signum, flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    print('the same event', flush=True)\n"
        "    time.sleep(SAME_EVENT + 0.1)\n"
        "    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    print('hung up', flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    print('never', flush=True)\n"
    )
    assert done.returncode == -signal.SIGTERM
    assert done.stdout.splitlines() == ["noted 15", "the same event", "hung up"]


def test_handlers_are_put_back_and_an_ignored_signal_stays_ignored():
    done = script(
        "import os, signal\n"
        "from store.interrupt import Interrupts\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "with Interrupts() as interrupts:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    interrupts.stop_if_asked()\n"
        "print(signal.getsignal(signal.SIGTERM) == signal.SIG_DFL, signal.getsignal(signal.SIGINT) == signal.SIG_IGN)\n"
    )
    assert done.returncode == 0 and done.stdout.split() == ["True", "True"], done.stderr


def test_a_program_of_ones_own_that_trains_ends_with_a_checkpoint_too(tmp_path, capsys, monkeypatch, unbroken):
    check = Breaks(77, error=Interrupted(signal.SIGINT))
    monkeypatch.setattr(Interrupts, "stop_if_asked", lambda self: check())
    words = f"{CHECKPOINTED} results={tmp_path}"
    with pytest.raises(SystemExit) as ended:
        train_words(words)
    assert ended.value.code == 130 and "the same command resumes" in capsys.readouterr().err
    assert train_words(words)
    assert capsys.readouterr().out.count("resuming from step") == 2
    assert_identical(outcome(tmp_path), unbroken)


def test_a_first_ctrl_c_ends_a_command_that_does_not_train():
    done = script(
        "import os, signal, time, run\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell may have started us with it ignored
        "def describe(words):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(5)\n"
        "    return 'never'\n"
        "run.describe_status = describe\n"
        "print(run.main(['status']))\n"
    )
    assert done.stdout.split() == ["130"]


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_exit_code_says_which_signal(tmp_path, capsys, monkeypatch, signum, unbroken):
    check = Breaks(77, error=Interrupted(signum))
    monkeypatch.setattr(Interrupts, "stop_if_asked", lambda self: check())
    words = [*CHECKPOINTED.split(), f"results={tmp_path}"]
    assert run_command(words) == 128 + signum
    captured = capsys.readouterr()
    assert "interrupted at step" in captured.err and "the same command resumes" in captured.err
    assert run_command(words) == 0
    assert capsys.readouterr().out.count("resuming from step") == 2
    assert_identical(outcome(tmp_path), unbroken)
