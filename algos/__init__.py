"""The 13 algorithms: which class, which feasibility map, where it stands, and whether the penalty is added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from algos.nfwpo import NFWPO
from algos.sac import SAC
from algos.td3 import TD3
from constraints import Constraint
from core.agent import Agent, MapName, Placement
from core.config import Config


@dataclass(frozen=True)
class Algorithm:
    """One column of the paper's table."""

    agent: type[Agent]
    mapping: MapName
    placement: Placement
    penalty: bool = False

    @property
    def base(self) -> str:
        """The base algorithm, which decides the hyperparameters: "TD3" or "SAC"."""
        return "SAC" if issubclass(self.agent, SAC) else "TD3"

    def build(self, config: Config, constraint: Constraint, obs_dim: int, seeds: Sequence[int]) -> Agent:
        """A new agent that trains `seeds` in lockstep."""
        return self.agent(config, constraint, obs_dim, seeds, mapping=self.mapping, placement=self.placement)


ALGORITHMS: dict[str, Algorithm] = {
    "DPro": Algorithm(TD3, "project", "rollout"),
    "DPro+": Algorithm(TD3, "project", "rollout", penalty=True),
    "DPre": Algorithm(TD3, "project", "environment"),
    "DPre+": Algorithm(TD3, "project", "environment", penalty=True),
    "DOpt": Algorithm(TD3, "project", "layer"),
    "DOpt+": Algorithm(TD3, "project", "layer", penalty=True),
    "NFW": Algorithm(NFWPO, "project", "rollout"),
    "DAlpha": Algorithm(TD3, "alpha", "layer"),
    "DRad": Algorithm(TD3, "radial", "layer"),
    "SPre": Algorithm(SAC, "project", "environment"),
    "SPre+": Algorithm(SAC, "project", "environment", penalty=True),
    "SAlpha": Algorithm(SAC, "alpha", "layer"),
    "SRad": Algorithm(SAC, "radial", "layer"),
}
"""The paper's 13 names, in the order of its table."""

PAPER = tuple(ALGORITHMS)
"""The names of the paper's own algorithms, which `algo=paper` stands for."""
