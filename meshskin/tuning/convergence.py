"""Monitor of the iterations: keeps the best point that meets the limits, and ends the search."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..core.arrays import Array
from ..core.ipopt import IterationCallback
from ..core.progress import Stage

PATIENCE, INFEASIBLE_PATIENCE = 25, 50
"""Iterations without progress after which the search ends, from a point that meets the limits and
before one is found. Window maxima and interpolations are continuous, their slopes are not: the last
iterations may cross a kink to and fro for ever."""
MIN_ITERATIONS = 40
"""Iterations that every search may take: the first ones lead away from the limits."""
MIN_GAIN = 1e-3
"""Least relative decrease of the merit that counts as progress."""
INFEASIBLE = 1e3
"""Merit from which on a point does not meet the limits; objectives are far below, s or relative."""
SOLVED = "solved"
"""Status of a search that IPOPT ended at a solution."""


class ConvergenceMonitor(IterationCallback):
    """IPOPT's iteration callback for a program of `size` variables and `rows` constraints.

    It minimizes `merit(x, g)`: `best` is the best iterate x, `least` its merit.
    """

    def __init__(self, size: int, rows: int) -> None:
        super().__init__(size, rows, self._monitor)
        self.stage = Stage()
        """Whose steps are the iterations."""
        self.reset(lambda x, g: 0.0)

    def reset(self, merit: Callable[[Array, Array], float]) -> None:
        """Begin a search with a merit."""
        self.merit, self.idle, self.count = merit, 0, 0
        self.best: Array | None = None
        self.least = self.mark = np.inf

    def _monitor(self, x: Array, g: Array) -> bool:
        """Keep the iterate if it is the best, and return whether to stop."""
        merit = self.merit(x, g)
        if self.best is None or merit < self.least:
            self.best, self.least = x, merit
        self.count += 1
        self.stage.step()
        progress = merit < (1.0 - MIN_GAIN) * self.mark
        self.mark = merit if progress else self.mark
        self.idle = 0 if progress else self.idle + 1
        return (self.count > MIN_ITERATIONS and self.idle >= self.patience) or merit == 0.0

    @property
    def patience(self) -> int:
        """Iterations without progress after which the search ends."""
        return PATIENCE if self.mark < INFEASIBLE else INFEASIBLE_PATIENCE


def termination_message(status: str, feasible: bool, patience: int) -> str:
    """How IPOPT's search ended, by its return status."""
    if status == "Solve_Succeeded":
        return SOLVED
    reason = f"IPOPT returned {status}"
    if status == "User_Requested_Stop":  # by the monitor
        reason = f"no progress of {100 * MIN_GAIN:g} % in {patience} iterations"
    if feasible:
        return f"stopped at the best gains that meet the limits: {reason}"
    return f"stopped before any gains met the limits: {reason}"
