"""Feasibility maps: they turn the action that an actor suggests into an action inside the feasible set.

A new map is one class. TD3 needs only `__call__`, SAC also `with_log_prob`. The map's dataclass fields, made with
`core.config.setting`, are keys of the command line for the algorithms that use the map.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Literal, NamedTuple

from torch import Tensor

from constraints import Constraint
from core.config import NOT_NEGATIVE, POSITIVE, Config, one_of, setting

Placement = Literal["environment", "rollout", "layer"]
"""Where a map stands between the actor and the robot: see `core.agent.Agent`."""


class Sample(NamedTuple):
    """Suggestions (..., d) drawn by a stochastic actor.

    `mean` and `std` (..., d) belong to the actor's normal distribution, before any tanh. `log_prob` (...) is the
    log-density of `suggested` itself.
    """

    suggested: Tensor
    mean: Tensor
    std: Tensor
    log_prob: Tensor


@dataclass
class Map(ABC):
    """A map into the feasible set.

    Tensors are obs (..., n), actions and `center` (..., d). `center` is an interior point of the set at `obs`. If it is
    None, the constraint computes one.
    """

    squashes: ClassVar[bool] = False
    """Whether a tanh keeps suggestions in the box [-1, 1]^d before they reach the map."""
    needs_center: ClassVar[bool] = True
    """Whether the map uses a centre. If so, the agent computes it once for each observation and replays it."""
    placements: ClassVar[tuple[Placement, ...]] = ("layer",)
    """The placements that the map supports. "environment" and "rollout" demand more than "layer". Random actions are
    suggestions there, so `pull_back` must equal the map. Critics score both suggestions and feasible actions, so the
    map must not change feasible actions, and suggestions must stay in the box."""

    @abstractmethod
    def __call__(self, constraint: Constraint, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        """The feasible action (..., d), differentiable in `suggested`."""

    def with_log_prob(
        self, constraint: Constraint, obs: Tensor, sample: Sample, center: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The feasible actions (..., d) of a sample's suggestions, and their log-densities (...). SAC needs it."""
        raise NotImplementedError(f"{type(self).__name__} has no log-density")

    def pull_back(self, constraint: Constraint, obs: Tensor, action: Tensor, center: Tensor | None) -> Tensor:
        """Map a random action (..., d) to a feasible one. Feasible actions stay as they are."""
        return constraint.alpha_map(obs, action, center)

    def limit_target(self, constraint: Constraint, obs: Tensor, action: Tensor, center: Tensor | None) -> Tensor:
        """Map TD3's noisy target action (..., d) back to the kind of actions on which the critic is trained."""
        return self.pull_back(constraint, obs, action, center)

    def configured(self, config: Config) -> Map:
        """A copy of the map; fields that `config` has too get its values."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        changed = {name: getattr(config, name) for name in own if getattr(config, name, own[name]) != own[name]}
        # With unchanged settings, the copy keeps what the map has learned. With others, it starts untrained.
        return replace(self, **changed) if changed else copy.deepcopy(self)

    def propose(self, constraint: Constraint, obs: Tensor, suggested: Tensor) -> Tensor:
        """The action (..., d) before it is made feasible: the suggestion itself. training.csv logs its violation."""
        return suggested

    def use_untrained(self, constraint: Constraint, obs: Tensor) -> None:  # noqa: B027 - most maps learn nothing
        """Make a map that learns usable without its own training, for checks and measurements of speed."""

    def state(self) -> dict[str, Tensor]:
        """What the map has learned before the agent's training, on the CPU. Saved parameters include it."""
        return {}

    def load_state(self, state: Mapping[str, Tensor]) -> None:  # noqa: B027 - most maps learn nothing
        """Load what `state` returned."""

    def replays_center(self, constraint: Constraint) -> bool:
        """Whether the replay buffer stores the two centres of each transition. The origin is not stored."""
        return self.needs_center and not constraint.origin_centered

    @classmethod
    def has_log_prob(cls) -> bool:
        """Whether SAC can use the map as a layer."""
        return cls.with_log_prob is not Map.with_log_prob


@dataclass
class Project(Map):
    """Closest-point projection (paper, Section "Algorithms Based on the Closest Point Projection")."""

    squashes = True
    needs_center = False
    placements = ("environment", "rollout", "layer")

    def __call__(self, constraint: Constraint, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        return constraint.project(obs, suggested)

    def pull_back(self, constraint: Constraint, obs: Tensor, action: Tensor, center: Tensor | None) -> Tensor:
        return constraint.project(obs, action)

    def limit_target(self, constraint: Constraint, obs: Tensor, action: Tensor, center: Tensor | None) -> Tensor:
        return action.clamp(-1.0, 1.0)


@dataclass
class RayMap(Map):
    """Base of the maps along rays from the centre, with their common setting of SAC's entropy."""

    entropy: str = setting(
        "paper",
        "SAlpha, SRad, SGauge: entropy of actions as in the 'paper', or in unit-'ball' coordinates",
        one_of("paper", "ball"),
        of_density=True,
    )

    @property
    def unit_ball(self) -> bool:
        return self.entropy == "ball"


@dataclass
class Alpha(RayMap):
    """alpha-projection (paper, Section "Other Mapping Techniques")."""

    boundary_weight: float = setting(
        1.0, "SAlpha: weight of the boundary's measure in the entropy", POSITIVE, of_density=True
    )

    def __call__(self, constraint: Constraint, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        return constraint.alpha_map(obs, suggested, center)

    def with_log_prob(
        self, constraint: Constraint, obs: Tensor, sample: Sample, center: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        ray = constraint.ray(obs, sample.suggested, center)
        return ray.alpha_map(), ray.alpha_log_prob(sample.mean, sample.std, self.unit_ball, self.boundary_weight)


@dataclass
class Radial(RayMap):
    """Radial squashing (paper, Section "Other Mapping Techniques")."""

    log_det_floor: float = setting(
        0.0,
        "SRad: constant added to the determinant in the density (released code: 1e-6)",
        NOT_NEGATIVE,
        of_density=True,
    )

    def __call__(self, constraint: Constraint, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        return constraint.radial_map(obs, suggested, center)

    def with_log_prob(
        self, constraint: Constraint, obs: Tensor, sample: Sample, center: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        ray = constraint.ray(obs, sample.suggested, center)
        return ray.radial_map(), ray.radial_log_prob(sample.log_prob, self.unit_ball, self.log_det_floor)


@dataclass
class Gauge(RayMap):
    """The gauge map (Tabas and Zhang, 2022), which scales the box onto the set along each ray."""

    squashes = True

    def __call__(self, constraint: Constraint, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        return constraint.gauge_map(obs, suggested, center)

    def with_log_prob(
        self, constraint: Constraint, obs: Tensor, sample: Sample, center: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        ray = constraint.ray(obs, sample.suggested, center)
        return ray.gauge_map(), ray.gauge_log_prob(sample.log_prob, self.unit_ball)
