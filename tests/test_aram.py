"""ARAM: acting by rejection, and its gradient step against the formulas, written out sample by sample."""

from dataclasses import replace

import pytest
import torch
from helpers import run_command

from algos import ALGORITHMS
from algos.aram import preferences
from constraints import Ball, Box, LinearConstraint
from core.random import Streams
from core.replay import Batch

SEEDS, OBS, DIM, BATCH = [3, 8], 3, 2, 10
BALL = Ball(0.3, DIM)


def make_agent(constraint=BALL, seeds=SEEDS, **settings):
    algorithm = ALGORITHMS["ARAM"]
    paper = algorithm.paper_config("ARAM", "R+L2", "Others", steps=1)
    settings = {"gamma": 0.9, "hidden": [8, 8], "tau": 0.1, "rejected_kept": 20, "snapshots_after": 0} | settings
    agent = algorithm.build(replace(paper, **settings), constraint, OBS, list(seeds))
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in [p for module in agent.networks().values() for p in module.parameters()]:
            parameter.add_(0.4 * torch.randn(parameter.shape, generator=generator))
    agent.start_episode(range(len(seeds)))
    return agent


def make_batch():
    generator = torch.Generator().manual_seed(0)
    obs, next_obs = (torch.randn(len(SEEDS), BATCH, OBS, generator=generator) for _ in range(2))
    action = torch.rand(len(SEEDS), BATCH, DIM, generator=generator) * 2 - 1
    reward = torch.randn(len(SEEDS), BATCH, generator=generator)
    terminated = (torch.arange(BATCH) % 3 == 0).float().expand(len(SEEDS), -1)
    return Batch(obs, action, reward, terminated, next_obs)


# ---------------------------------------------------------------- acting


@pytest.mark.parametrize("warming_up", [True, False])
def test_the_first_feasible_draw_is_executed_and_those_before_are_kept(warming_up):
    agent, twin = make_agent(), make_agent()
    who = ([0, 1], []) if warming_up else ([], [0, 1])
    kept = [[], []]
    for step in range(15):
        obs = torch.randn(len(SEEDS), OBS, generator=torch.Generator().manual_seed(step))
        found = agent.act(obs, None, *who)
        draws = twin.exploration.uniform(100, DIM) if warming_up else twin.draw(obs, [0, 1])
        for i in range(len(SEEDS)):
            for draw in draws[i]:
                if BALL.violation(obs[i], draw) <= 0:
                    break
                kept[i].append(torch.cat([obs[i], draw]))
            # If all draws are infeasible, the last one is stored and its projection executed.
            assert torch.equal(found.stored[i], draw)
            torch.testing.assert_close(found.executed[i], BALL.project(obs[i], draw))
    for i, rows in enumerate(kept):
        assert len(rows) > 20 and agent.rejected[i] == len(rows)  # the ring buffer has wrapped
        for number in range(len(rows) - 20, len(rows)):
            assert torch.equal(agent.rejections[i, number % 20], rows[number])


def test_after_the_last_rejection_the_draw_is_projected_and_stored_as_it_is():
    tiny = Ball(1e-8, DIM)
    agent = make_agent(tiny, most_rejections=7)
    obs = torch.randn(len(SEEDS), OBS)
    found = agent.act(obs, None, [], [0, 1])
    assert (tiny.violation(obs, found.executed) <= 1e-6).all() and (tiny.violation(obs, found.stored) > 1e-3).all()
    assert torch.equal(found.executed, tiny.project(obs, found.stored))
    assert agent.rejected[:, 0].tolist() == [7, 7] and torch.equal(agent.rejections[:, 6, OBS:], found.stored)
    for _ in range(3_000):
        agent.act(obs, None, [], [0])
    measures = agent.statistics()
    assert measures["fallbacks"][0] > 0.99 and measures["rejected_draws"][0] == pytest.approx(7, abs=0.01)
    assert measures["acceptance_rate"][0] < 0.01
    assert agent.steps[:, 0].tolist() == agent.measured.tolist() == [3001, 1]
    assert agent.rejected[:, 0].tolist() == [7 * 3001, 7]


def test_each_step_counts_alike_in_the_acceptance_rate():
    """At every second step, one draw in a hundred is feasible on average; at the other steps all draws are."""
    constraint = LinearConstraint(
        DIM, lambda obs: torch.eye(DIM).expand(*obs.shape[:-1], DIM, DIM), lambda obs: 2.0 * obs[..., :DIM] - 0.8
    )
    agent = make_agent(constraint)
    for step in range(1_000):
        agent.act(torch.full((2, OBS), float(step % 2)), None, [0, 1], [])
    measures = agent.statistics()
    expected = torch.full((2,), (1.0 + 0.1**2) / 2)  # a uniform number is below -0.8 with probability 0.1
    torch.testing.assert_close(measures["acceptance_rate"], expected, rtol=0, atol=2e-3)
    assert (measures["rejected_draws"] > 25).all() and (measures["fallbacks"] > 0.1).all()


def test_a_seed_acts_alone_as_among_others():
    both, alone = make_agent(), make_agent(seeds=[8])
    for name, module in alone.networks().items():
        for one, two in zip(module.parameters(), both.networks()[name].parameters(), strict=True):
            one.data.copy_(two.data.view(-1, 2, *two.shape[1:])[:, 1])
    obs = torch.randn(2, OBS)
    for _ in range(5):
        together, single = both.act(obs, None, [0], [1]), alone.act(obs[1:], None, [], [0])
        torch.testing.assert_close(together.executed[1:], single.executed)
    assert alone.rejected[0] == both.rejected[1]


def test_an_unconstrained_task_rejects_nothing():
    agent = make_agent(Box(DIM))
    found = agent.act(torch.randn(2, OBS), None, [0], [1])
    assert torch.equal(found.executed, found.suggested) and not agent.rejected.any()


def test_evaluations_project_the_mean_of_their_preference():
    agent, obs = make_agent(eval_preference=0.7), torch.randn(1, 6, OBS)
    condition = torch.tensor([0.7, 0.3]).expand(2, 6, 2)
    mean, _ = agent.actor(torch.cat([obs.expand(2, -1, -1), condition], -1))
    torch.testing.assert_close(agent.policy([1])(obs), BALL.project(obs, mean[1:].tanh()).detach())


# ---------------------------------------------------------------- the gradient step


def mlp(net, row, x):
    for number, layer in enumerate(net.layers):
        x = x @ layer.weight[row] + layer.bias[row][0]
        x = x.relu() if number + 1 < len(net.layers) else x
    return x


def policy_sample(agent, i, obs, preference, noise):
    """The action (d,) and its log-density, by the change of variables of the tanh."""
    mean, log_std = mlp(agent.actor.net, i, torch.cat([obs, preference])).chunk(2)
    std = log_std.clamp(-20, 2).exp()
    raw = mean + std * noise
    slope = 1 - raw.double().tanh() ** 2
    log_prob = torch.distributions.Normal(mean, std).log_prob(raw).sum() - slope.log().sum()
    return raw.tanh(), log_prob.float()


def critic_value(net, row, obs, action, preference):
    return mlp(net, row, torch.cat([obs, action, preference]))


def test_a_gradient_step_follows_the_formulas():
    agent, batch = make_agent(), make_batch()
    agent.missing[:, 1:3] = 0.0  # two of the four earlier critics exist
    streams = Streams(SEEDS, "update")
    streams.uniform(2)
    noise, drawn = streams.normal(2, BATCH, DIM), preferences(streams.uniform(4, 1))
    assert ((drawn >= 0) & (drawn <= 1)).all() and torch.allclose(drawn.sum(-1), torch.ones(()))
    critic_losses, actor_losses = torch.zeros(2, 2), torch.zeros(2)
    alpha = agent.temperature.log_alpha.detach().exp().flatten()
    for i in range(len(SEEDS)):
        preference = drawn[i, 0]
        for k in range(BATCH):
            obs, action, next_obs = batch.obs[i, k], batch.action[i, k], batch.next_obs[i, k]
            next_action, next_log_prob = policy_sample(agent, i, next_obs, preference, noise[i, 1, k])
            twins = [
                critic_value(agent.critic_target.net, i + 2 * j, next_obs, next_action, preference) for j in (0, 1)
            ]
            following = min(twins, key=lambda q: float((preference @ q).detach())) - alpha[i] * next_log_prob
            penalty = -0.2 if BALL.violation(obs, action) > 0 else 0.0
            target = torch.stack([batch.reward[i, k], torch.tensor(penalty)])
            target = (target + 0.9 * (1 - batch.terminated[i, k]) * following).detach()
            for j in (0, 1):
                q = critic_value(agent.critic.net, i + 2 * j, obs, action, preference)
                critic_losses[j, i] += 0.5 * (preference * (q - target) ** 2).sum().detach() / BATCH
            suggested, log_prob = policy_sample(agent, i, obs, preference, noise[i, 0, k])
            values = []
            for net, rows in [(agent.critic.net, (i, i + 2))] + [
                (agent.earlier.net, (4 * slot + i, 4 * slot + 2 + i)) for slot in (1, 2)
            ]:
                for other in drawn[i]:
                    values.append(
                        min(preference @ critic_value(net, row, obs, suggested, other) for row in rows).detach()
                    )
            actor_losses[i] += (alpha[i] * log_prob.detach() - max(values)) / BATCH
    before = [p.detach().clone() for p in agent.critic.parameters()]

    # The actor's loss is computed after the critic's step. A learning rate of zero leaves the critic unchanged.
    agent.critic_optimizer.param_groups[0]["lr"] = 0.0
    agent.update(batch)
    torch.testing.assert_close(agent.losses["critic"], critic_losses)
    torch.testing.assert_close(agent.losses["actor"], actor_losses)
    assert all(torch.equal(p, q) for p, q in zip(before, agent.critic.parameters(), strict=True))


def test_rejected_actions_stand_in_the_last_places_of_a_batch():
    agent, batch = make_agent(rejected_share=0.4, rejected_share_decay=0.5, rejected_share_every=500), make_batch()
    assert torch.equal(agent.with_rejections(batch).obs, batch.obs)  # no rejections yet
    obs = torch.tensor([5.0, 6.0]).unsqueeze(-1).expand(2, OBS)
    agent.remember([0, 1], obs, torch.full((2, 100, DIM), 0.9), torch.tensor([3, 6]), torch.zeros(2))
    assert agent.rejected[:, 0].tolist() == [3, 6]
    for steps, places in (0, (3, 4)), (499, (3, 4)), (500, (2, 2)), (1_000, (1, 1)):  # there are only three, not four
        agent.steps.fill_(steps)
        mixed = agent.with_rejections(batch)
        for i, count in enumerate(places):
            first = BATCH - count
            assert (mixed.obs[i, first:] == 5.0 + i).all() and (mixed.next_obs[i, first:] == 5.0 + i).all()
            assert (mixed.action[i, first:] == 0.9).all()
            assert not mixed.reward[i, first:].any() and not mixed.terminated[i, first:].any()
            for column in ("obs", "action", "reward", "terminated", "next_obs"):
                assert torch.equal(getattr(mixed, column)[i, :first], getattr(batch, column)[i, :first])


def test_a_cleared_seed_forgets_its_rejected_actions_and_computes_no_nan():
    agent, twin = make_agent(rejected_share=0.4), make_agent(rejected_share=0.4)
    for one, action in (agent, 0.9), (twin, float("nan")):
        candidates = torch.full((2, 100, DIM), 0.9)
        candidates[0] = action
        one.remember([0, 1], torch.ones(2, OBS), candidates, torch.tensor([30, 30]), torch.zeros(2))
        one.clear(0)
        one.update(make_batch())
    assert agent.rejected[:, 0].tolist() == [0, 30] and not twin.diverged()
    for name, losses in agent.losses.items():
        assert torch.equal(losses, twin.losses[name])
    assert torch.equal(agent.with_rejections(make_batch()).action[0], make_batch().action[0])


def test_every_kept_rejection_can_be_drawn_and_no_other_row():
    agent, batch = make_agent(rejected_share=1.0), make_batch()
    candidates = torch.arange(1.0, 8.0).view(1, 7, 1).expand(2, 7, DIM)
    agent.remember([0, 1], torch.ones(2, OBS), candidates, torch.tensor([7, 0]), torch.zeros(2))
    agent.update_noise.uniform = lambda count: torch.linspace(-1.0, 1.0, count).expand(2, count)  # both ends
    seen = agent.with_rejections(batch).action[0, BATCH - 7 :, 0].tolist()
    assert {1.0, 7.0} <= {*seen, 1.0} and max(seen) == 7.0 and min(seen) > 0.0
    assert torch.equal(agent.with_rejections(batch).action[1], batch.action[1])


def test_the_reward_shift_is_for_steps_of_the_environment_alone():
    shifted, plain = (make_agent(reward_shift=shift) for shift in (0.5, 0.0))
    batch = make_batch()
    for agent in (shifted, plain):
        agent.remember([0, 1], torch.ones(2, OBS), torch.full((2, 100, DIM), 0.9), torch.tensor([5, 5]), torch.zeros(2))
    shifted.update(batch)
    plain.update(batch._replace(reward=batch.reward + 0.5))
    assert torch.equal(shifted.losses["critic"], plain.losses["critic"])
    reacher, others = (ALGORITHMS["ARAM"].paper_config("ARAM", "R+L2", group, 1) for group in ("Reacher", "Others"))
    assert (reacher.reward_shift, others.reward_shift) == (0.2, 0.0)


def test_a_fixed_temperature_stays():
    agent, learned = make_agent(learn_temperature=False, temperature=0.3), make_agent(temperature=0.3)
    before = [module.temperature.log_alpha.exp().clone() for module in (agent, learned)]
    for one in (agent, learned):
        one.update(make_batch())
    assert torch.equal(agent.temperature.log_alpha.exp(), before[0]) and list(agent.optimizers()) == ["actor", "critic"]
    assert not torch.equal(learned.temperature.log_alpha.exp(), before[1])


def test_copies_of_the_critic_take_turns():
    agent = make_agent(snapshots=2, snapshot_every=10, snapshots_after=20)
    slots = {0: [], 29: [], 30: [30.0], 35: [30.0], 45: [30.0, 45.0], 57: [57.0, 45.0], 99: [57.0, 99.0]}
    for updates, held in slots.items():
        agent.updates = updates
        with torch.no_grad():
            for parameter in agent.critic.parameters():
                parameter.fill_(float(updates))
        agent.start_rollout([1])
        assert torch.isinf(agent.missing[0]).all() and agent.missing[1].isinf().tolist() == [False] * len(held) + [
            True
        ] * (2 - len(held))
        for parameter in agent.earlier.parameters():
            copies = parameter.view(2, 2, 2, -1)  # slot, twin, seed
            assert all((copies[slot, :, 1] == value).all() for slot, value in enumerate(held))


def test_a_step_without_the_losing_choices_has_the_gradient_of_one_with_all():
    """The best critic and preference of each state are chosen without gradients."""
    agent, batch = make_agent(), make_batch()
    agent.missing[:, 2:] = 0.0
    drawn = preferences(torch.rand(2, 4, 1) * 2 - 1)
    action = batch.action.clone().requires_grad_()
    value = agent.best_value(batch.obs, action, drawn[:, :1], drawn)
    everything = []
    for k in range(4):
        worths = agent.worths(batch.obs, action, drawn[:, k : k + 1], drawn[:, :1])
        everything += [worths[0], worths[3], worths[4]]
    expected = torch.stack(everything).amax(0)
    assert torch.equal(value, expected)
    one, other = (torch.autograd.grad(v.sum(), action, retain_graph=True)[0] for v in (value, expected))
    torch.testing.assert_close(one, other)
    choices = torch.stack(everything).argmax(0)
    assert len(choices.unique()) > 2  # the best choice differs between states


@pytest.mark.parametrize(
    "word, said",
    [
        ("rejected_share=1.5", "bad value 1.5 for rejected_share: must be in [0, 1]"),
        ("eval_preference=-0.1", "bad value -0.1 for eval_preference: must be in [0, 1]"),
        ("most_rejections=0", "bad value 0 for most_rejections: must be at least 1"),
        ("temperature=0", "bad value 0.0 for temperature: must be positive"),
        ("reward_shift=inf", "bad value inf for reward_shift: must be finite"),
        ("gsde=true", "gsde does not apply to ARAM on R+L2"),
        ("penalty=1", "penalty does not apply to ARAM on R+L2"),
    ],
)
def test_bad_settings_are_refused_in_one_line(capsys, word, said):
    assert run_command(["algo=ARAM", "env=R+L2", word]) == 2
    assert capsys.readouterr().err == f"run.py: {said}\n"
