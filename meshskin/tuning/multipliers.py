"""Multipliers of limits, and one-sided multipliers where the objective has a kink at a limit.

The objective as a function of a limit has a kink where moving the limit changes which others are
active: relaxing it then gains less than tightening it costs. Both follow from the quadratic program
about the solution with the limit moved.

Source: Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming"
(1983); Gauvin, "A necessary and sufficient regularity condition to have bounded multipliers in
nonconvex programming" (Math. Programming 12, 1977).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..core.arrays import Array
from .feasible_sqp import QuadraticModel

ACTIVE = 2e-3
"""Distance from a limit, in its scale, or from the end of a range, below which it is active: twice
the largest violation of a solution (problem.TOLERANCE)."""
MIN_SENSITIVITY = 1e-2
"""Change of a limit, in its scale, by a gain e times as large, below which no gain affects it."""


def predicted_decrease(model: QuadraticModel) -> float:
    """Decrease of the objective that the model predicts for a first step; the objective is a
    logarithm, so this is a part of its value."""
    found = model.step()
    return 0.0 if found is None else float(max(-found[1], 0.0))


def lagrange_multipliers(model: QuadraticModel) -> tuple[Array, Array]:
    """Multipliers of the limits (m,), and of the ends of the ranges (2 n,), low ends first.

    Non-negative least squares on the stationarity of the Lagrangian: the result depends neither on
    the solver's barrier nor on where it stopped. The residual is measured in the norm of H^-1, so
    that a slope that a tiny step would level counts for little.
    """
    size = len(model.gradient)
    affected = np.abs(model.jacobian[:, :-1]).max(axis=1) > MIN_SENSITIVITY
    active = np.flatnonzero((model.limits > -ACTIVE) & affected)
    ends = np.flatnonzero(np.concatenate([model.low, -model.high]) > -ACTIVE)
    walls = np.concatenate([-np.eye(size), np.eye(size)])[ends]
    columns = np.concatenate([model.jacobian[active], walls]).T
    root = np.linalg.cholesky(model.hessian)
    found = nnls(*(np.linalg.solve(root, b) for b in (columns, -model.gradient)))[0]
    limits, ranges = np.zeros(len(model.limits)), np.zeros(2 * size)
    limits[active], ranges[ends] = found[: len(active)], found[len(active) :]
    return limits, ranges


def one_sided_multipliers(
    model: QuadraticModel, rows: NDArray[np.bool_], by: float
) -> tuple[float, float] | None:
    """Gain of the objective when the limits `rows` (m,) are relaxed by `by`, and its cost when they
    are tightened, each divided by `by`; None where no step meets the tightened limits.
    """
    shift = by * rows.astype(np.float64)
    steps = [model.step(relaxation=sign * shift) for sign in (0.0, 1.0, -1.0)]
    changes = [found[1] for found in steps if found is not None]
    if len(changes) < len(steps):
        return None
    unchanged, relaxed, tightened = changes
    return (unchanged - relaxed) / by, (tightened - unchanged) / by
