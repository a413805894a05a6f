"""Pictures of feasible sets: the paper's Figure 1, and the actions that a trained policy executes in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from torch import Tensor

import envs
from algos import ALGORITHMS, saved_config
from algos.policy import Policy, restore
from constraints import Constraint, ConstraintError, LinearConstraint
from core.random import stream_seed
from core.words import ConfigError
from plots.paper import order_tasks
from plots.style import plain, save
from store.files import one_line
from store.folder import Run, find_runs, read_run
from store.info import missing_plugin

SET_COLOR, POINT_COLORS = "#cfe0f3", ("#b8520a", "#1e6b26")
# Both are nearest to the same corner: the projection maps them to one point, with a gradient of zero.
SAMPLES = ((1.16, 0.30), (1.20, -0.13))
PANELS = 8
"""Number of steps of an episode at which the feasible set is drawn."""


def polygon() -> LinearConstraint:
    """The feasible set of the figure of maps."""
    rows = [[0.0, -1.0], [0.9, -0.45], [0.75, 0.65], [-0.35, 0.94], [-1.0, 0.1]]
    bounds = [0.62, 0.68, 0.62, 0.6, 0.72]
    A, b = torch.tensor(rows, dtype=torch.float64), torch.tensor(bounds, dtype=torch.float64)
    return LinearConstraint(2, A=lambda obs: A, b=lambda obs: b)


@torch.no_grad()  # coefficients may be learned
def boundary(constraint: Constraint, obs: Tensor) -> np.ndarray:
    """Points (1440, 2) on the boundary of a two-dimensional set at obs (n,), computed from its gauge."""
    angles = torch.linspace(0.0, 2.0 * math.pi, 1441, dtype=torch.float64)[:-1]
    directions = torch.stack((angles.cos(), angles.sin()), -1)
    center = constraint.center(obs)
    gauge = constraint.gauge(obs, directions, center)
    return (center + directions / gauge.unsqueeze(-1)).numpy()


def draw_maps(folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw the paper's Figure 1: the images of the same two actions under three maps."""
    constraint, obs = polygon(), torch.zeros(1, dtype=torch.float64)
    center = constraint.center(obs)
    actions = torch.tensor(SAMPLES, dtype=torch.float64)
    maps: dict[str, Callable[[Tensor], Tensor]] = {
        "Closest-point projection": lambda action: constraint.project(obs, action),
        r"$\alpha$-projection": lambda action: constraint.alpha_map(obs, action),
        "Radial squashing": lambda action: constraint.radial_map(obs, action),
    }
    figure = Figure(figsize=(10.5, 2.75), layout="constrained")
    for axes, (title, mapping) in zip(figure.subplots(1, 3), maps.items(), strict=True):
        axes.add_patch(Polygon(boundary(constraint, obs), facecolor=SET_COLOR, edgecolor="#1f4fa8", linewidth=1.5))
        _name_point(axes, r"$\mathcal{A}_s$", (-0.5, 0.25))
        by_rays = not title.startswith("Closest")
        if by_rays:
            axes.plot(*center, marker="o", color="black", markersize=4)
            _name_point(axes, "$c_s$", center.tolist(), (-16, 2))
        mapped = mapping(actions)
        for start, end, color in zip(actions.tolist(), mapped.tolist(), POINT_COLORS, strict=True):
            if by_rays:
                axes.plot(*zip(center.tolist(), end, strict=True), ":", color=color, linewidth=1)
            arrow = {"arrowstyle": "-|>", "color": color, "shrinkA": 0, "shrinkB": 3}
            axes.annotate("", end, start, arrowprops=arrow)
            axes.plot(*start, "o", color=color, markerfacecolor="white", markersize=6)
            axes.plot(*end, "o", color=color, markersize=6)
        for name, start, end, below in zip(("a", "a'"), actions.tolist(), mapped.tolist(), (False, True), strict=True):
            _name_point(axes, f"${name}$", start, (7, -4))
            if by_rays:
                _name_point(axes, f"$P_s({name})$", end, (-44, -17 if below else 7))
        if not by_rays:
            _name_point(axes, "$P_s(a) = P_s(a')$", mapped[0].tolist(), (-98, -4))
        axes.set_title(title)
        axes.set_xlim(-0.8, 1.4)
        axes.set_ylim(-0.66, 0.78)
        axes.set_aspect("equal")
        axes.axis("off")
    return save(figure, folder, "maps", formats)


def _name_point(axes: Axes, name: str, point: Any, offset: tuple[float, float] = (0, 0)) -> None:
    """Write `name` `offset` printer's points away from `point`."""
    axes.annotate(name, point, offset, textcoords="offset points", fontsize=12)


class Episode(NamedTuple):
    """Observations, actions and rewards of an episode of T steps."""

    obs: np.ndarray  # (T, n)
    action: np.ndarray  # (T, d), executed
    reward: np.ndarray  # (T,)


def play(run: Run) -> Episode:
    """The first evaluation episode of the run's seed, played with its best parameters.

    Raises ConfigError if the run's algorithm or task is unknown, if its configuration is bad, if its parameters are
    missing, damaged or of another shape, or if the environment refuses an action or the constraint fails.
    """
    if run.task not in envs.TASKS or run.algo not in ALGORITHMS:
        raise ConfigError(
            f"{run.folder}: unknown algorithm or task, {run.algo} on {run.task}{missing_plugin(run.folder)}"
        )
    env = envs.make(run.task)
    try:
        config = replace(saved_config(run.config), device="cpu")
        agent = ALGORITHMS[run.algo].build(config, env.constraint, env.observation_space.shape[0], [run.seed])
    except (TypeError, KeyError, ValueError) as error:
        raise ConfigError(f"{run.folder} has a bad configuration: {one_line(error)}") from error
    restore(agent, run.folder, "best")
    policy = Policy(agent, env.constraint)
    steps: list[tuple[np.ndarray, np.ndarray, float]] = []
    done = False
    env.reset(seed=stream_seed(run.seed, "evaluation"))
    obs, _ = env.reset()  # the evaluator also seeds with a separate reset
    while not done:
        try:
            action = policy(obs)
            next_obs, reward, terminated, truncated, _ = env.step(action)
        except (envs.InfeasibleActionError, ConstraintError) as error:
            raise ConfigError(f"{run.folder}: the episode fails at step {len(steps) + 1}: {error}") from error
        steps.append((obs, action, reward))
        obs, done = next_obs, terminated or truncated
    env.close()
    return Episode(*(np.stack(column) for column in zip(*steps, strict=True)))


@torch.no_grad()
def draw_actions(folder: Path, out: Path, formats: Sequence[str]) -> list[Path]:
    """Draw the feasible set and executed action at `PANELS` steps of an episode, and the gauge of every action.

    Raises ConfigError if `folder` is not a run's, if its task does not have two dimensions, or as `play` does.
    """
    if folder not in find_runs(folder.parent.parent.parent):
        raise ConfigError(f"{folder} is not the folder of a run (<results>/<task>/<algorithm>/seed=<n>)")
    try:
        run = read_run(folder)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    planar = [name for name, task in envs.TASKS.items() if task.constraint.dim == 2]
    if run.task not in envs.TASKS:
        raise ConfigError(f"{folder}: unknown task {run.task!r}{missing_plugin(folder)}")
    if run.task not in planar:
        raise ConfigError(
            f"{folder}: {run.task} does not have two-dimensional actions (choices: {', '.join(order_tasks(planar))})"
        )
    episode = play(run)
    constraint = envs.constraint(run.task)
    obs, action = torch.as_tensor(episode.obs), torch.as_tensor(episode.action, dtype=torch.float64)
    center = constraint.center(obs)
    reach = constraint.gauge(obs, action - center, center).numpy()
    moments = np.linspace(0, len(obs) - 1, PANELS).round().astype(int)

    figure = Figure(figsize=(10.5, 7.2), layout="constrained")
    grid = figure.add_gridspec(3, PANELS // 2, height_ratios=[1.0, 1.0, 0.7])
    outlines = [boundary(constraint, obs[t]) for t in moments]
    limit = 1.08 * max(np.abs(outline).max() for outline in outlines)
    for k, (t, outline) in enumerate(zip(moments, outlines, strict=True)):
        row, column = divmod(k, PANELS // 2)
        axes = figure.add_subplot(grid[row, column])
        _draw_moment(axes, outline, episode.action[t], limit)
        axes.set_title(f"step {t + 1}", fontsize="medium")
        axes.set_xlabel("$a_1$" if row else "")
        axes.set_ylabel("" if column else "$a_2$")
        axes.tick_params(labelbottom=row > 0, labelleft=column == 0)
    axes = figure.add_subplot(grid[2, :])
    axes.plot(np.arange(1, len(reach) + 1), reach, color="#1f4fa8", linewidth=1.2)
    axes.plot(moments + 1, reach[moments], "o", color=POINT_COLORS[0], markersize=4)
    axes.set_xlim(0, len(reach) + 1)
    axes.set_ylim(0.0, 1.08)
    axes.set_xlabel("Step of the episode")
    axes.set_ylabel("Share of the way\nfrom centre to boundary")
    plain(axes)
    returned = episode.reward.sum()
    title = f"{run.variant} on {run.task}, seed {run.seed}: feasible set and executed action (return {returned:.2f})"
    figure.suptitle(title, wrap=True)
    return save(figure, out, f"actions-{run.task},{run.variant},seed={run.seed}", formats)


def _draw_moment(axes: Axes, outline: np.ndarray, action: np.ndarray, limit: float) -> None:
    axes.add_patch(Polygon(outline, facecolor=SET_COLOR, edgecolor="#1f4fa8", linewidth=1.2))
    axes.plot(*action, "o", color=POINT_COLORS[0], markersize=6)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.set_aspect("equal")
    plain(axes)
