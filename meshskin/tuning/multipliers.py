"""What limits cost: multipliers, and the two one-sided prices where an objective bends at a limit.

The objective over a limit has a kink where the limit's being moved changes which others hold: then
to relax it gains less than to tighten it costs. Both are read off the quadratic program about the
solution with the limit moved.

Source: Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming"
(1983); Gauvin, "A necessary and sufficient regularity condition to have bounded multipliers in
nonconvex programming" (Math. Programming 12, 1977).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..core.se3 import Array
from .descent import RADIUS, Model

TOUCHED = 2e-3
"""Distance from a limit, in its scale, or from the end of a range, below which it is touched."""
FLAT = 1e-2
"""Change of a limit, in its scale, by gains e times as large, below which none holds it."""
MOVED = 5e-3
"""Part of its bound by which a limit is moved to see its price."""


def promised(model: Model) -> float:
    """What the slopes promise of a step: part of the objective, as its logarithm is modelled."""
    found = model.step(RADIUS)
    return 0.0 if found is None else float(max(-found[1], 0.0))


def pulls(model: Model) -> tuple[Array, Array]:
    """Multipliers of the limits (m,), and of the ends of the ranges (2 n,), low ends first.

    By non-negative least squares on the stationarity of the Lagrangian, so that they depend
    neither on the solver's barrier nor on where it stopped: the residual is measured by the
    step that it calls for, that a slope which a hair's breadth would level counts for little.
    """
    size = len(model.slope)
    moved = np.abs(model.slopes[:, :-1]).max(axis=1) > FLAT
    touched = np.flatnonzero((model.limits > -TOUCHED) & moved)
    ends = np.flatnonzero(np.concatenate([model.low, -model.high]) > -TOUCHED)
    walls = np.concatenate([-np.eye(size), np.eye(size)])[ends]
    columns = np.concatenate([model.slopes[touched], walls]).T
    root = np.linalg.cholesky(model.bent)
    pull = nnls(*(np.linalg.solve(root, b) for b in (columns, -model.slope)))[0]
    limits, ranges = np.zeros(len(model.limits)), np.zeros(2 * size)
    limits[touched], ranges[ends] = pull[: len(touched)], pull[len(touched) :]
    return limits, ranges


def sided(model: Model, rows: NDArray[np.bool_], by: float) -> tuple[float, float] | None:
    """What the objective gains when the limits `rows` (m,) are relaxed by `by`, and what it costs
    to tighten them, each over `by`; None where no step meets the tightened ones.
    """
    far = by * rows.astype(np.float64)
    now, wider, tighter = (model.step(RADIUS, k * far) for k in (0.0, 1.0, -1.0))
    if now is None or wider is None or tighter is None:
        return None
    return float(now[1] - wider[1]) / by, float(tighter[1] - now[1]) / by


def apart(prices: Mapping[str, tuple[float, float]], part: float) -> dict[str, tuple[float, float]]:
    """Those whose two sides differ by more than `part` of the larger."""
    return {
        name: (wide, tight)
        for name, (wide, tight) in prices.items()
        if abs(tight - wide) > part * max(abs(tight), abs(wide))
    }
