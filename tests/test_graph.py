"""Gradient steps on a GPU: captured once and repeated, with every seed's own random numbers and no wait for the GPU.

Without a GPU, a stand-in for CUDA's graphs repeats captured operations by calling them again, and PyTorch's meta device
shows that a step reads no values from its device.
"""

from contextlib import contextmanager, nullcontext
from dataclasses import replace

import pytest
import torch
from helpers import cells_of, config_of, run_command

import core.ahead
import core.cuda_graph
import envs
from algos import ALGORITHMS
from algos.aram import ARAM
from constraints import LinearConstraint
from core.captured import EAGER_CALLS
from core.cuda_graph import EAGER_STEPS, GradientSteps
from core.replay import Batch, Replay
from store.folder import read_run
from store.interrupt import Interrupted
from sweep.definition import define
from sweep.train import train as train_cell

SEEDS = [3, 8]
BATCH = 16
STEPS = 12
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")


def make(name, task="W+M", device="cpu"):
    """An agent with small networks, a replay buffer with random transitions, and a function that adds more."""
    words = ["snapshots_after=1", "snapshot_every=2"] if name == "ARAM" else []
    config = config_of([f"algo={name}", f"env={task}", "hidden=[16,16]", f"batch_size={BATCH}", *words])
    constraint, robot = envs.constraint(task), envs.TASKS[task].robot
    agent = ALGORITHMS[name].build(replace(config, device=device), constraint, robot.obs_dim, SEEDS)
    agent.map.use_untrained(constraint, torch.zeros(1, robot.obs_dim))
    replay = Replay(SEEDS, 60, agent.obs_dim, agent.action_dim, agent.stores_centers, agent.device)
    generator = torch.Generator().manual_seed(0)

    def grow(count):
        for _ in range(count):
            obs, next_obs = (torch.randn(2, agent.obs_dim, generator=generator) for _ in range(2))
            uniform = torch.rand(2, agent.action_dim, generator=generator) * 2 - 1
            action = agent.map.pull_back(constraint, obs, uniform, None)
            reward, terminated = torch.randn(2, 1, generator=generator), torch.zeros(2, 1)
            centers = agent.centers(obs), agent.centers(next_obs)
            replay.add([0, 1], Batch(obs, action, reward, terminated, next_obs, *centers))
            if name == "ARAM" and device != "meta":  # ARAM has a second buffer
                agent.remember([0, 1], obs, uniform.unsqueeze(1), torch.tensor([1, 1]), torch.zeros(2))

    grow(20)
    return agent, replay, grow


def train(agent, replay, grow):
    """Take gradient steps while the buffer grows and wraps."""
    step = GradientSteps(agent, replay, BATCH)
    for _ in range(STEPS):
        agent.start_rollout([0, 1])
        step()
        grow(5)
    check_copies(agent)
    return step


def check_copies(agent):
    """Check that ARAM has made its copies of the critic, most of them after a graph has been captured."""
    if isinstance(agent, ARAM):
        assert agent.copies.tolist() == [5, 5] and not agent.missing.any()


def outcome(agent):
    return [agent.training_state(i) for i in range(len(SEEDS))]


class FakeGraph:
    """Replays by calling the captured function again. `capture` below undoes the step taken while capturing."""

    made = 0

    def __init__(self):
        FakeGraph.made += 1
        self.call = None

    def replay(self):
        self.call()


@pytest.fixture
def cuda_stand_in(monkeypatch):
    """Makes GradientSteps treat the CPU as a GPU."""
    FakeGraph.made = 0

    class Device:
        type = "cuda"

    class Captured(core.cuda_graph.CapturedStep):
        def __init__(self, agent, step):
            def again():
                updates = agent.updates
                step()
                agent.updates = updates  # a graph's Python code does not run again

            @contextmanager
            def capture(graph):
                before, rows = outcome(agent), [streams.ahead.row.clone() for streams in steps_of[0].streams]
                yield
                for i, state in enumerate(before):
                    agent.load_training_state(i, state | {"updates": agent.updates})
                for streams, row in zip(steps_of[0].streams, rows, strict=True):
                    streams.ahead.row.copy_(row)
                graph.call = again

            monkeypatch.setattr(torch.cuda, "graph", capture)
            super().__init__(agent, step)

    steps_of = []

    class Steps(GradientSteps):
        def __init__(self, agent, replay, batch_size):
            super().__init__(agent, replay, batch_size)
            steps_of[:] = [self]

        def __call__(self):
            device, self.agent.device = self.agent.device, Device()
            try:
                super().__call__()
            finally:
                self.agent.device = device

    class Stream:
        def __init__(self, device=None):
            pass

        def wait_stream(self, stream):
            pass

    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "CUDAGraph", FakeGraph)
    monkeypatch.setattr(core.cuda_graph, "CapturedStep", Captured)
    return Steps


@pytest.mark.parametrize("name", ["DPre+", "DRad", "NFW", "SPre", "SAlpha", "ARAM"])
@pytest.mark.parametrize("block", [4, core.ahead.BLOCK])
def test_repeated_steps_draw_the_numbers_of_eager_ones(name, block, cuda_stand_in, monkeypatch):
    monkeypatch.setattr(core.ahead, "BLOCK", block)
    eager, repeated = make(name), make(name)
    train(*eager)
    monkeypatch.setitem(globals(), "GradientSteps", cuda_stand_in)
    steps = train(*repeated)
    kinds = eager[0].cycle
    assert FakeGraph.made == len(steps.captured) == kinds and steps.eager == [EAGER_STEPS] * kinds
    for one, other in zip(outcome(eager[0]), outcome(repeated[0]), strict=True):
        assert one["updates"] == other["updates"]
        for what in ("parameters", "optimizers", "memory", "streams"):
            assert one[what].keys() == other[what].keys()
            assert all(torch.equal(value, other[what][key]) for key, value in one[what].items()), what
    assert torch.equal(*(replay.streams.state(1) for replay in (eager[1], repeated[1])))


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("task", ["W+M", "R+T"])
def test_a_gradient_step_asks_nothing_of_its_device(name, task):
    agent, replay, _ = make(name, task)
    batch, there = replay.sample(BATCH), make(name, task, "meta")[0]
    on_meta = batch._make(x if x is None else x.to("meta") for x in batch)
    for _ in range(agent.cycle):
        agent.update(batch)
        there.update(on_meta)  # reading a value raises an error
    assert all(p.device.type == "meta" for module in there.networks().values() for p in module.parameters())
    assert {name: losses.shape for name, losses in there.losses.items()} == {
        name: losses.shape for name, losses in agent.losses.items()
    }


@pytest.mark.parametrize("name, task", [("DPre", "W+M"), ("SPre", "W+M"), ("SRad", "R+L2")])
def test_repeated_exploration_is_that_of_eager_calls(name, task, monkeypatch):
    """The stand-in for a CUDA graph calls the function again on the memory of the captured inputs."""

    class Graph:
        def replay(self):
            captured.output.copy_(captured.function(*captured.inputs))

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph: nullcontext())
    eager, repeated = make(name, task)[0], make(name, task)[0]
    captured = repeated.explored
    captured.device = torch.device("cuda")
    expected, found = (explored(agent, 3 * EAGER_CALLS) for agent in (eager, repeated))
    assert torch.equal(found, expected)
    assert captured.calls == EAGER_CALLS and isinstance(captured.graph, Graph) and eager.explored.graph is None


def explored(agent, calls, device="cpu"):
    """Suggestions of `calls` steps. The actor changes between them, and the stream of noise continues."""
    generator = torch.Generator().manual_seed(1)
    found = []
    for number in range(calls):
        obs = torch.randn(len(SEEDS), agent.obs_dim, generator=generator)
        which = [0, 1] if number % 3 else [1]
        agent.start_rollout(which)
        found.append(agent.explore(obs.to(device), which).cpu()[which])
        with torch.no_grad():
            for parameter in agent.actor.parameters():
                parameter.mul_(1.1)
    return torch.cat(found)


@needs_cuda
@pytest.mark.parametrize(
    "name, task", [("DPre", "W+M"), ("DRad", "R+L2"), ("SPre", "W+M"), ("SRad", "R+L2"), ("ARAM", "W+M")]
)
def test_exploration_on_a_gpu_is_repeated_as_a_graph(name, task):
    here, there = make(name, task)[0], make(name, task, "cuda")[0]
    expected, found = explored(here, 3 * EAGER_CALLS), explored(there, 3 * EAGER_CALLS, "cuda")
    assert there.explored.graph is not None and here.explored.graph is None
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@needs_cuda
@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("task", ["W+M", "HC+O", "R+T"])
def test_cuda_learns_what_the_cpu_learns_and_never_waits(name, task, monkeypatch):
    monkeypatch.setattr(core.ahead, "BLOCK", 4)
    here, there = make(name, task), make(name, task, "cuda")
    train(*here)
    steps = GradientSteps(there[0], there[1], BATCH)
    for number in range(STEPS):
        there[0].start_rollout([0, 1])
        torch.cuda.set_sync_debug_mode("error" if number >= (EAGER_STEPS + 1) * there[0].cycle else "default")
        try:
            steps()
        finally:
            torch.cuda.set_sync_debug_mode("default")
        there[2](5)
    check_copies(there[0])
    assert len(steps.captured) == there[0].cycle
    for one, other in zip(outcome(here[0]), outcome(there[0]), strict=True):
        for key, value in one["parameters"].items():
            torch.testing.assert_close(other["parameters"][key], value, rtol=1e-3, atol=1e-4, msg=key)


@needs_cuda
@pytest.mark.parametrize("name", ["DPre", "SRad", "ARAM"])
def test_a_run_on_a_gpu_is_interrupted_and_resumed_with_the_same_bits(name, tmp_path):
    words = f"algo={name} env=W+M seed=0,1 steps=300 learning_starts=100 train_freq=20 gradient_steps=20 device=cuda"
    words += " hidden=[16,16] batch_size=16 eval_every=100 eval_episodes=1 final_episodes=1"
    if name == "ARAM":
        words += " snapshots_after=20 snapshot_every=30"

    def train(folder, check=lambda: None):
        (cell,) = cells_of([*words.split(), f"results={folder}"])
        return train_cell(cell, define(cell.config.env, cell.config.algo), check)

    calls = []

    def interrupt():
        calls.append(None)
        if len(calls) == 400:  # of about 500, in environment and gradient steps
            raise Interrupted(15)

    train(tmp_path / "whole")
    with pytest.raises(Interrupted):
        train(tmp_path / "broken", interrupt)
    train(tmp_path / "broken")
    for whole in (tmp_path / "whole").glob("*/*/seed=*/"):
        broken = tmp_path / "broken" / whole.relative_to(tmp_path / "whole")
        one, other = (read_run(folder).result for folder in (whole, broken))
        assert one["gradient_steps"] > 4 * EAGER_STEPS
        assert one["returns"] == other["returns"]
        parameters = [torch.load(folder / "last.pt", weights_only=True) for folder in (whole, broken)]
        assert all(torch.equal(value, parameters[1][key]) for key, value in parameters[0].items())


def test_a_captured_step_goes_on_from_any_moment(cuda_stand_in, monkeypatch):
    """A checkpoint in the middle of a block has the same stream states as without blocks."""
    monkeypatch.setitem(globals(), "GradientSteps", cuda_stand_in)
    whole, broken = make("DPre"), make("DPre")
    train(*whole)
    step = GradientSteps(broken[0], broken[1], BATCH)
    for number in range(STEPS):
        step()
        broken[2](5)
        if number == 8:
            saved = outcome(broken[0])
            sampling = [broken[1].streams.state(i) for i in range(len(SEEDS))]
    agent, replay, grow = make("DPre")
    for _ in range(9):
        grow(5)
    for i, state in enumerate(saved):
        agent.load_training_state(i, state)
        replay.streams.load_state(i, sampling[i])
    step = GradientSteps(agent, replay, BATCH)
    for _ in range(9, STEPS):
        step()
        grow(5)
    for one, other in zip(outcome(whole[0]), outcome(agent), strict=True):
        for what in ("parameters", "streams"):
            assert all(torch.equal(value, other[what][key]) for key, value in one[what].items()), what


def test_an_algorithm_that_does_not_count_its_steps_is_an_error(cuda_stand_in, monkeypatch):
    agent, replay, _ = make("DPre")
    monkeypatch.setattr(agent, "update", lambda batch: None)
    with pytest.raises(RuntimeError, match="must add 1 to `updates`"):
        cuda_stand_in(agent, replay, BATCH)()


def test_a_set_that_is_solved_on_the_cpu_is_never_captured(cuda_stand_in, monkeypatch):
    agent, replay, grow = make("DOpt")
    agent.constraint = LinearConstraint(
        A=lambda obs: obs[..., None, : agent.action_dim], b=lambda obs: obs[..., :1] * 0 + 1.0, dim=agent.action_dim
    )
    monkeypatch.setitem(globals(), "GradientSteps", cuda_stand_in)
    assert not train(agent, replay, grow).captured and FakeGraph.made == 0 and agent.updates == STEPS


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_a_gpu_that_is_not_there_is_an_error_in_one_line(capsys):
    assert run_command(["algo=SRad", "env=R+N", "device=cuda"]) == 2
    message = capsys.readouterr().err
    assert message == "run.py: bad value 'cuda' for device; PyTorch sees no CUDA GPU here (choices: cpu)\n"
