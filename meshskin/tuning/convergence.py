"""Watches the solver's iterations: keeps the best point that meets the limits, and says enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..core.ipopt import IterationCallback
from ..core.se3 import Array

PATIENCE, LONG = 25, 50
"""Iterations without gain after which the search ends, from a point that meets the limits and
before one is found. Windows and interpolations are continuous, their slopes are not: the last
iterations may go to and fro over a kink for ever."""
LEAST = 40
"""Iterations that every search may take: the first of them lead away from the limits."""
GAIN = 1e-3
"""Least decrease of the merit, part of it, that counts as a gain."""
BROKEN = 1e3
"""Merit from which on a point does not meet the limits."""
SOLVED = "solved"
"""How a search ended that IPOPT takes for the solution."""


@dataclass(frozen=True)
class Iterate:
    """A point of the search."""

    merit: float
    x: Array
    g: Array


class ConvergenceMonitor(IterationCallback):
    """IPOPT's iteration callback for a program of `size` variables and `rows` constraints.

    `merit(x, g)` is what is to become small: the best iterate by it is kept in `best`.
    """

    def __init__(self, size: int, rows: int) -> None:
        super().__init__(size, rows, self._watch)
        self.begin(lambda x, g: 0.0)

    def begin(self, merit: Callable[[Array, Array], float]) -> None:
        """Forget the last search."""
        self.merit, self.idle, self.count = merit, 0, 0
        self.best: Iterate | None = None
        self.mark = np.inf

    def _watch(self, x: Array, g: Array) -> bool:
        """Keep the iterate if it is the best, and say whether to stop."""
        merit = self.merit(x, g)
        if self.best is None or merit < self.best.merit:
            self.best = Iterate(merit, x, g)
        self.count += 1
        gained = merit < (1.0 - GAIN) * self.mark
        self.mark = merit if gained else self.mark
        self.idle = 0 if gained else self.idle + 1
        return (self.count > LEAST and self.idle >= self.patience) or merit == 0.0

    @property
    def patience(self) -> int:
        """Iterations without gain after which the search ends."""
        return PATIENCE if self.mark < BROKEN else LONG


def ended(word: str, feasible: bool, patience: int) -> str:
    """How IPOPT's search ended, in words: `word` is its return status."""
    if word == "Solve_Succeeded":
        return SOLVED
    why = f"IPOPT says {word}"
    if word == "User_Requested_Stop":  # the user is Watch
        why = f"no gain of {100 * GAIN:g} % in {patience} iterations"
    if feasible:
        return f"stopped at the best gains that meet the limits: {why}"
    return f"stopped before any gains met the limits: {why}"
