"""The flow of DFlow and SFlow: a bijection with an exact density, its training, and the map made from it."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch

import envs
from algos import ALGORITHMS, Algorithm
from algos.sac import SAC
from algos.td3 import TD3
from constraints import Ball, Box, Intersection, LinearConstraint, WeightedL1, WeightedPositivePart, check_inputs
from core import flow_training
from core.config import setting
from core.flow import COUPLINGS, ConditionalFlow, Flow
from core.flow_training import DivergedError, FlowTraining
from core.maps import Project, Sample

CONSTRAINT = WeightedPositivePart(lambda obs: 2.0 * obs[..., :2] + 3.0, 0.8, 2)


def random_flow(dim, features=2, seed=0, double=True):
    """A flow with random weights, which distorts the box strongly, and with nontrivial standardisation."""
    flow = ConditionalFlow(dim, features, 8, torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for coupling in flow.couplings:
            for parameter in coupling.layers[-1].parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
    flow.standardize(torch.randn(50, features, generator=generator) * 2 + 1, torch.randn(50, dim, generator=generator))
    return flow.double() if double else flow


def numbers(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


# ---------------------------------------------------------------- the bijection


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_encode_is_the_inverse_of_decode(dim):
    flow, features, x = random_flow(dim), numbers(4, 5, 2), 2 * numbers(4, 5, dim, seed=1)
    action, log_det = flow.decode(features, x)
    assert (action - x).abs().mean() > 0.1
    back, same = flow.encode(features, action)
    torch.testing.assert_close(back, x, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(same, log_det, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_the_log_determinant_is_that_of_the_jacobian(dim):
    flow = random_flow(dim)
    for k in range(5):
        features, x = numbers(2, seed=k), numbers(dim, seed=9 + k)
        jacobian = torch.autograd.functional.jacobian(lambda x, f=features: flow.decode(f, x)[0], x)
        torch.testing.assert_close(flow.decode(features, x)[1], torch.linalg.slogdet(jacobian).logabsdet)


@pytest.mark.parametrize("dim", [1, 2, 6])
def test_gradients_of_both_directions(dim):
    flow, features = random_flow(dim), numbers(3, 2)
    x = numbers(3, dim, seed=4).requires_grad_()
    parameters = list(flow.couplings[COUPLINGS - 1].parameters())
    for direction in (flow.decode, flow.encode):
        assert torch.autograd.gradcheck(lambda x, d=direction: d(features, x), x)
        gradients = torch.autograd.grad(direction(features, x)[0].sum(), parameters)
        assert all(gradient.isfinite().all() for gradient in gradients)


def test_features_broadcast_and_each_sample_has_its_own():
    flow, features, x = random_flow(3), numbers(4, 1, 2), numbers(4, 7, 3)
    action, log_det = flow.decode(features, x)
    assert action.shape == (4, 7, 3) and log_det.shape == (4, 7)
    for i in range(4):
        for j in range(7):
            one, its = flow.decode(features[i, 0], x[i, j])
            torch.testing.assert_close(one, action[i, j])
            torch.testing.assert_close(its, log_det[i, j])
    assert not torch.allclose(flow.decode(features[:1], x[:1])[0], flow.decode(features[1:2], x[:1])[0])


def test_features_are_cut_far_from_what_the_training_has_seen():
    flow, x = random_flow(2), numbers(1, 2)
    far, further = (flow.feature_mean + k * flow.feature_scale for k in (6.0, 1e9))
    assert torch.equal(flow.decode(far, x)[0], flow.decode(further, x)[0])
    near = flow.feature_mean + 4.0 * flow.feature_scale
    assert not torch.allclose(flow.decode(near, x)[0], flow.decode(far, x)[0])


def test_a_flow_without_features_is_the_same_everywhere():
    flow = random_flow(2, features=0)
    x = numbers(5, 2)
    assert torch.equal(flow.decode(numbers(5, 0), x)[0], flow.decode(numbers(0), x)[0])


def test_one_action_without_features_has_one_interval():
    flow = random_flow(1, features=0)
    action, log_det = flow.decode(numbers(3, 0), torch.tensor([[-1.0], [0.0], [1.0]], dtype=torch.float64))
    slope = (action[2] - action[0]) / 2.0  # an affine map
    torch.testing.assert_close(action[1], (action[0] + action[2]) / 2.0)
    torch.testing.assert_close(slope.log().expand(3), log_det)


def test_a_batch_may_be_empty():
    flow = random_flow(2)
    for direction in (flow.decode, flow.encode):
        result, log_det = direction(numbers(0, 2), numbers(0, 2))
        assert result.shape == (0, 2) and log_det.shape == (0,)


# ---------------------------------------------------------------- the map


def flow_map(constraint=CONSTRAINT, seed=0, obs_dim=3):
    map = Flow(flow_width=8, flow_entropy="action")
    map.use_untrained(constraint, torch.zeros(1, obs_dim))
    dim, features = constraint.dim, constraint.features(torch.zeros(1, obs_dim)).shape[-1]
    map.load_state(random_flow(dim, features, seed, double=False).state_dict())
    return map


def test_the_map_projects_what_the_flow_leaves_outside():
    map, obs = flow_map(), numbers(300, 3, dtype=torch.float32)
    suggested = 2 * torch.rand(300, 2, generator=torch.Generator().manual_seed(1)) - 1
    proposed, action = map.propose(CONSTRAINT, obs, suggested), map(CONSTRAINT, obs, suggested, None)
    outside = CONSTRAINT.violation(obs, proposed) > 0
    assert 0.1 < outside.float().mean() < 0.9
    assert CONSTRAINT.violation(obs, action).max() <= 1e-6
    torch.testing.assert_close(action[~outside], proposed[~outside])
    torch.testing.assert_close(action, CONSTRAINT.project(obs, proposed))


def test_the_density_of_decoded_actions_integrates_to_one():
    """The density of the flow before the projection, on a grid over its whole range. The next test is for the map."""
    map, obs = flow_map(), torch.tensor([0.3, -0.2, 0.0])
    flow, features = map._on(torch.device("cpu")).double(), CONSTRAINT.features(obs)
    edge = torch.linspace(-12, 12, 2401, dtype=torch.float64)
    grid = torch.cartesian_prod(edge, edge)
    x, log_det = flow.encode(features, grid)
    inside = x.abs().amax(-1) < 1
    assert inside.sum() > 1000 and not inside.view(2401, 2401)[[0, -1]].any()
    density = torch.where(inside, 0.25 * (-log_det).exp(), 0.0)  # of a uniform suggestion
    assert float(density.sum()) * 0.01**2 == pytest.approx(1.0, abs=5e-3)


def test_the_maps_density_is_the_suggestions_over_the_determinant():
    map, obs = flow_map(), numbers(40, 3, dtype=torch.float32)
    suggested = torch.rand(40, 2, generator=torch.Generator().manual_seed(2)) - 0.5
    zero = torch.zeros(40)
    sample = Sample(suggested, torch.zeros(40, 2), torch.ones(40, 2), zero + 0.7)
    action, log_prob = map.with_log_prob(CONSTRAINT, obs, sample, None)
    torch.testing.assert_close(action, map(CONSTRAINT, obs, suggested, None))
    latent = Flow(flow_width=8)
    latent.load_state(map.state())
    same, of_suggestion = latent.with_log_prob(CONSTRAINT, obs, sample, None)
    assert torch.equal(same, action) and torch.equal(of_suggestion, sample.log_prob)
    for i in range(40):
        jacobian = torch.autograd.functional.jacobian(lambda u, i=i: map.propose(CONSTRAINT, obs[i], u), suggested[i])
        assert float(log_prob[i]) == pytest.approx(0.7 - float(torch.linalg.slogdet(jacobian).logabsdet), abs=1e-4)


def test_gradients_pass_flow_and_projection():
    map, obs = flow_map(), numbers(60, 3, dtype=torch.float32)
    suggested = (torch.rand(60, 2, generator=torch.Generator().manual_seed(3)) * 2 - 1).requires_grad_()
    action = map(CONSTRAINT, obs, suggested, None)
    (gradient,) = torch.autograd.grad(action.sum(), suggested)
    step, direction = 1e-3, numbers(60, 2, dtype=torch.float32)
    ahead, behind = (map(CONSTRAINT, obs, suggested.detach() + k * step * direction, None).sum(-1) for k in (1, -1))
    slope = (ahead - behind) / (2 * step)
    close = (slope - (gradient * direction).sum(-1)).abs() < 2e-2
    assert close.float().mean() > 0.95  # the others have a kink within the step
    with torch.no_grad():
        assert not map(CONSTRAINT, obs, suggested, None).requires_grad
    assert all(not parameter.requires_grad for parameter in map._on(torch.device("cpu")).parameters())


def test_a_map_without_a_flow_says_so():
    with pytest.raises(RuntimeError, match="^this map has no flow yet: train one with sweep.flows"):
        Flow()(CONSTRAINT, torch.zeros(1, 3), torch.zeros(1, 2), None)
    assert Flow().state() == {}


def test_an_agent_has_what_the_map_of_its_row_has_learned():
    learned = flow_map()
    row = Algorithm(TD3, learned, "layer")
    agent = row.build(row.paper_config("DMine", "R+L2", "Others", steps=1), CONSTRAINT, 3, [0])
    state = agent.map.state()
    assert all(torch.equal(state[name], value) for name, value in learned.state().items())
    agent.map.use_untrained(CONSTRAINT, torch.zeros(1, 3))
    assert not all(torch.equal(state[name], value) for name, value in agent.map.state().items())
    assert all(torch.equal(state[name], value) for name, value in learned.state().items())


def test_a_map_with_other_settings_is_made_anew():
    @dataclass
    class Strong(Project):
        strength: float = setting(1.0, "how strong")

        def __post_init__(self):
            self.twice = 2 * self.strength

    row = Strong()
    for config, twice in ((SimpleNamespace(strength=3.0), 6.0), (SimpleNamespace(), 2.0)):
        assert row.configured(config).twice == twice and row.configured(config) is not row
    wider = SimpleNamespace(flow_width=16)
    assert flow_map().configured(wider).state() == {}


def test_agents_do_not_share_the_map_of_the_table():
    algorithm = ALGORITHMS["SFlow"]
    config = algorithm.paper_config("SFlow", "R+L2", "Others", steps=1)
    agents = [algorithm.build(config, CONSTRAINT, 3, [0]) for _ in range(2)]
    agents[0].map.use_untrained(CONSTRAINT, torch.zeros(1, 3))
    assert agents[0].map.state() and not agents[1].map.state() and not algorithm.map.state()
    assert isinstance(agents[0], SAC)
    agents[1].load_state(0, agents[0].state(0))
    assert all(torch.equal(agents[1].map.state()[name], value) for name, value in agents[0].map.state().items())


# ---------------------------------------------------------------- features of a set


def test_features_are_what_the_set_depends_on():
    obs = numbers(5, 17)
    assert envs.constraint("R+N").features(obs).shape == envs.constraint("R+L2").features(obs).shape == (5, 0)
    assert torch.equal(envs.constraint("HC+O").features(obs), obs[:, 11:17])
    assert envs.constraint("R+T").features(obs).shape == (5, 3)
    assert envs.constraint("W+O+S").features(obs).shape == (5, 12)
    ball = Ball(lambda obs: 0.1 + obs[..., 0] ** 2, 5)  # five constant scales, as many as observations
    assert torch.equal(ball.features(obs), 0.1 + obs[:, :1] ** 2) and ball.features(obs[0]).shape == (1,)
    assert Box(3).features(obs[0]).shape == (0,)


def test_features_of_sets_of_ones_own():
    class Rows(LinearConstraint):
        def A(self, obs):
            return torch.diag_embed(obs[..., :2])

        def b(self, obs):
            return 1.0 + obs[..., 2:4].abs()

    obs = numbers(3, 4, 6)
    features = Rows(dim=2).features(obs)
    assert features.shape == (3, 4, 6) and features.dtype == torch.float64
    both = Intersection(Rows(dim=2), WeightedL1(lambda obs: obs[..., 4:], 3.0, 2)).features(obs)
    assert both.shape == (3, 4, 8) and torch.equal(both[..., -2:], obs[..., 4:])


# ---------------------------------------------------------------- its training


@pytest.fixture
def few_states(monkeypatch):
    monkeypatch.setattr(flow_training, "POOL", 5_000)
    monkeypatch.setattr(flow_training, "HELD_OUT", 1_000)


def states(seed=0):
    return torch.rand(4_000, 3, generator=torch.Generator().manual_seed(seed)) - 0.5


@pytest.mark.usefixtures("few_states")
@pytest.mark.parametrize("how", ["mle", "reverse"])
@pytest.mark.parametrize("constraint", [Ball(0.05, 2), CONSTRAINT], ids=["the same everywhere", "of the state"])
def test_a_short_training_takes_nearly_all_of_the_box_into_the_set(how, constraint):
    training = FlowTraining(Flow(how, flow_steps=400, flow_width=32), constraint, states())
    before = training.measure()
    while not training.ended:
        training.advance()
    after = training.measure()
    assert after["accuracy"] > max(0.95, before["accuracy"]) and after["recall"] > 0.75
    assert after["face_accuracy"] > 0.8
    assert after["violation"] < before["violation"]


@pytest.mark.usefixtures("few_states")
def test_measures_are_of_states_that_the_training_has_not_seen():
    held_out = flow_training.HELD_OUT
    first = states()
    other_test, other_training = first.clone(), first.clone()
    other_test[-held_out:] += 7.0
    other_training[:-held_out] += 7.0
    flow = Flow(flow_steps=2, flow_width=8)
    same, seen, unseen = (FlowTraining(flow, CONSTRAINT, obs) for obs in (first, other_test, other_training))
    assert torch.equal(same.obs, seen.obs) and not torch.equal(same.test_obs, seen.test_obs)
    assert torch.equal(same.test_obs, unseen.test_obs) and not torch.equal(same.obs, unseen.obs)
    assert same.test_obs.min() > -3 and seen.test_obs.min() > 3  # held-out states, moved from their own mean


@pytest.mark.usefixtures("few_states")
def test_the_learning_rate_falls_along_a_cosine_and_steps_are_cut():
    training = FlowTraining(Flow("mle", flow_steps=4, flow_width=8, mle_softness=1e-6), CONSTRAINT, states())
    used = []
    while not training.ended:
        training.advance()
        used.append(training.optimizer.param_groups[0]["lr"])
        norm = torch.stack([parameter.grad.norm() for parameter in training.parameters]).norm()
        assert float(norm) == pytest.approx(flow_training.LARGEST_STEP, rel=1e-4)  # this loss is so steep
    assert used == pytest.approx([1e-3, 0.5e-3 * (1 + 0.5**0.5), 0.5e-3, 0.5e-3 * (1 - 0.5**0.5)])


def test_the_origin_has_no_face():
    points = flow_training.on_faces(torch.tensor([[0.0, 0.0], [0.0, -1e-3], [0.2, -0.1]]))
    assert points.tolist() == [[0.0, 0.0], [0.0, -1.0], [1.0, -0.5]]


@pytest.mark.usefixtures("few_states")
def test_samples_of_a_training_are_uniform():
    """A sample is the first feasible try or, if all tries fail, one of `Constraint.sample`."""
    thin = WeightedL1(lambda obs: 0 * obs[..., :2] + torch.tensor([30.0, 1.0]), 0.3, 2)  # |30 a_1| + |a_2| <= 0.3
    training = FlowTraining(Flow("mle"), thin, states())
    assert thin.violation(training.obs, training.actions).max() <= 0
    gauge = thin.gauge(training.obs, training.actions, None)
    assert gauge.square().mean() == pytest.approx(0.5, abs=0.02)  # gauge^2 is uniform in two dimensions
    assert training.actions.mean(0).abs().max() < 0.01


@pytest.mark.usefixtures("few_states")
@pytest.mark.parametrize("how", ["mle", "reverse"])
def test_a_training_resumes_with_the_same_bits(how):
    flow = Flow(how, flow_steps=9, flow_width=8)
    whole, first = (FlowTraining(flow, CONSTRAINT, states()) for _ in range(2))
    for _ in range(4):
        whole.advance(), first.advance()
    second = FlowTraining(flow, CONSTRAINT, states())
    second.load_state(first.state())
    for _ in range(5):
        whole.advance(), second.advance()
    assert whole.ended and second.ended
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name
    assert whole.measure() == second.measure()


@pytest.mark.usefixtures("few_states")
def test_a_training_does_not_use_the_global_generator():
    before = torch.get_rng_state()
    training = FlowTraining(Flow("reverse", flow_steps=2), CONSTRAINT, states())
    training.advance()
    training.measure()
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.usefixtures("few_states")
def test_a_training_that_diverges_says_where():
    training = FlowTraining(Flow(flow_steps=5, flow_width=8), CONSTRAINT, states())
    training.advance()
    with torch.no_grad():
        training.network.couplings[0].layers[0].weight.fill_(torch.nan)
    with pytest.raises(DivergedError, match="^its loss is nan at step 2$"):
        training.advance()


@pytest.mark.usefixtures("few_states")
def test_a_last_step_that_ruins_the_parameters_is_no_end(monkeypatch):
    training = FlowTraining(Flow(flow_steps=1, flow_width=8), CONSTRAINT, states())
    monkeypatch.setattr(training, "learning_rate", lambda: math.inf)
    with pytest.raises(DivergedError, match="^a parameter is not finite at the end$"):
        training.advance()


@pytest.mark.usefixtures("few_states")
def test_states_further_out_are_left_where_the_set_breaks_down_there():
    class Narrow(WeightedL1):
        def _at(self, obs):
            if (obs.abs() > 0.5).any():
                raise flow_training.ConstraintError("no such state")
            return super()._at(obs)

    training = FlowTraining(Flow(), Narrow(lambda obs: obs[..., :2], 0.2, 2), states())
    assert training.obs.abs().max() <= 0.5
    assert FlowTraining(Flow(), CONSTRAINT, states()).obs.abs().max() > 0.8


@pytest.mark.usefixtures("few_states")
def test_states_whose_set_would_be_empty_further_out_stay_where_they_are():
    class Rows(LinearConstraint):
        def A(self, obs):
            return torch.tensor([[1.0, 0.0], [-1.0, 0.0]]).expand(*obs.shape[:-1], 2, 2)

        def b(self, obs):  # 0.3 <= a_1 <= 1 - |o|, which is empty from |o| = 0.7 on
            return torch.stack([1.0 - obs[..., 0].abs(), torch.full_like(obs[..., 0], -0.3)], -1)

    rows = Rows(dim=2, on_empty="least")
    training = FlowTraining(Flow(), rows, states())
    assert rows.least_violation(training.obs).max() == 0.0
    assert training.obs[:, 1].abs().max() > 0.8  # the other states do move further out


@pytest.mark.usefixtures("few_states")
def test_a_closed_form_tells_that_it_breaks_down_there():
    """Its coefficients are checked even after many calls; afterwards the process's own mode of checks is restored."""
    ball = Ball(lambda obs: 0.8 - obs.square().sum(-1), 2)  # positive up to the corners of the cube
    for _ in range(200):
        ball.features(torch.zeros(1, 3))
    training = FlowTraining(Flow(), ball, states())
    assert training.obs.abs().max() <= 0.5 and training.test_obs.abs().max() <= 0.5
    assert not check_inputs(False)
    assert FlowTraining(Flow(), Ball(lambda obs: 0.8 + obs.square().sum(-1), 2), states()).obs.abs().max() > 0.8
