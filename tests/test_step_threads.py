"""Robots stepped in several threads give the same bits as in one thread, and their errors are raised."""

import multiprocessing
import threading

import numpy as np
import pytest
import torch

import envs
from envs.threads import call_each


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("task", ["HC+O", "H+M", "W+M"])
def test_robots_in_threads_do_what_they_do_in_one(task, threads):
    groups = {count: [envs.make(task, project=True) for _ in range(7)] for count in (1, 3)}
    for group in groups.values():
        for seed, env in enumerate(group):
            env.reset(seed=seed)
    rng = np.random.default_rng(0)
    for t in range(60):
        actions = rng.uniform(-1, 1, (7, groups[1][0].robot.action_dim)).astype(np.float32 if t % 2 else np.float64)
        outcomes = {}
        for count, group in groups.items():
            threads(count)
            outcomes[count] = envs.step_together(group, actions)
        for k, (one, other) in enumerate(zip(*outcomes.values(), strict=True)):
            np.testing.assert_array_equal(one[0], other[0])
            assert one[1:4] == other[1:4] and repr(one[4]) == repr(other[4])
            if any(one[2:4]):
                for group in groups.values():
                    group[k].reset()


@pytest.mark.parametrize("task", ["HC+O", "W+M"])
def test_many_robots_do_what_each_does_in_a_step_of_its_own(task):
    together, alone = ([envs.make(task).robot for _ in range(5)] for _ in range(2))
    for group in (together, alone):
        for seed, robot in enumerate(group):
            robot.reset(np.random.default_rng(seed))
    rng = np.random.default_rng(0)
    for t in range(50):
        actions = [*rng.uniform(-1, 1, (5, together[0].action_dim)).astype(np.float32)]
        if t % 3 == 0:
            actions[2] = actions[2].astype(np.float64)
        steps = type(together[0]).step_together(together, actions)
        for robot, action, step in zip(alone, actions, steps, strict=True):
            wanted = robot.step(action)
            np.testing.assert_array_equal(step[0], wanted[0])
            assert step[1:3] == wanted[1:3] and repr(step[3]) == repr(wanted[3])


@pytest.mark.parametrize("threads_used, count", [(1, 7), (2, 7), (4, 7), (9, 4), (4, 1), (4, 0)])
def test_each_is_called_once(threads_used, count):
    called, seen = [], set()

    def call(k):
        called.append(k)
        seen.add(threading.get_ident())

    call_each([lambda k=k: call(k) for k in range(count)], threads_used)
    assert sorted(called) == list(range(count)) and len(seen) <= max(1, min(threads_used, count // 2))


def test_an_error_in_a_thread_is_raised():
    def fail():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        call_each([lambda: None, lambda: None, lambda: None, fail], 2)


def _in_child(connection):
    call_each([lambda: None] * 4, 2)
    connection.send("done")


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
def test_a_forked_process_has_threads_of_its_own():
    call_each([lambda: None] * 4, 2)
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    child = context.Process(target=_in_child, args=(there,))
    child.start()
    assert here.poll(60) and here.recv() == "done"
    child.join()
