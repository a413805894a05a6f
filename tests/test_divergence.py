"""A seed that diverges stops with a record; the other seeds learn the same bits as without its failure."""

import json
import math
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from helpers import Breaks, assert_identical, outcome, run_command, train, train_through

import envs
from algos import ALGORITHMS
from core.random import stream_seed
from envs import ActionConstrainedEnv
from plots.grouping import count_diverged, count_failed, group_runs, list_diverged, list_left_out
from store.folder import read_results, read_run
from store.interrupt import Interrupted

WORDS = (
    "seed=3,5,8 steps=120 learning_starts=40 batch_size=8 hidden=[8,8] eval_every=60 eval_episodes=1 final_episodes=1"
    " train_freq=1 gradient_steps=1"
)
BAD = 1  # position of the seed that diverges
MOMENT = 46  # the gradient step in which it diverges; the actor learns in this step


def spoil(network, value, seed=BAD, where=...):
    """A function that sets weights of the first layer of `network` to `value`, for the seed in position `seed`."""

    def how(agent):
        for name, parameter in agent.networks()[network].named_parameters():
            if name.endswith("layers.0.weight"):
                parameter.data[seed][where] = value

    return how


def poison(monkeypatch, algo, how, at=MOMENT):
    """Let `how(agent)` spoil the agent before its gradient step number `at`."""
    agent_class = ALGORITHMS[algo].agent
    update, counts = agent_class.update, {}

    def spoiled(self, batch):
        counts[self] = counts.get(self, 0) + 1
        if counts[self] == at:
            how(self)
        update(self, batch)

    monkeypatch.setattr(agent_class, "update", spoiled)


def failures(root):
    return {path.parent.name: json.loads(path.read_text()) for path in root.glob("*/*/seed=?/failed.json")}


@pytest.mark.parametrize(
    "cell, network, value, quantity",
    [
        ("algo=DPre+ env=R+O10", "critic", math.nan, "critic loss is not finite"),
        ("algo=DPre+ env=R+O10", "critic", 1e30, "critic loss is not finite"),
        ("algo=DOpt env=W+O+S", "actor", math.nan, "actor loss is not finite"),
        ("algo=NFW env=H+O+S", "critic", math.inf, "critic loss is not finite"),
        ("algo=DAlpha env=W+M", "critic_target", math.nan, "critic loss is not finite"),
        ("algo=SRad env=R+M", "critic", math.nan, "critic loss is not finite"),
        ("algo=SAlpha env=W+M", "actor", math.nan, "temperature loss is not finite"),
    ],
)
def test_the_neighbours_of_a_seed_that_diverges_notice_nothing(
    tmp_path, monkeypatch, capsys, cell, network, value, quantity
):
    words = f"{cell} {WORDS}"
    train(tmp_path / "sound", words)
    poison(monkeypatch, cell.split()[0].partition("=")[2], spoil(network, value))
    assert run_command([*words.split(), f"results={tmp_path / 'spoiled'}"]) == 3
    (failed,) = failures(tmp_path / "spoiled").items()
    assert failed[0] == "seed=5" and failed[1]["quantity"] == quantity
    assert failed[1]["step"] == 40 + MOMENT and failed[1]["gradient_steps"] == MOMENT
    sound = outcome(tmp_path / "sound")
    assert failed[1]["last_evaluation"] == {
        "step": 60,
        "return_mean": float(sound["seed=5"]["evaluations"][1].split(",")[1]),
    }
    spoiled = outcome_of_finished(tmp_path / "spoiled")
    assert_identical({seed: sound[seed] for seed in ("seed=3", "seed=8")}, spoiled)


def outcome_of_finished(root):
    for folder in root.glob("*/*/seed=5"):
        folder.rename(folder.with_name("aside"))
    return outcome(root)


def test_a_failed_run_is_reported_and_not_run_again_unless_asked(tmp_path, monkeypatch, capsys):
    words = [*f"algo=DPre env=R+N {WORDS}".split(), f"results={tmp_path}"]
    with monkeypatch.context() as patch:
        poison(patch, "DPre", spoil("critic", math.nan))
        assert run_command(words) == 3
    (folder,) = tmp_path.glob("*/*/seed=5")
    said = f"{folder}: failed at step 86: critic loss is not finite"
    assert said in capsys.readouterr().err
    runs, problems = read_results(tmp_path)
    assert problems == [] and len(runs) == 3
    (line,) = list_diverged(groups := group_runs(runs)[0])
    assert (
        "DPre: 1 of 3 seeds diverged and count with their best parameters before: seed 5 failed at step 86: critic loss"
        in line
    )
    assert list_left_out(groups) == []
    ((cell,),) = [by_algo.values() for by_algo in groups.values()]
    assert (count_failed(cell), count_diverged(cell)) == (0, 1)
    failed = read_run(folder)
    assert failed.failure["step"] == 86 and not failed.finished and failed.evaluations.step.tolist() == [60]
    assert not (folder / "checkpoint").exists() and (folder / "last.pt").is_file()
    assert torch.load(folder / "last.pt", weights_only=True)["critic.net.layers.0.weight"].isnan().any()
    assert torch.load(folder / "best.pt", weights_only=True)["critic.net.layers.0.weight"].isfinite().all()

    assert run_command(words) == 3
    assert capsys.readouterr().out.count("overwrite=true") == 3
    assert run_command([*words, "overwrite=true"]) == 0
    assert (folder / "result.json").is_file() and (folder.with_name("seed=5.old-1") / "failed.json").is_file()
    (folder / "failed.json").write_text("{}")
    assert read_results(tmp_path)[1] == [f"{folder / 'failed.json'}: no step or no quantity"]


@pytest.mark.parametrize("call, recorded", [(300, []), (450, ["seed=5"])])
def test_after_a_failure_the_others_resume_exactly(tmp_path, monkeypatch, call, recorded):
    """Interrupts the run while the best parameters of the failed seed are evaluated, and after that."""
    words = f"algo=DPre env=R+N {WORDS}"
    train(tmp_path / "sound", words)
    for name, check in (("unbroken", lambda: None), ("spoiled", Breaks(call))):
        with monkeypatch.context() as patch:
            poison(patch, "DPre", spoil("critic", math.nan))
            with pytest.raises(Interrupted) if name == "spoiled" else nullcontext():
                train(tmp_path / name, words, check)
    assert list(failures(tmp_path / "spoiled")) == recorded
    assert train_through(tmp_path / "spoiled", words, Breaks(10, 60)) == 2
    sound = outcome(tmp_path / "sound")
    records = [failures(tmp_path / name)["seed=5"] for name in ("unbroken", "spoiled")]
    assert records[0].pop("seconds") and records[1].pop("seconds") and records[0] == records[1]
    assert_identical({seed: sound[seed] for seed in ("seed=3", "seed=8")}, outcome_of_finished(tmp_path / "spoiled"))


def test_the_best_parameters_of_a_failed_seed_get_their_final_evaluation(tmp_path, monkeypatch):
    words = f"algo=DPre env=R+N {WORDS}".replace("final_episodes=1", "final_episodes=3")
    train(tmp_path / "sound", words.replace("steps=120", "steps=60"))
    poison(monkeypatch, "DPre", spoil("critic", math.nan))
    assert run_command([*words.split(), f"results={tmp_path / 'spoiled'}"]) == 3
    (failure,) = failures(tmp_path / "spoiled").values()
    # Training to step 60 gives the same best parameters, which play the same final episodes.
    expected = outcome(tmp_path / "sound")["seed=5"]["result"]
    assert failure["result"] == {key: expected[key] for key in ("return_mean", "returns", "best_step")}
    assert len(failure["result"]["returns"]) == 3 and failure["executed_actions"] == 86 + 150 + 3 * 150


def test_all_seeds_may_fail(tmp_path, monkeypatch):
    def how(agent):
        for i in range(3):
            spoil("critic", math.nan, i)(agent)

    poison(monkeypatch, "DPre", how)
    assert run_command([*f"algo=DPre env=R+N {WORDS}".split(), f"results={tmp_path}"]) == 3
    assert len(failures(tmp_path)) == 3 and not list(tmp_path.rglob("checkpoint"))


@pytest.mark.parametrize("every", [10_000, 60], ids=["", "and a checkpoint comes first"])
def test_a_parameter_that_no_loss_shows_is_found_before_it_is_evaluated(tmp_path, monkeypatch, every):
    def how(agent):  # a ReLU hides minus infinity
        agent.actor.layers[0].bias.data[BAD, 0, 0] = -math.inf

    poison(monkeypatch, "DPre", how, at=79)
    words = f"algo=DPre env=R+N checkpoint_every={every} {WORDS}"
    assert run_command([*words.split(), f"results={tmp_path}"]) == 3
    ((name, failure),) = failures(tmp_path).items()
    assert name == "seed=5" and failure["quantity"] == "parameter actor.layers.0.bias is not finite"
    assert failure["step"] == 120 and failure["last_evaluation"]["step"] == 60
    (folder,) = tmp_path.glob("*/*/seed=5")
    assert read_run(folder).evaluations.step.tolist() == [60] and failure["result"]["best_step"] == 60


def test_a_seed_that_ends_while_another_ones_end_is_recorded_gets_its_final_evaluation(tmp_path, monkeypatch):
    def how(agent):
        spoil("critic", math.nan, 0)(agent)
        agent.actor.layers[0].bias.data[BAD, 0, 0] = -math.inf

    poison(monkeypatch, "DPre", how)
    assert run_command([*f"algo=DPre env=R+N {WORDS}".split(), f"results={tmp_path}"]) == 3
    found = failures(tmp_path)
    assert {name: failure["quantity"] for name, failure in found.items()} == {
        "seed=3": "critic loss is not finite",
        "seed=5": "parameter actor.layers.0.bias is not finite",
    }
    assert all(failure["result"]["best_step"] == 60 for failure in found.values())


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("algo", ["DRad", "DPre", "DPro"])
def test_a_suggested_action_that_is_not_finite(tmp_path, monkeypatch, algo, value):
    """Also an infinite one, even if a clamp would make it finite."""
    explore = ALGORITHMS[algo].agent.explore

    def spoiled(self, obs, which):
        suggested = explore(self, obs, which)
        if self.updates == MOMENT:
            suggested[BAD] = value
        return suggested

    monkeypatch.setattr(ALGORITHMS[algo].agent, "explore", spoiled)
    assert run_command([*f"algo={algo} env=R+L2 {WORDS}".split(), f"results={tmp_path}"]) == 3
    ((name, failure),) = failures(tmp_path).items()
    assert name == "seed=5" and failure["quantity"] == f"suggested action [{value}, {value}] is not finite"


def test_a_seed_that_fails_at_its_first_step(tmp_path, monkeypatch):
    warm_up = ALGORITHMS["DPre"].agent.warm_up

    def spoiled(self, which):
        suggested = warm_up(self, which)
        suggested[BAD] = math.inf
        return suggested

    words = f"algo=DPre env=R+N {WORDS}"
    train(tmp_path / "sound", words)
    monkeypatch.setattr(ALGORITHMS["DPre"].agent, "warm_up", spoiled)
    assert run_command([*words.split(), f"results={tmp_path / 'spoiled'}"]) == 3
    ((name, failure),) = failures(tmp_path / "spoiled").items()
    assert name == "seed=5" and (failure["step"], failure["executed_actions"]) == (0, 0)
    assert failure["quantity"] == "suggested action [inf, inf] is not finite"
    assert failure["last_evaluation"] is None and failure["largest_violation"] is None
    assert json.loads(json.dumps(failure)) == failure
    sound = outcome(tmp_path / "sound")
    assert_identical({seed: sound[seed] for seed in ("seed=3", "seed=8")}, outcome_of_finished(tmp_path / "spoiled"))


def test_a_map_that_gives_an_infeasible_action_ends_the_seed_and_says_by_how_much(tmp_path, monkeypatch):
    feasible = ALGORITHMS["DPro"].agent.feasible

    def spoiled(self, obs, suggested, center):
        executed = feasible(self, obs, suggested, center)
        if self.updates == MOMENT and suggested.dim() == 2:
            executed[BAD] = 0.5
        return executed

    monkeypatch.setattr(ALGORITHMS["DPro"].agent, "feasible", spoiled)
    assert run_command([*f"algo=DPro env=R+L2 {WORDS}".split(), f"results={tmp_path}"]) == 3
    ((name, failure),) = failures(tmp_path).items()
    assert name == "seed=5" and "violates the constraint by 0.48" in failure["quantity"]


def test_an_evaluation_with_a_refused_action(tmp_path, monkeypatch):
    agent_class = ALGORITHMS["DRad"].agent
    policy = agent_class.policy

    def spoiled(self, which):
        act = policy(self, which)

        def acts(obs):
            action = act(obs)
            if self.updates > MOMENT and BAD in which:
                action[list(which).index(BAD)] = math.nan
            return action

        return acts

    words = f"algo=DRad env=R+L2 {WORDS}"
    train(tmp_path / "sound", words)
    monkeypatch.setattr(agent_class, "policy", spoiled)
    assert run_command([*words.split(), f"results={tmp_path / 'spoiled'}"]) == 3
    ((name, failure),) = failures(tmp_path / "spoiled").items()
    assert name == "seed=5" and failure["quantity"].startswith(
        "evaluation: R+L2, step 1 of the episode: action [nan nan]"
    )
    sound = outcome(tmp_path / "sound")
    assert_identical({seed: sound[seed] for seed in ("seed=3", "seed=8")}, outcome_of_finished(tmp_path / "spoiled"))


@pytest.mark.parametrize("what", ["observation", "reward"])
def test_an_environment_that_breaks_down(tmp_path, monkeypatch, what):
    record = ActionConstrainedEnv._record

    def spoiled(self, action, step):
        obs, reward, *rest = record(self, action, step)
        # Only seed 5 is at this place at its 30th step.
        if self.executed_actions == 30 and np.isclose(obs[0], target[0]):
            obs, reward = (obs * math.nan, reward) if what == "observation" else (obs, math.inf)
        return obs, reward, *rest

    words = f"algo=DPre env=R+N {WORDS}"
    target = envs.make("R+N").reset(seed=stream_seed(5, "environment"))[0]
    monkeypatch.setattr(ActionConstrainedEnv, "_record", spoiled)
    assert run_command([*words.split(), f"results={tmp_path}"]) == 3
    ((name, failure),) = failures(tmp_path).items()
    assert name == "seed=5" and failure["quantity"] == "observation or reward is not finite" and failure["step"] == 29
    assert failure["last_evaluation"] is None
