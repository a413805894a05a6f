"""How far outside the feasible set the actor's suggestions lie, measured while it explores."""

from __future__ import annotations

import math
from dataclasses import dataclass

EVERY = 10
"""One in this many environment steps of a seed is measured. That takes a few percent of a step's time on a GPU."""


@dataclass
class Suggestions:
    """Measures of one seed's suggestions, with exploration noise, since its last evaluation (`Agent.proposed`)."""

    count: int = 0
    infeasible: int = 0
    violation: float = 0.0  # sum over all suggestions, 0 for feasible ones, in units of `Constraint.violation`

    def add(self, violation: float) -> None:
        """Count a suggestion. Its `violation` is at most 0 if it is feasible."""
        self.count += 1
        if violation > 0.0:
            self.infeasible += 1
            self.violation += violation

    def take(self) -> dict[str, float]:
        """Return the mean violation and the share of infeasible suggestions, NaN without any. Start a new count."""
        measures = {
            "suggested_violation": self.violation / self.count if self.count else math.nan,
            "suggested_infeasible": self.infeasible / self.count if self.count else math.nan,
        }
        self.count, self.infeasible, self.violation = 0, 0, 0.0
        return measures
