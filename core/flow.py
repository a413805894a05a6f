"""The map of DFlow and SFlow: a conditional normalising flow maps the box to the feasible set of each state.

The flow is RealNVP (Dinh et al., 2017) with six affine couplings, as in FlowPG (Brahmanage et al., NeurIPS 2023) and
CV-Flow (the same authors, AAAI 2025). `core.flow_training` trains it before the agent, once for all seeds. A trained
flow is not exact: it takes some points of the box outside the set, and the map projects the result.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

from constraints import Constraint
from core.config import AT_LEAST_ONE, POSITIVE, one_of, setting
from core.maps import Map, Sample
from core.networks import Linear

COUPLINGS = 6
CPU = torch.device("cpu")
_LARGEST_FEATURE = 5.0
"""Features are clamped to this many standard deviations from their mean: the flow is not trained further out."""


class Coupling(nn.Module):
    """The affine map x -> exp(s) x + t of some coordinates; s and t depend on the other coordinates and the features.

    s is in [-1, 1]. A new coupling is the identity.
    """

    def __init__(self, given: int, moved: int, features: int, width: int, generator: torch.Generator):
        super().__init__()
        sizes = [given + features, width, width, 2 * moved]
        self.layers = nn.ModuleList(Linear(n, m, [generator]) for n, m in zip(sizes, sizes[1:], strict=False))
        for parameter in self.layers[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, given: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return s and t (batch, moved) for the other coordinates (batch, given) and the features (batch, k)."""
        x, last = torch.cat((given, features), -1), len(self.layers) - 1
        for number, layer in enumerate(cast("Iterable[Linear]", self.layers)):
            x = torch.addmm(layer.bias[0], x, layer.weight[0])
            if number < last:
                x = leaky_relu(x)
        scale, shift = x.chunk(2, -1)
        return scale.tanh(), shift


class ConditionalFlow(nn.Module):
    """A bijection of R^d for each state: `decode` maps points x (..., d) to actions a (..., d), `encode` maps back.

    The first argument of both is the features (..., k) of the states. Leading dimensions broadcast. Both also return
    log |det da/dx| (...). Results have the dtype of the parameters.
    """

    feature_mean: Tensor
    feature_scale: Tensor
    action_mean: Tensor
    action_scale: Tensor

    def __init__(self, dim: int, features: int, width: int, generator: torch.Generator):
        super().__init__()
        self.middle = dim // 2
        self.shifts = [number // 2 if dim > 2 else 0 for number in range(COUPLINGS)]
        sizes = (self.middle, dim - self.middle)
        self.couplings = nn.ModuleList(
            Coupling(*(sizes if number % 2 == 0 else sizes[::-1]), features, width, generator)
            for number in range(COUPLINGS)
        )
        for name, count in (("feature", features), ("action", dim)):
            self.register_buffer(f"{name}_mean", torch.zeros(count))
            self.register_buffer(f"{name}_scale", torch.ones(count))

    def standardize(self, features: Tensor, actions: Tensor) -> None:
        """Take means and scales from features (n, k) and feasible actions (m, d)."""
        self.feature_mean.copy_(features.mean(0))
        deviation = (features - self.feature_mean).square().mean(0).sqrt()
        self.feature_scale.copy_(torch.where(deviation > 1e-6, deviation, 1.0))
        self.action_mean.copy_(actions.mean(0))
        self.action_scale.copy_(actions.std(0) * 3.0**0.5)  # uniform in the box, they have the deviation 1 / sqrt(3)

    def decode(self, features: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        lead, x, features = self._prepare(features, x)
        log_det = self.action_scale.log().sum()
        for number, coupling in enumerate(self.couplings):
            given, moved = self._split(number, x)
            scale, shift = coupling(given, features)
            x = self._join(number, given, moved * scale.exp() + shift)
            log_det = log_det + scale.sum(-1)
        return (self.action_mean + self.action_scale * x).view(*lead, x.shape[-1]), log_det.view(lead)

    def encode(self, features: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        lead, action, features = self._prepare(features, action)
        x, log_det = (action - self.action_mean) / self.action_scale, self.action_scale.log().sum()
        for number in reversed(range(COUPLINGS)):
            given, moved = self._split(number, x)
            scale, shift = self.couplings[number](given, features)
            x = self._join(number, given, (moved - shift) * (-scale).exp())
            log_det = log_det + scale.sum(-1)
        return x.view(*lead, x.shape[-1]), log_det.view(lead)

    def _prepare(self, features: Tensor, x: Tensor) -> tuple[torch.Size, Tensor, Tensor]:
        """The common leading shape, the points (batch, d) and the standardised features (batch, k)."""
        lead = torch.broadcast_shapes(features.shape[:-1], x.shape[:-1])
        x, features = x.to(self.action_mean.dtype), features.to(self.action_mean.dtype)
        standard = (features - self.feature_mean) / self.feature_scale
        standard = standard.clamp(-_LARGEST_FEATURE, _LARGEST_FEATURE)
        x, standard = (rows.expand(*lead, rows.shape[-1]) for rows in (x, standard))
        return lead, x.reshape(lead.numel(), x.shape[-1]), standard.reshape(lead.numel(), standard.shape[-1])

    def _split(self, number: int, x: Tensor) -> tuple[Tensor, Tensor]:
        """Split x (batch, d) into the coordinates that coupling `number` reads and the coordinates that it moves.

        The two halves alternate. If d > 2, the coordinates are rolled by one more place after every two couplings.
        """
        x = x.roll(-self.shifts[number], -1)
        first, second = x[:, : self.middle], x[:, self.middle :]
        return (first, second) if number % 2 == 0 else (second, first)

    def _join(self, number: int, given: Tensor, moved: Tensor) -> Tensor:
        """Undo `_split`: the coordinates (batch, d) in their original order."""
        return torch.cat((given, moved) if number % 2 == 0 else (moved, given), -1).roll(self.shifts[number], -1)


@dataclass
class Flow(Map):
    """A trained flow, followed by a projection for the results outside the set.

    The suggestion is a point of the box, which the flow decodes. The log-density is the suggestion's or, with
    `flow_entropy=action`, the decoded action's before the projection. `load_state` loads a flow that
    `core.flow_training` has trained. Before that, a call raises RuntimeError.
    """

    flow: str = setting(
        "reverse",
        "DFlow, SFlow: training of the flow, mle (as in FlowPG) or reverse (as in CV-Flow)",
        one_of("mle", "reverse"),
    )
    flow_width: int = setting(64, "DFlow, SFlow: units in a hidden layer of the flow", AT_LEAST_ONE)
    flow_steps: int = setting(3_000, "DFlow, SFlow: gradient steps of the flow's training", AT_LEAST_ONE)
    flow_batch_size: int = setting(256, "DFlow, SFlow: samples per gradient step of the flow's training", AT_LEAST_ONE)
    flow_learning_rate: float = setting(1e-3, "DFlow, SFlow: learning rate of the flow; it falls to 0", POSITIVE)
    mle_softness: float = setting(
        0.02, "DFlow, SFlow: width of the box's soft edges, for flow=mle", POSITIVE, only_with=("flow", "mle")
    )
    reverse_softness: float = setting(
        1e-4, "DFlow, SFlow: width of the set's soft edges, for flow=reverse", POSITIVE, only_with=("flow", "reverse")
    )

    flow_entropy: str = setting(
        "latent",
        "SFlow: entropy of the 'latent' point of the box, as in CV-Flow, or of the 'action'",
        one_of("latent", "action"),
        of_density=True,
    )

    squashes = True
    needs_center = False

    def __post_init__(self) -> None:
        self._networks: dict[torch.device, ConditionalFlow] = {}  # a copy of the flow per device, made on first use

    def __call__(self, constraint: Constraint, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        return constraint.project(obs, self.propose(constraint, obs, suggested))

    def with_log_prob(
        self, constraint: Constraint, obs: Tensor, sample: Sample, center: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        action, log_det = self._decode(constraint, obs, sample.suggested)
        latent = self.flow_entropy == "latent"
        return constraint.project(obs, action), sample.log_prob if latent else sample.log_prob - log_det

    def propose(self, constraint: Constraint, obs: Tensor, suggested: Tensor) -> Tensor:
        return self._decode(constraint, obs, suggested)[0]

    def pull_back(self, constraint: Constraint, obs: Tensor, action: Tensor, center: Tensor | None) -> Tensor:
        return constraint.project(obs, action)

    def new_network(self, dim: int, features: int) -> ConditionalFlow:
        """An untrained flow for actions (..., dim) and `features` features of a state, always with the same weights."""
        return ConditionalFlow(dim, features, self.flow_width, torch.Generator().manual_seed(0))

    def use_untrained(self, constraint: Constraint, obs: Tensor) -> None:
        self._take(self.new_network(constraint.dim, constraint.features(obs).shape[-1]))

    def state(self) -> dict[str, Tensor]:
        networks = [self._networks[CPU]] if self._networks else []
        return {name: value.clone() for network in networks for name, value in network.state_dict().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        if not self._networks:
            self._take(self.new_network(len(state["action_mean"]), len(state["feature_mean"])))
        for network in self._networks.values():
            network.load_state_dict(state)

    def _decode(self, constraint: Constraint, obs: Tensor, suggested: Tensor) -> tuple[Tensor, Tensor]:
        """Decode suggestions (..., d) to actions (..., d). Also return log |det da/dx| (...)."""
        action, log_det = self._on(obs.device).decode(constraint.features(obs), suggested)
        return action.to(suggested.dtype), log_det.to(suggested.dtype)

    def _take(self, network: ConditionalFlow) -> None:
        self._networks = {CPU: network.requires_grad_(False)}

    def _on(self, device: torch.device) -> ConditionalFlow:
        """The flow on `device`. Raises RuntimeError if there is no flow yet."""
        if not self._networks:
            raise RuntimeError("this map has no flow yet: train one with sweep.flows, and load it with load_state")
        if device not in self._networks:
            self._networks[device] = copy.deepcopy(self._networks[CPU]).to(device)
        return self._networks[device]
