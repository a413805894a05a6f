"""The entropy that a policy can reach on each task, beside SAC's target entropy.

    python bench/entropy.py                                # all tasks
    python bench/entropy.py task=R+L2,R+T states=256       # two of them, at more states

Prints a table and saves it in `out` (default bench/results) as entropy.md; all tasks take about fifteen minutes. The
values are means over `states` states that a run's warm-up visits:

- target: SAC's, -d.
- uniform: the entropy of the uniform distribution on the feasible set, the log of its volume. No policy has more.
- SRad, SAlpha: the largest entropy of N(mean, diag std^2) after the map, in the measure of `entropy=paper`. Gradient
  ascent on mean and std finds it in each state, so it is a lower bound. It is measured with new noise samples.
- SRad ball, SAlpha ball: the same in the measure of `entropy=ball`.

If the target is above the largest entropy, the temperature rises without end. If it is just below, the policy stays as
random as possible.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# A script's own folder is first on the path; the imports below need the project root.
sys.path[0] = str(Path(__file__).resolve().parents[1])

import torch
from scipy.stats import qmc
from torch import Tensor
from torch.distributions import Normal
from tqdm import tqdm

import envs
from constraints import Constraint
from core.words import ConfigError, parse_words, split_names, whole_number

DIRECTIONS, SAMPLES, FRESH_SAMPLES, ASCENT_STEPS, RATE = 2**14, 512, 2**12, 200, 0.05
MAPS = {
    "SRad": ("radial", False),
    "SAlpha": ("alpha", False),
    "SRad ball": ("radial", True),
    "SAlpha ball": ("alpha", True),
}


def visited_states(task: str, states: int) -> Tensor:
    """Observations (states, n), twenty steps apart, under projected uniform actions."""
    env = envs.make(task, project=True)
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    visited = []
    for step in range(20 * states):
        if step % 20 == 0:
            visited.append(torch.as_tensor(obs))
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            obs, _ = env.reset()
    env.close()
    return torch.stack(visited).double()


def normal_noise(samples: int, dim: int, seed: int) -> Tensor:
    """Quasi-random standard normal numbers (samples, dim): more evenly spread than random ones."""
    return torch.as_tensor(qmc.MultivariateNormalQMC([0.0] * dim, rng=seed).random(samples))


def uniform_entropy(constraint: Constraint, obs: Tensor) -> Tensor:
    """Log-volume (states,) of the set: the unit ball's volume times the mean of reach^d over all directions."""
    dim = constraint.dim
    directions = torch.nn.functional.normalize(normal_noise(DIRECTIONS, dim, seed=0), dim=-1)
    log_reach = torch.stack([-constraint.gauge(o, directions, constraint.center(o)).log() for o in obs])
    log_unit_ball = dim / 2 * math.log(math.pi) - math.lgamma(dim / 2 + 1)
    return log_unit_ball + torch.logsumexp(dim * log_reach, -1) - math.log(DIRECTIONS)


@torch.no_grad()
def log_density(
    constraint: Constraint, obs: Tensor, action: Tensor, policy: Normal, mapping: str, unit_ball: bool
) -> Tensor:
    """Log-density (samples, states) of the mapped `action` (samples, states, d) drawn from `policy` (states, d)."""
    ray = constraint.ray(obs, action, constraint.center(obs))
    if mapping == "alpha":
        return ray.alpha_log_prob(policy.mean, policy.stddev, unit_ball)
    return ray.radial_log_prob(policy.log_prob(action).sum(-1), unit_ball)


def largest_entropy(constraint: Constraint, obs: Tensor, mapping: str, unit_ball: bool) -> Tensor:
    """The largest entropy (states,) of a Gaussian with independent coordinates after the map, by gradient ascent."""
    dim, center = constraint.dim, constraint.center(obs)
    noise = normal_noise(SAMPLES, dim, seed=1).unsqueeze(1)
    reach = torch.stack([1 / constraint.gauge(obs, axis, center) for axis in torch.eye(dim).double()], -1)
    mean = (center + 0.1 * reach).requires_grad_()  # not the centre itself, which may be a saddle point
    log_std = reach.log().requires_grad_()
    optimizer = torch.optim.Adam([mean, log_std], RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, ASCENT_STEPS)
    for _ in range(ASCENT_STEPS):
        policy = Normal(mean, log_std.exp())
        action = (mean + log_std.exp() * noise).detach()
        # The gradient of the entropy is -E[log q grad log p]. SAC's gradient through the action would miss probability
        # that moves from the interior to the boundary under the alpha map, where log q jumps.
        surprise = log_density(constraint, obs, action, policy, mapping, unit_ball)
        loss = ((surprise - surprise.mean(0)) * policy.log_prob(action).sum(-1)).mean(0).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        policy = Normal(mean, log_std.exp())
        action = mean + log_std.exp() * normal_noise(FRESH_SAMPLES, dim, seed=2).unsqueeze(1)
        return -log_density(constraint, obs, action, policy, mapping, unit_ball).mean(0)


def measure(task: str, states: int) -> list[str]:
    """A row of the table."""
    constraint = envs.constraint(task)
    obs = visited_states(task, states)
    entropies = [uniform_entropy(constraint, obs)]
    entropies += [largest_entropy(constraint, obs, mapping, unit_ball) for mapping, unit_ball in MAPS.values()]
    return [task, f"{-constraint.dim}", *(f"{entropy.mean():.2f}" for entropy in entropies)]


def main(arguments: list[str]) -> int:
    """Exit code: 0 done, 2 bad input, 130 interrupted."""
    if {"-h", "--help", "help"} & set(arguments):
        print(__doc__.strip())
        return 0
    try:
        options = {"task": "all", "states": "64", "out": "bench/results"}
        options |= parse_words(arguments, options)
        states = whole_number("states", options["states"])
        tasks = split_names("task", options["task"], envs.TASKS)
        path = Path(options["out"]) / "entropy.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.set_num_threads(1)
        lines = [f"Means over {states} states.", "", f"| task | target | uniform | {' | '.join(MAPS)} |"]
        lines.append("|---|" + "---:|" * (2 + len(MAPS)))
        try:
            for task in tqdm(tasks, unit="task"):
                lines.append(f"| {' | '.join(measure(task, states))} |")
                path.write_text("\n".join(lines) + "\n")
        except KeyboardInterrupt:
            print("\ninterrupted; the measurements so far are kept", file=sys.stderr)
        print("\n".join(lines))
    except (ConfigError, OSError) as error:
        print(f"bench/entropy.py: {error}", file=sys.stderr)
        return 2
    return 0 if len(lines) == 4 + len(tasks) else 130


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
