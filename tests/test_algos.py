"""Gradients of all algorithms against the paper's formulas, written out seed by seed."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torch.distributions import Normal

from algos import ALGORITHMS
from algos.sac import StateDependentActor
from constraints import Box, WeightedPositivePart
from core.random import Streams
from core.replay import Batch

SEEDS, OBS, DIM, BATCH = [3, 8], 3, 2, 12
CONSTRAINT = WeightedPositivePart(lambda obs: 2.0 * obs[..., :DIM] + 3.0, 0.8, DIM)  # its centre is not the origin
TD3_NAMES = [name for name, algorithm in ALGORITHMS.items() if algorithm.agent.family == "TD3"]
SAC_NAMES = [name for name, algorithm in ALGORITHMS.items() if algorithm.agent.family == "SAC"]
NAMES = TD3_NAMES + SAC_NAMES  # ARAM has its own test module
CASES = [(name, False) for name in NAMES] + [(name, True) for name in SAC_NAMES]
IDS = [name + (" with gSDE" if gsde else "") for name, gsde in CASES]


def make_agent(name, gsde=False, constraint=CONSTRAINT, seeds=SEEDS, **settings):
    """An agent with small networks whose outputs are large enough for all maps and clips to matter."""
    algorithm = ALGORITHMS[name]
    paper = algorithm.paper_config(name, "W+M", "Reacher" if gsde else "Others", steps=1)
    settings = {"gamma": 0.9, "hidden": [8, 8], "tau": 0.1} | settings
    if name in TD3_NAMES:
        settings = {"target_noise": 1.0, "target_noise_clip": 0.6} | settings
    if algorithm.penalty:
        settings = {"penalty": 1.5} | settings
    if name == "NFW":
        settings = {"fw_learning_rate": 0.3} | settings
    if name == "SFlow":
        settings = {"flow_entropy": "action" if gsde else "latent"} | settings
    agent = algorithm.build(replace(paper, **settings), constraint, OBS, list(seeds))
    agent.map.use_untrained(constraint, torch.zeros(1, OBS))
    state = agent.map.state()
    noise = torch.Generator().manual_seed(6)
    agent.map.load_state(
        {key: value + 0.3 * (torch.rand(value.shape, generator=noise) - 0.5) for key, value in state.items()}
    )
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in [p for module in agent.networks().values() for p in module.parameters()]:
            parameter.add_(0.4 * torch.randn(parameter.shape, generator=generator))
        for critic in (agent.critic, agent.critic_target):
            critic.net.layers[-1].bias[len(seeds) :] -= 1.1  # so that either critic can be the smaller one
    return agent


def make_batch(seed=0):
    """Transitions with ends and time limits, any stored actions, and stored centres that no formula would compute."""
    generator = torch.Generator().manual_seed(seed)
    obs, next_obs = (torch.randn(len(SEEDS), BATCH, OBS, generator=generator) for _ in range(2))
    action = torch.rand(len(SEEDS), BATCH, DIM, generator=generator) * 2 - 1
    reward = torch.randn(len(SEEDS), BATCH, generator=generator)
    terminated = (torch.arange(BATCH) % 3 == 0).float().expand(len(SEEDS), -1)
    # Interior points other than the origin and the Chebyshev centre.
    center, next_center = 0.5 * CONSTRAINT.center(obs), 0.7 * CONSTRAINT.center(next_obs)
    return Batch(obs, action, reward, terminated, next_obs, center, next_center)


# ---------------------------------------------------------------- the formulas, for one seed: obs (batch, n)


MAPS = {"Alpha": "alpha_map", "Rad": "radial_map", "Gauge": "gauge_map", "Flow": "flow"}


def map_of(agent):
    """The name of the constraint's method for the agent's map; "project" for most agents."""
    return MAPS.get(agent.config.algo[1:], "project")


def squashes(agent):
    return map_of(agent) in ("project", "gauge_map", "flow")


def projects(agent):
    """Whether the map pulls random actions back by projection, which needs no centre."""
    return map_of(agent) in ("project", "flow")


def mapped(agent, obs, suggested, center=None):
    if map_of(agent) == "flow":
        return CONSTRAINT.project(obs, decoded(agent, obs, suggested)[0])
    arguments = (obs, suggested) if map_of(agent) == "project" else (obs, suggested, center)
    return getattr(CONSTRAINT, map_of(agent))(*arguments)


def mlp(net, row, x):
    """The output of one row's network, layer by layer."""
    for number, layer in enumerate(net.layers):
        x = (x.relu() if number else x) @ layer.weight[row] + layer.bias[row]
    return x


def q_values(critic, i, obs, action):
    """(2, batch): both critics of the seed in position i."""
    x = torch.cat([obs, action], -1)
    return torch.stack([mlp(critic.net, j * len(SEEDS) + i, x).squeeze(-1) for j in range(2)])


def decoded(agent, obs, suggested):
    """The flow's image of a suggestion, coupling by coupling, and its log-determinant."""
    state = agent.map.state()
    features = 2.0 * obs[..., :DIM] + 3.0
    features = ((features - state["feature_mean"]) / state["feature_scale"]).clamp(-5, 5)
    x, log_det = list(suggested.unbind(-1)), state["action_scale"].log().sum()
    for k in range(6):
        h = torch.cat((x[k % 2].unsqueeze(-1), features), -1)
        for number in range(3):
            name = f"couplings.{k}.layers.{number}"
            h = (torch.where(h > 0, h, 0.01 * h) if number else h) @ state[f"{name}.weight"][0] + state[f"{name}.bias"][
                0
            ]
        x[1 - k % 2] = x[1 - k % 2] * h[..., 0].tanh().exp() + h[..., 1]
        log_det = log_det + h[..., 0].tanh()
    return state["action_mean"] + state["action_scale"] * torch.stack(x, -1), log_det


def deterministic(agent, actor, i, obs, center):
    """A TD3 actor's suggestion and the mapped action."""
    raw = mlp(actor, i, obs)
    suggested = raw.tanh() if squashes(agent) else raw
    return suggested, mapped(agent, obs, suggested, center)


def moments(agent, actor, i, obs):
    """Mean, standard deviation and (gSDE) latent features of a SAC actor's Gaussian."""
    if not agent.config.gsde:
        mean, log_std = mlp(actor.net, i, obs).split(DIM, -1)
        return mean, log_std.clamp(-20, 2).exp(), None
    latent = mlp(actor.features, i, obs).relu()
    variance = (latent[:, :, None] ** 2 * actor.log_std[i].exp() ** 2).sum(1)
    return mlp(actor.mean, i, latent).clamp(-2, 2), (variance + 1e-6).sqrt(), latent


def sampled(agent, actor, i, obs, center, noise):
    """The suggestion, the action that the critic sees, and its log-density."""
    mean, std, latent = moments(agent, actor, i, obs)
    raw = mean + (std * noise if latent is None else latent @ (actor.log_std[i].exp() * noise))
    normal = Normal(mean, std).log_prob(raw).sum(-1)
    after_tanh = normal + 2 * raw.double().cosh().log().sum(-1)
    if map_of(agent) == "project":
        return raw.tanh(), raw.tanh(), after_tanh
    if map_of(agent) == "gauge_map":
        u = raw.tanh()
        ratio = u.abs().amax(-1) / CONSTRAINT.gauge(obs, u, center)
        return u, CONSTRAINT.gauge_map(obs, u, center), after_tanh - DIM * ratio.log()
    if map_of(agent) == "flow":
        log_det = decoded(agent, obs, raw.tanh())[1] if agent.config.flow_entropy == "action" else 0.0
        return raw.tanh(), mapped(agent, obs, raw.tanh()), after_tanh - log_det
    if map_of(agent) == "alpha_map":
        return (
            raw,
            CONSTRAINT.alpha_map(obs, raw, center),
            CONSTRAINT.alpha_log_prob(obs, raw, mean, std, center),
        )
    gauge = CONSTRAINT.gauge(obs, raw.double() - center, center)
    log_det = (DIM - 1) * torch.log(gauge.tanh() / gauge) - 2 * gauge.cosh().log()
    return raw, CONSTRAINT.radial_map(obs, raw, center), normal - log_det


def expected_actor_loss(name, agent, actor, temperature, batch, noise):
    """The loss in the table of the paper's Section "Algorithms": for each seed the mean over its batch."""
    losses = []
    for i in range(len(SEEDS)):
        obs, center = batch.obs[i], batch.center[i]
        if name in SAC_NAMES:
            suggested, action, log_prob = sampled(agent, actor, i, obs, center, noise[i])
            loss = temperature[i] * log_prob - q_values(agent.critic, i, obs, action).amin(0)
        elif name == "NFW":
            suggested, projected = deterministic(agent, actor, i, obs, center)
            projected = projected.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(q_values(agent.critic, i, obs, projected)[0].sum(), projected)
            vertex = CONSTRAINT.linear_oracle(obs, gradient)
            reference = CONSTRAINT.project(obs, suggested + 0.3 * (vertex - projected)).detach()
            loss = ((suggested - reference) ** 2).sum(-1)
        else:
            suggested, executed = deterministic(agent, actor, i, obs, center)
            seen = executed if name in ("DOpt", "DOpt+", "DAlpha", "DRad", "DGauge", "DFlow") else suggested
            loss = -q_values(agent.critic, i, obs, seen)[0]
        if name.endswith("+"):
            loss = loss + 1.5 * CONSTRAINT.penalty(obs, suggested)
        losses.append(loss.mean())
    return torch.stack(losses).sum()


@torch.no_grad()
def expected_targets(name, agent, before, temperature, batch, noise):
    """r + gamma (1 - terminated) V(s') (seeds, batch), from the networks `before` the step."""
    rows = []
    for i in range(len(SEEDS)):
        obs, center = batch.next_obs[i], batch.next_center[i]
        if name in SAC_NAMES:
            _, action, log_prob = sampled(agent, before["actor"], i, obs, center, noise[i])
            value = -temperature[i] * log_prob
        else:
            suggested, executed = deterministic(agent, before["actor_target"], i, obs, center)
            action = (suggested if name in ("DPre", "DPre+") else executed) + noise[i].clamp(-0.6, 0.6)
            pull_back = (
                CONSTRAINT.project(obs, action) if projects(agent) else CONSTRAINT.alpha_map(obs, action, center)
            )
            action = pull_back if name in ("DAlpha", "DRad", "DGauge", "DFlow") else action.clamp(-1, 1)
            value = 0.0
        value = value + q_values(before["critic_target"], i, obs, action).amin(0)
        rows.append(batch.reward[i] + 0.9 * (1 - batch.terminated[i]) * value)
    return torch.stack(rows)


def draw_noise(agent, stream):
    """The noise at s and at s' of one update, from a copy of the agent's own stream."""
    if not agent.config.gsde:
        both = stream.normal(2, BATCH, DIM)
        return both[:, 0], both[:, 1]
    theta = stream.normal(8, DIM)
    return theta, theta


def gradients(module):
    return {name: parameter.grad for name, parameter in module.named_parameters()}


def assert_gradients(module, loss, at):
    """Assert that the gradients in `module` are those of `loss` with respect to the parameters of its copy `at`."""
    expected = torch.autograd.grad(loss, list(at.parameters()))
    assert sum(float(g.abs().sum()) for g in expected) > 1e-3
    for (name, found), wanted in zip(gradients(module).items(), expected, strict=True):
        torch.testing.assert_close(
            found, wanted.to(found.dtype), rtol=2e-3, atol=2e-5, msg=lambda m, n=name: f"{n}: {m}"
        )


def second_step(name, gsde=False):
    """The agent after its second update, its networks before that update, and the update's batch and noise."""
    agent = make_agent(name, gsde)
    stream = Streams(SEEDS, "update")
    sac = name in SAC_NAMES
    agent.update(make_batch(seed=1))
    draw_noise(agent, stream) if sac else stream.normal(BATCH, DIM)
    before = {key: deepcopy(module) for key, module in agent.networks().items()}
    batch = make_batch(seed=2)
    noise = draw_noise(agent, stream) if sac else (None, stream.normal(BATCH, DIM))
    agent.update(batch)
    return agent, before, batch, noise


def temperatures(before):
    return before["temperature"].log_alpha.detach().exp() if "temperature" in before else None


@pytest.mark.parametrize("name, gsde", CASES, ids=IDS)
def test_the_actors_gradient_is_that_of_its_papers_loss(name, gsde):
    agent, before, batch, (noise, _) = second_step(name, gsde)
    actor = before["actor"].requires_grad_()
    assert_gradients(agent.actor, expected_actor_loss(name, agent, actor, temperatures(before), batch, noise), actor)


@pytest.mark.parametrize("name, gsde", CASES, ids=IDS)
def test_the_critics_gradient_is_that_of_the_target(name, gsde):
    agent, before, batch, (_, noise) = second_step(name, gsde)
    target = expected_targets(name, agent, before, temperatures(before), batch, noise)
    critic, loss = before["critic"].requires_grad_(), 0.0
    for i in range(len(SEEDS)):
        square = (q_values(critic, i, batch.obs[i], batch.action[i]) - target[i]) ** 2
        loss = loss + (0.5 if name in SAC_NAMES else 1.0) * square.mean(-1).sum()
    assert_gradients(agent.critic, loss, critic)


@pytest.mark.parametrize("name, gsde", [case for case in CASES if case[0] in SAC_NAMES], ids=IDS[len(TD3_NAMES) :])
def test_the_temperatures_gradient(name, gsde):
    agent, before, batch, (noise, _) = second_step(name, gsde)
    for i in range(len(SEEDS)):
        log_prob = sampled(agent, before["actor"], i, batch.obs[i], batch.center[i], noise[i])[2].mean()
        wanted = -(log_prob - DIM)  # the target entropy is -d
        torch.testing.assert_close(agent.temperature.log_alpha.grad[i, 0], wanted.float(), rtol=1e-3, atol=1e-4)


def test_the_batch_leaves_no_case_out():
    """Suggestions outside the set, clipped noise, actions outside the box, and either critic as the smaller one."""
    batch = make_batch(seed=2)
    assert (CONSTRAINT.center(batch.obs).abs() > 0.05).any()
    for name in TD3_NAMES:
        agent = make_agent(name)
        suggested = agent.suggest(agent.actor, batch.obs)
        infeasible = CONSTRAINT.violation(batch.obs, suggested) > 0.05
        assert infeasible.any() and not infeasible.all()
        noise = Streams(SEEDS, "update").normal(BATCH, DIM)
        moved = agent.suggest(agent.actor_target, batch.next_obs) + noise.clamp(-0.6, 0.6)
        assert (noise.abs() > 0.6).any() and (moved.abs() > 1).any()
        first, second = agent.critic_target(batch.next_obs, batch.action)
        assert (first < second).any() and (first > second).any()


def test_a_step_on_losses_of_another_shape_or_of_an_unknown_optimiser_is_refused():
    agent, batch = make_agent("DPre"), make_batch()
    q = agent.critic(batch.obs, batch.action)
    for losses, shape in ((q.mean(), "()"), (q, f"(2, 2, {BATCH})"), (q.mean((0, 2))[:1], "(1,)")):
        with pytest.raises(ValueError) as error:
            agent.descend("critic", losses)
        wanted = f"losses of 'critic' have shape {shape}, expected (..., seeds) = (..., 2)"
        assert str(error.value) == wanted and agent.losses == {}
    with pytest.raises(ValueError, match=r"^there is no optimiser 'critics' \(choices: actor, critic\)$"):
        agent.descend("critics", q.mean(-1))


# ---------------------------------------------------------------- targets, delays, soft updates


def constant(net, first, second):
    """Make the twin critics constant."""
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
        net.net.layers[-1].bias[: len(SEEDS)] = first
        net.net.layers[-1].bias[len(SEEDS) :] = second


@pytest.mark.parametrize("first, second", [(3.0, 5.0), (5.0, 3.0)])
@pytest.mark.parametrize("name", ["DPre", "DOpt", "DAlpha", "NFW"])
def test_the_target_of_constant_critics(name, first, second):
    agent = make_agent(name)
    constant(agent.critic_target, first, second)
    batch = make_batch()._replace(reward=torch.full((len(SEEDS), BATCH), 1.0))
    target = agent.bootstrap(batch)
    assert batch.terminated.unique().tolist() == [0, 1]
    torch.testing.assert_close(target, torch.where(batch.terminated == 1, 1.0, 1.0 + 0.9 * 3.0))


@pytest.mark.parametrize("name", TD3_NAMES)
def test_target_actions_are_back_within_bounds(name):
    agent, batch = make_agent(name, target_noise=5.0, target_noise_clip=4.0), make_batch()
    action = agent.target_action(batch)
    if map_of(agent) == "project":
        assert action.abs().max() == 1
    else:
        violation = CONSTRAINT.violation(batch.next_obs, action)
        assert violation.max() <= 1e-6 and (violation > -1e-6).any()


def snapshot(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("name", ["DPre", "DAlpha", "NFW"])
def test_actor_and_targets_move_every_policy_delay_steps(name, delay):
    agent = make_agent(name, policy_delay=delay)
    for number in range(1, 2 * delay + 1):
        before = {key: snapshot(module) for key, module in agent.networks().items()}
        agent.update(make_batch(number))
        for key, module in agent.networks().items():
            moved = any(not torch.equal(a, b) for a, b in zip(before[key], snapshot(module), strict=True))
            assert moved == (key == "critic" or number % delay == 0), (key, number)


@pytest.mark.parametrize("name", ["DPre", "SAlpha"])
def test_targets_follow_with_tau(name):
    agent, before, _, _ = second_step(name)
    for key in (key for key in agent.networks() if key.endswith("_target")):
        source = snapshot(agent.networks()[key.removesuffix("_target")])
        old, new = snapshot(before[key]), snapshot(agent.networks()[key])
        for o, s, n in zip(old, source, new, strict=True):
            torch.testing.assert_close(n, 0.9 * o + 0.1 * s)
    targets = {"TD3": {"actor_target", "critic_target"}, "SAC": {"critic_target"}}[ALGORITHMS[name].agent.family]
    assert {key for key in agent.networks() if key.endswith("_target")} == targets


# ---------------------------------------------------------------- SAC


@pytest.mark.parametrize("name", SAC_NAMES)
def test_the_temperature_rises_for_too_little_entropy_and_falls_for_too_much(name):
    agent = make_agent(name)
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.zero_()
        log_std = agent.actor.net.layers[-1].bias[..., DIM:]
        log_std[0], log_std[1] = -7.0, -1.0  # entropies of the Gaussian before the map: -11 and 1, the target is -2
    before = agent.temperature.log_alpha.detach().clone()
    agent.update(make_batch())
    change = (agent.temperature.log_alpha - before).squeeze(-1)
    assert change[0] > 0 > change[1]


@pytest.mark.parametrize(
    "name, settings, options",
    [
        ("SRad", {"entropy": "ball"}, {"unit_ball": True}),
        ("SRad", {"log_det_floor": 1e-2}, {"floor": 1e-2}),
        ("SAlpha", {"entropy": "ball"}, {"unit_ball": True}),
        ("SAlpha", {"boundary_weight": 3.0}, {"boundary_weight": 3.0}),
    ],
)
def test_choices_of_entropy_change_the_density_and_nothing_else(name, settings, options):
    batch, noise = make_batch(), torch.randn(len(SEEDS), BATCH, DIM, generator=torch.Generator().manual_seed(1))
    plain = make_agent(name).sample(batch.obs, batch.center, noise)
    agent = make_agent(name, **settings)
    action, log_prob, suggested = agent.sample(batch.obs, batch.center, noise)
    assert torch.equal(action, plain[0]) and torch.equal(suggested, plain[2])
    ray = CONSTRAINT.ray(batch.obs, suggested, batch.center)
    mean, std = agent.actor.sample(batch.obs, noise)[1:3]
    if name == "SRad":
        expected = ray.radial_log_prob(Normal(mean, std).log_prob(suggested).sum(-1), **options)
    else:
        expected = ray.alpha_log_prob(mean, std, **options)
    torch.testing.assert_close(log_prob, expected)
    assert not torch.allclose(log_prob, plain[1])


def test_the_temperature_starts_at_one_for_every_seed():
    agent = ALGORITHMS["SPre"].build(make_agent("SPre").config, CONSTRAINT, OBS, SEEDS)
    assert torch.equal(agent.temperature.log_alpha, torch.zeros(len(SEEDS), 1))


def test_the_variance_of_gsde_is_that_of_its_noise():
    generator = torch.Generator().manual_seed(0)
    actor = StateDependentActor(OBS, DIM, [8, 6], [generator])
    with torch.no_grad():
        actor.log_std.copy_(torch.randn(actor.log_std.shape, generator=generator))
        obs = 3 * torch.randn(1, 4, OBS, generator=generator)
        samples, mean, std, log_prob = actor.sample(obs, torch.randn(40_000, 6, DIM, generator=generator))
        latent = mlp(actor.features, 0, obs[0]).relu()
    assert samples.shape == (40_000, 4, DIM)
    torch.testing.assert_close(log_prob, Normal(mean, std).log_prob(samples).sum(-1))
    torch.testing.assert_close(samples.var(0), std[0] ** 2, rtol=0.05, atol=0)
    torch.testing.assert_close((samples - mean).mean(0) / std[0], torch.zeros(4, DIM), rtol=0, atol=0.03)
    variance = (latent[:, :, None] ** 2 * actor.log_std[0].exp() ** 2).sum(1)
    torch.testing.assert_close(std[0] ** 2, variance + 1e-6)
    # With one draw of theta, the noise of two states is correlated, because they share theta.
    noise = (samples - mean)[:, :2, 0] / std[0, :2, 0]
    correlation = (latent[0] * latent[1] * actor.log_std[0, :, 0].exp() ** 2).sum() / (std[0, 0, 0] * std[0, 1, 0])
    torch.testing.assert_close(noise.prod(1).mean(), correlation.detach(), rtol=0, atol=0.03)


def test_gsde_starts_small_and_its_mean_is_clipped():
    actor = StateDependentActor(OBS, DIM, [8, 6], [torch.Generator().manual_seed(0)])
    assert (actor.log_std == -3).all()
    with torch.no_grad():
        actor.mean.layers[-1].bias.copy_(torch.tensor([[9.0, -9.0]]))
        assert actor(torch.randn(1, 5, OBS))[0].tolist() == [[[2.0, -2.0]] * 5]


def test_gsde_keeps_one_theta_for_a_rollout_and_its_seed_alone_changes_it():
    agent, obs = make_agent("SPre", gsde=True), make_batch().obs[:, 0]
    agent.start_rollout([0, 1])
    first = agent.explore(obs, [0, 1])
    assert torch.equal(agent.explore(obs, [0, 1]), first)
    agent.start_rollout([1])
    second = agent.explore(obs, [0, 1])
    assert torch.equal(second[0], first[0]) and not torch.isclose(second[1], first[1]).any()
    theta = Streams(SEEDS, "explore").normal(8, DIM)
    for i in range(len(SEEDS)):
        mean, _, latent = moments(agent, agent.actor, i, obs[i : i + 1])
        wanted = (mean + latent @ (agent.actor.log_std[i].exp() * theta[i])).tanh()
        torch.testing.assert_close(first[i : i + 1], wanted.detach())


@pytest.mark.parametrize("mean, std", [(0.0, 0.5), (0.7, 1.0), (-1.0, 0.3)])
def test_the_density_after_tanh_integrates_to_one(mean, std):
    agent = make_agent("SPre", constraint=Box(1), seeds=[0])
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.zero_()
        agent.actor.net.layers[-1].bias[0, 0] = torch.tensor([mean, std]).clone()
        agent.actor.net.layers[-1].bias[0, 0, 1] = torch.tensor(std).log()
        noise = torch.linspace(-6, 6, 4001).view(1, -1, 1)
        action, log_prob, _ = agent.sample(torch.zeros(1, 4001, OBS), None, noise)
    mass = torch.trapezoid(log_prob[0].double().exp(), action[0, :, 0].double())
    assert abs(mass - 1) < 1e-4
    torch.testing.assert_close(action[0, :, 0], (mean + std * noise[0, :, 0]).tanh())


def test_the_density_after_tanh_is_finite_far_out():
    agent = make_agent("SPre")
    agent.actor.net.layers[-1].bias.data[..., :DIM] = 40.0
    action, log_prob, _ = agent.sample(make_batch().obs, None, torch.zeros(len(SEEDS), BATCH, DIM))
    assert (action == 1).all() and log_prob.isfinite().all() and (log_prob > 50).all()


# ---------------------------------------------------------------- acting


@pytest.mark.parametrize("name, gsde", CASES, ids=IDS)
def test_the_policy_of_evaluation_is_the_mapped_mean(name, gsde):
    agent, obs = make_agent(name, gsde), make_batch().obs
    streams = [stream.get_state() for s in (agent.exploration, agent.update_noise) for stream in s.generators]
    act = agent.policy([1])
    wanted = []
    for i in range(len(SEEDS)):
        raw = mlp(agent.actor, i, obs[i]) if name in TD3_NAMES else moments(agent, agent.actor, i, obs[i])[0]
        wanted.append(mapped(agent, obs[i], raw.tanh() if squashes(agent) else raw).detach())
    torch.testing.assert_close(agent.policy([0, 1])(obs), torch.stack(wanted))
    for _ in range(2):
        torch.testing.assert_close(act(obs[1:]), wanted[1].unsqueeze(0))
    # The policy is a copy, and it draws no random numbers.
    for parameter in agent.actor.parameters():
        parameter.data.add_(1.0)
    torch.testing.assert_close(act(obs[1:]), wanted[1].unsqueeze(0))
    after = [stream.get_state() for s in (agent.exploration, agent.update_noise) for stream in s.generators]
    assert all(torch.equal(a, b) for a, b in zip(streams, after, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_exploration_adds_noise_before_the_map(name):
    agent, obs = make_agent(name, **({"action_noise": 0.7} if name in TD3_NAMES else {})), make_batch().obs[:, 0]
    noise = Streams(SEEDS, "explore")
    for only in ([0, 1], [1], [0, 1]):
        found, drawn = agent.explore(obs, only), noise.normal(DIM, which=only)
        for i in only:
            if name in TD3_NAMES:
                raw = mlp(agent.actor, i, obs[i : i + 1])[0]
                wanted = (raw.tanh() if squashes(agent) else raw) + 0.7 * drawn[i]
            else:
                mean, std, _ = moments(agent, agent.actor, i, obs[i : i + 1])
                wanted = (mean + std * drawn[i])[0]
                wanted = wanted.tanh() if squashes(agent) else wanted
            torch.testing.assert_close(found[i], wanted.detach())


@pytest.mark.parametrize("name", NAMES)
def test_acting_maps_explored_suggestions_and_pulls_random_ones_back(name):
    agent, obs = make_agent(name, **({"action_noise": 2.0} if name in TD3_NAMES else {})), make_batch().obs[:, 0]
    twin = make_agent(name, **({"action_noise": 2.0} if name in TD3_NAMES else {}))
    center = agent.centers(obs)
    assert (center is None) == projects(agent)
    for warming_up, exploring in (([0], [1]), ([1], [0]), ([0, 1], []), ([], [0, 1])):
        found = agent.act(obs, center, warming_up, exploring)
        suggested = torch.zeros(len(SEEDS), DIM)
        if warming_up:
            suggested[warming_up] = twin.warm_up(warming_up)[warming_up]
        if exploring:
            suggested[exploring] = twin.explore(obs, exploring)[exploring]
        in_box = suggested.clamp(-1, 1) if squashes(agent) else suggested
        executed = mapped(agent, obs, in_box, center)
        pulled_back = CONSTRAINT.project if projects(agent) else CONSTRAINT.alpha_map
        executed[warming_up] = pulled_back(obs, suggested)[warming_up]
        torch.testing.assert_close(found.executed, executed)
        assert torch.equal(found.stored, in_box if agent.placement == "environment" else found.executed)
        assert CONSTRAINT.violation(obs, found.executed).max() <= 1e-6
    if name in TD3_NAMES:
        assert (suggested.abs() > 1).any()


@pytest.mark.parametrize("name", NAMES)
def test_executed_and_warm_up_actions_are_feasible(name):
    """The algorithm's map makes the executed action; in warm-up, a map that does not change feasible actions."""
    agent, obs = make_agent(name), make_batch().obs
    suggested = 3 * torch.randn(obs.shape[:-1] + (DIM,), generator=torch.Generator().manual_seed(1))
    suggested = suggested.tanh() if squashes(agent) else suggested
    rounding = 1e-5 if map_of(agent) == "flow" else 0.0  # `decoded` computes in another order
    torch.testing.assert_close(
        agent.feasible(obs, suggested, None), mapped(agent, obs, suggested), rtol=rounding, atol=rounding
    )
    pulled = (CONSTRAINT.project if projects(agent) else CONSTRAINT.alpha_map)(obs, suggested)
    assert torch.equal(agent.map.pull_back(CONSTRAINT, obs, suggested, None), pulled)
    torch.testing.assert_close(agent.map.pull_back(CONSTRAINT, obs, pulled, None), pulled)
    warm = torch.stack([agent.warm_up([0, 1]) for _ in range(200)])
    assert torch.equal(warm[0], Streams(SEEDS, "explore").uniform(DIM))
    assert (warm.amax((0, 1)) > 0.9).all() and (warm.amin((0, 1)) < -0.9).all() and warm.abs().max() <= 1
