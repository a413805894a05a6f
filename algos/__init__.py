"""The table of algorithms: the class, the feasibility map, its placement, and whether the penalty is added."""

from __future__ import annotations

import typing
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, make_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from algos.aram import ARAM
from algos.definition import changes, define
from algos.nfwpo import NFWPO
from algos.policy import Policy, parts_of, restore, settings_of
from algos.sac import SAC
from algos.td3 import TD3
from constraints import Constraint
from core.agent import Agent
from core.config import Config, PenaltyConfig, keys_of, restore_settings
from core.flow import Flow
from core.maps import Alpha, Gauge, Map, Placement, Project, Radial
from core.words import ConfigError, NameTable, known_name
from store.files import one_line, user_path
from store.info import missing_plugin


@dataclass(frozen=True)
class Algorithm:
    """One row of the table. Raises ValueError, with the reason, for a combination that is not implemented."""

    agent: type[Agent]
    map: Map
    placement: Placement
    penalty: bool = False

    def __post_init__(self) -> None:
        self.agent.check_combination(self.map, self.placement, self.penalty)
        self._check_settings()

    @cached_property
    def config_class(self) -> type[Config]:
        """The dataclass of all settings: the agent's, the map's and, with a penalty, its weight."""
        own, hints = [], typing.get_type_hints(type(self.map))
        for f in fields(self.map):
            if self.agent.needs_log_prob or not f.metadata.get("of_density"):
                own.append((f.name, hints[f.name], field(default=getattr(self.map, f.name), metadata=f.metadata)))
        return make_dataclass(f"{self.agent.__name__}Config", own, bases=self._bases)

    @property
    def _bases(self) -> tuple[type[Config], ...]:
        """The dataclasses of the settings that do not belong to the map."""
        return (self.agent.config_class, *([PenaltyConfig] if self.penalty else []))

    def _check_settings(self) -> None:
        """Raise ValueError for a field that cannot be a key of the command line."""
        taken = {word for base in self._bases for key, f in keys_of(base).items() for word in (key, f.name)}
        for key, f in keys_of(self.map).items():
            if {key, f.name} & taken:
                raise ValueError(
                    f"{type(self.map).__name__}.{f.name} has the same name as a setting of {self.agent.__name__}"
                )
        inherited = keys_of(Config)
        for schema in (type(self.map), self.agent.config_class):
            for key, f in keys_of(schema).items():
                if "help" not in f.metadata and key not in inherited:
                    raise ValueError(f"{schema.__name__}.{f.name} must be made with core.config.setting")

    def paper_config(self, name: str, task: str, group: str, steps: int) -> Config:
        """The settings of the paper's table for a `group` of robots; "Others" if the algorithm has no such group."""
        paper = self.agent.paper
        return self.config_class(algo=name, env=task, steps=steps, **paper.get(group, paper["Others"]))

    def build(self, config: Config, constraint: Constraint, obs_dim: int, seeds: Sequence[int]) -> Agent:
        """A new agent that trains `seeds` in lockstep."""
        return self.agent(config, constraint, obs_dim, seeds, map=self.map, placement=self.placement)


ALGORITHMS = NameTable[Algorithm]("algorithm")
ALGORITHMS |= {
    "DPro": Algorithm(TD3, Project(), "rollout"),
    "DPro+": Algorithm(TD3, Project(), "rollout", penalty=True),
    "DPre": Algorithm(TD3, Project(), "environment"),
    "DPre+": Algorithm(TD3, Project(), "environment", penalty=True),
    "DOpt": Algorithm(TD3, Project(), "layer"),
    "DOpt+": Algorithm(TD3, Project(), "layer", penalty=True),
    "NFW": Algorithm(NFWPO, Project(), "rollout"),
    "DAlpha": Algorithm(TD3, Alpha(), "layer"),
    "DRad": Algorithm(TD3, Radial(), "layer"),
    "SPre": Algorithm(SAC, Project(), "environment"),
    "SPre+": Algorithm(SAC, Project(), "environment", penalty=True),
    "SAlpha": Algorithm(SAC, Alpha(), "layer"),
    "SRad": Algorithm(SAC, Radial(), "layer"),
}
"""All names. The paper's 13 come first, in the order of its table."""

PAPER = tuple(ALGORITHMS)
"""The names of the paper."""

ALGORITHMS |= {
    "DGauge": Algorithm(TD3, Gauge(), "layer"),
    "SGauge": Algorithm(SAC, Gauge(), "layer"),
    "DFlow": Algorithm(TD3, Flow(), "layer"),
    "SFlow": Algorithm(SAC, Flow(), "layer"),
    "ARAM": Algorithm(ARAM, Project(), "environment"),
}


def paper_settings(name: str, task: str, robot: Any, steps: int) -> Config:
    """The paper's configuration of the algorithm `name` on a task of `steps` environment steps.

    `robot.hyperparameters` names its group in the paper's table.
    """
    return ALGORITHMS[name].paper_config(name, task, robot.hyperparameters, steps)


def check_algorithm(name: str) -> None:
    """Check the contracts of `core.agent.Agent` on the algorithm `name`, in seconds, with small trainings.

    Raises `algos.check.ContractError`, whose message names the mistake and the remedy; ConfigError for an unknown name.
    """
    from algos.check import check  # only here: it imports all that training needs

    check(known_name("algorithm", name, ALGORITHMS), ALGORITHMS[name])


def setting_keys() -> dict[str, Field]:
    """Every key of the command line with the field that describes it. Keys of all algorithms come first."""
    keys = keys_of(Config)
    for algorithm in ALGORITHMS.values():
        keys |= {key: f for key, f in keys_of(algorithm.config_class).items() if key not in keys}
    return keys


def saved_config(settings: Mapping[str, Any]) -> Config:
    """The configuration in a run's config.yaml, whose algorithm must be one of `ALGORITHMS`."""
    return restore_settings(ALGORITHMS[settings["algo"]].config_class, settings)


def load_policy(folder: str | Path, which: str = "best") -> Policy:
    """Load the policy of the run in `folder`, finished or not: observations (n,) or (m, n) -> executed actions.

    Warns, with a UserWarning, if the definition of the task or the algorithm has changed since the training. The
    policy is then feasible under the task's current constraint.

    `which`: "best" loads the parameters of the best evaluation so far, "last" the parameters at the end of the training
    or, if it is unfinished, in its newest checkpoint. Everything is on the CPU.

    Raises ConfigError, a ValueError, for another `which`, for a folder without a run or without these parameters, for a
    bad configuration, and for an unknown algorithm or task. Import the file that defines your own algorithm or task
    first. With "last", raises `store.checkpoint.FormatError` if another version of this code wrote the checkpoint.
    """
    folder = user_path(folder)
    settings = settings_of(folder)
    try:
        known_name("algorithm", settings["algo"], ALGORITHMS)
        constraint, robot, obs_dim = parts_of(settings["env"])
    except ConfigError as error:
        raise ConfigError(f"{error}{missing_plugin(folder)}") from error
    config = replace(saved_config(settings), device="cpu")
    algorithm = ALGORITHMS[config.algo]
    if changed := changes(folder, define(robot, constraint, algorithm)):
        warnings.warn(f"{folder} was trained with {changed}", stacklevel=2)
    try:
        agent = algorithm.build(config, constraint, obs_dim, config.seeds)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{folder} has a bad configuration: {one_line(error)}") from error
    restore(agent, folder, which)
    return Policy(agent, constraint)
