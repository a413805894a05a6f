"""The base class of the algorithms: acting through the feasibility map, warm-up actions and steps of optimisers."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, get_args

import torch
from torch import Tensor

from constraints import Constraint
from core.config import AUTO, Config, PenaltyConfig
from core.maps import Map, Placement
from core.random import Streams
from core.replay import Batch
from core.snapshot import Snapshots, parameters_of

MAP = "map"
"""The prefix of the map's parameters in the names of saved parameters."""


class Action(NamedTuple):
    """Actions (seeds, d) on the CPU."""

    suggested: Tensor  # before any clamp or map
    executed: Tensor  # what the robot does
    stored: Tensor  # what the replay buffer keeps and the critic learns from


class Agent(Snapshots):
    """Base of the algorithms; learning tensors are (seeds, batch, features).

    The actor *suggests* an action and the feasibility map turns it into the *executed* one. `placement` says where
    the map stands (paper, Section "Algorithms for Action-Constrained RL"):

    - `environment`: inside the environment; critic and replay buffer see the suggested action;
    - `rollout`: between actor and environment; critic and buffer see the executed action, but the actor's loss ignores
      the map;
    - `layer`: the last layer of the actor; critic and buffer see the executed action, gradients pass through the map.

    An algorithm declares its settings, its rows of the paper's table and what it supports in class attributes, and
    implements the abstract methods. It is off-policy: it learns from batches of a replay buffer.

    It must keep these contracts, which `algos.check_algorithm` checks:

    - Random numbers come from `init` in `build`, from `exploration` (with `which=which`) in acting and from
      `update_noise` in gradient steps, and from nowhere else: the same command gives the same bits.
    - A learned parameter has k rows per seed (see `networks`). The rows of seed i are initialised from init[i].
      `networks` returns all modules, `optimizers` all optimisers. A parameter that no optimiser trains is frozen.
    - No seed depends on other seeds: a loss is the mean over the batch and never over seeds, and `explore`,
      `start_episode` and `start_rollout` change only the rows `which`.
    - `memory` returns all other tensors that later steps depend on, so that a resumed training repeats every bit.
    - Every loss goes through `descend`, so that a divergence ends its seed.
    - Executed actions, also those of `policy`, come from the map (`feasible`). `policy` is deterministic, and keeps a
      copy of its parameters.
    - `statistics` returns the same names in every call, with one value per seed.
    - If gradient steps differ, `update` counts them in `updates`, and `cycle` is their period.
    """

    config_class: ClassVar[type[Config]] = Config
    """The dataclass of its settings."""
    family: ClassVar[str]
    """The base algorithm, such as TD3. It names the columns in the table of hyperparameters."""
    paper: ClassVar[dict[str, dict[str, Any]]]
    """Settings of the paper's table by group of robots. "Others" is for robots without their own group."""
    maps: ClassVar[tuple[type[Map], ...]] = (Map,)
    """The classes of maps that it supports."""
    placements: ClassVar[tuple[Placement, ...]] = get_args(Placement)
    """The placements of its map that it supports."""
    needs_log_prob: ClassVar[bool] = False
    """Whether it needs the log-density of the action that the critic sees."""
    takes_penalty: ClassVar[bool] = False
    """Whether its actor loss supports the term `penalty` of the names with +."""

    @classmethod
    def check_combination(cls, map: Map, placement: Placement, penalty: bool) -> None:
        """Raise ValueError, with the reason, if the algorithm is not implemented for this combination."""
        name, map_name = cls.__name__, type(map).__name__
        missing = [*sorted(cls.__abstractmethods__), *(a for a in ("family", "paper") if not hasattr(cls, a))]
        if missing:
            raise ValueError(f"{name} is not complete: it does not define {', '.join(missing)}")
        if "Others" not in cls.paper:
            raise ValueError(f"{name}.paper needs an entry 'Others', for robots without a group of their own")
        if isinstance(map, type):
            raise ValueError(f"map must be an object such as {map.__name__}(), got the class")
        if placement not in get_args(Placement):
            raise ValueError(f"unknown placement {placement!r} (choices: {', '.join(get_args(Placement))})")
        if not isinstance(map, cls.maps):
            raise ValueError(f"{name} is implemented for {' and '.join(m.__name__ for m in cls.maps)}, not {map_name}")
        if placement not in cls.placements:
            raise ValueError(f"{name} is implemented for placement {' and '.join(cls.placements)}, not {placement}")
        if placement not in map.placements:
            raise ValueError(
                f"{map_name} supports placement {' and '.join(map.placements)}, not {placement}: outside the actor, a"
                " map must leave feasible actions unchanged"
            )
        if cls.needs_log_prob and placement != "environment" and not map.has_log_prob():
            raise ValueError(f"{name} needs the log-density of mapped actions, and {map_name} has no with_log_prob")
        if penalty and not cls.takes_penalty:
            raise ValueError(f"{name} takes no penalty: its actor loss does not use it")

    def __init__(
        self,
        config: Config,
        constraint: Constraint,
        obs_dim: int,
        seeds: Sequence[int],
        *,
        map: Map,
        placement: Placement,
    ):
        self.config, self.constraint = config, constraint
        self.seeds, self.obs_dim, self.action_dim = seeds, obs_dim, constraint.dim
        self.map = map.configured(config)
        self.placement = placement
        self.stores_centers = self.map.replays_center(constraint)
        self.penalty_weight = config.penalty if isinstance(config, PenaltyConfig) else None
        # The device of networks, batches and the inputs of `explore` and `policy`. `sweep.train` has resolved auto.
        self.device = torch.device("cpu" if config.device == AUTO else config.device)
        self.exploration = Streams(seeds, "explore", self.device)
        self.update_noise = Streams(seeds, "update", self.device)
        self.updates = 0  # gradient steps so far, where an algorithm counts them (see `cycle`)
        self.losses: dict[str, Tensor] = {}  # (..., seeds) of the last step of each optimiser
        self.build(Streams(seeds, "init").generators)

    # ---------------------------------------------------------------- what an algorithm implements, besides `Snapshots`

    @abstractmethod
    def build(self, init: Sequence[torch.Generator]) -> None:
        """Make networks and optimisers; `init` has a generator of initial weights for each seed."""

    @abstractmethod
    def explore(self, obs: Tensor, which: Sequence[int]) -> Tensor:
        """Suggestions (seeds, d) with exploration noise, for obs (seeds, n). Only the rows `which` count.

        If the map squashes, `act` clamps the suggestions to the box.
        """

    @abstractmethod
    def policy(self, which: Sequence[int]) -> Callable[[Tensor], Tensor]:
        """The current deterministic policy of the seeds `which`: obs (len(which), m, n) -> executed actions."""

    @abstractmethod
    def update(self, batch: Batch) -> None:
        """One gradient step of every seed."""

    def start_rollout(self, which: Sequence[int]) -> None:  # noqa: B027 - most algorithms have nothing to do
        """Called before the first step of each rollout of the seeds `which`, also in warm-up."""

    def start_episode(self, which: Sequence[int]) -> None:  # noqa: B027 - most algorithms have nothing to do
        """Called before the first step of each training episode of the seeds `which`, also in warm-up.

        Initialise here what lasts for an episode, such as the noise of an Ornstein-Uhlenbeck process. Draw from
        `self.exploration` with `which=which`, write only to the rows `which`, and return the tensor in `memory()`: a
        training that resumes within an episode does not call this again. If a rollout starts at the same step,
        `start_rollout` is called afterwards. Evaluation episodes do not call this.
        """

    def statistics(self) -> dict[str, Tensor]:
        """Measures of the last gradient steps, for training.csv: name -> (seeds,), the same names in every call.

        Called at each evaluation after the first gradient step. A resumed training may call it before its next gradient
        step, so keep the numbers in `memory()` or compute them from it.
        """
        return {}

    @property
    def cycle(self) -> int:
        """The number of gradient steps after which the kinds of steps repeat.

        On a GPU, one CUDA graph is captured for each residue of `self.updates` modulo `cycle`. An algorithm whose steps
        differ, such as TD3's with and without the actor, overrides this and counts `self.updates` in `update`.
        """
        return 1

    # ---------------------------------------------------------------- acting

    @torch.no_grad()
    def act(self, obs: Tensor, center: Tensor | None, warming_up: Sequence[int], exploring: Sequence[int]) -> Action:
        """Random actions for the seeds `warming_up`, the actor's actions with noise for the seeds `exploring`.

        obs (seeds, n) and `center` (seeds, d), from `centers`, are on the CPU. Ignore the other rows of the result.
        """
        if len(exploring) == len(self.seeds):
            raw = self.explore(obs.to(self.device), exploring).cpu()
        elif len(warming_up) == len(self.seeds):
            raw = self.warm_up(warming_up).cpu()
        else:
            raw = torch.zeros(len(self.seeds), self.action_dim)
            if warming_up:
                raw[warming_up] = self.warm_up(warming_up).cpu()[warming_up]
            if exploring:
                raw[exploring] = self.explore(obs.to(self.device), exploring).cpu()[exploring]
        suggested = self.bounded(raw)
        if exploring:
            executed = self.feasible(obs, suggested, center)
        if warming_up:
            pulled_back = self.map.pull_back(self.constraint, obs, suggested, center)
            if exploring:
                executed[warming_up] = pulled_back[warming_up]
            else:
                executed = pulled_back
        return Action(raw, executed, suggested if self.placement == "environment" else executed)

    @torch.no_grad()
    def centers(self, obs: Tensor) -> Tensor | None:
        """The centres (..., d) of the sets at obs (..., n); None if the map uses no centre or only the origin."""
        return self.constraint.center(obs) if self.stores_centers else None

    def feasible(self, obs: Tensor, suggested: Tensor, center: Tensor | None) -> Tensor:
        """Map suggestions (..., d) to feasible actions (..., d) with the algorithm's map."""
        return self.map(self.constraint, obs, suggested, center)

    def squash(self, raw: Tensor) -> Tensor:
        """Turn the output `raw` of an actor's network into a suggestion: tanh(raw) if the map squashes, else raw."""
        return raw.tanh() if self.map.squashes else raw

    def bounded(self, raw: Tensor) -> Tensor:
        """The map's input for the suggestions `raw`: clamped to the box if the map squashes."""
        return raw.clamp(-1.0, 1.0) if self.map.squashes else raw

    def proposed(self, obs: Tensor, raw: Tensor) -> Tensor:
        """The actions whose violation training.csv logs, for the suggestions `raw`."""
        return self.map.propose(self.constraint, obs, self.bounded(raw))

    def warm_up(self, which: Sequence[int]) -> Tensor:
        """Random suggestions (seeds, d), uniform in the box, for the seeds `which`."""
        return self.exploration.uniform(self.action_dim, which=which)

    # ---------------------------------------------------------------- learning

    def penalty(self, obs: Tensor, suggested: Tensor) -> Tensor | float:
        """The term (seeds, batch) that algorithms with + add to the actor loss; 0.0 for others (paper, "Algorithms").

        An algorithm that uses it sets `takes_penalty`.
        """
        weight = self.penalty_weight
        return 0.0 if weight is None else weight * self.constraint.penalty(obs, suggested)

    def descend(self, name: str, losses: Tensor) -> None:
        """Take one step of the optimiser `name` on the sum of `losses` (..., seeds), which `diverged` checks.

        Only the optimiser's own parameters get gradients. Raises ValueError for an unknown name, and for losses whose
        last axis is not the seeds: their gradients would depend on the number of seeds.
        """
        optimizers = self.optimizers()
        if name not in optimizers:
            raise ValueError(f"there is no optimiser {name!r} (choices: {', '.join(optimizers)})")
        if losses.shape[-1:] != (len(self.seeds),):
            raise ValueError(
                f"losses of {name!r} have shape {tuple(losses.shape)}, expected (..., seeds) = (..., {len(self.seeds)})"
            )
        self.losses[name] = losses.detach()
        optimizer = optimizers[name]
        parameters = parameters_of(optimizer)
        for parameter, gradient in zip(parameters, torch.autograd.grad(losses.sum(), parameters), strict=True):
            parameter.grad = gradient
        optimizer.step()

    def diverged(self) -> dict[int, str]:
        """Maps the position of each seed with a loss that is not finite to the loss's name. Waits for the device."""
        found: dict[int, str] = {}
        sums = [losses.sum() for losses in self.losses.values()]
        if not sums or math.isfinite(torch.stack(sums).sum().item()):  # the common case waits once
            return found
        for name, losses in self.losses.items():
            if not math.isfinite(losses.sum().item()):
                finite = losses.isfinite().reshape(-1, len(self.seeds)).all(0)
                for i in (~finite).nonzero().flatten().tolist():
                    found.setdefault(i, f"{name} loss")
        return found

    def state(self, i: int) -> dict[str, Tensor]:
        return super().state(i) | {f"{MAP}.{name}": value for name, value in self.map.state().items()}

    def load_state(self, i: int, state: dict[str, Tensor]) -> None:
        super().load_state(i, state)
        learned = {name.removeprefix(f"{MAP}."): value for name, value in state.items() if name.startswith(f"{MAP}.")}
        self.map.load_state(learned)

    def streams(self) -> dict[str, Streams]:
        return {"exploration": self.exploration, "update_noise": self.update_noise}
