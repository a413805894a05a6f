"""How far outside the feasible set the actor's suggestions lie, measured while it explores."""

from __future__ import annotations

import math
from dataclasses import dataclass

EVERY = 10
"""One of so many environment steps of a seed is measured: a measurement costs some percent of a step on a GPU."""


@dataclass
class Suggestions:
    """The suggestions of one seed since its last evaluation, with exploration noise, as the map is given them."""

    count: int = 0
    infeasible: int = 0
    violation: float = 0.0  # sum over all, zero for feasible ones, in the units of `Constraint.violation`

    def add(self, violation: float) -> None:
        """Count a suggestion; its `violation` is at most 0 where it is feasible."""
        self.count += 1
        if violation > 0.0:
            self.infeasible += 1
            self.violation += violation

    def take(self) -> dict[str, float]:
        """The mean violation and the share of infeasible suggestions, NaN without any. The count starts again."""
        measures = {
            "suggested_violation": self.violation / self.count if self.count else math.nan,
            "suggested_infeasible": self.infeasible / self.count if self.count else math.nan,
        }
        self.count, self.infeasible, self.violation = 0, 0, 0.0
        return measures
