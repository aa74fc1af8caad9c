"""A feasible sequential quadratic program: descent along limits without leaving them.

The torque of a touch depends on where between two steps it falls, so that the limits are
saw-toothed functions of the gains. A search that violates limits on its way leaves its tooth in
the first step and does not return; this one starts from a feasible point and solves, within a trust
region,

    min  f' d + d' H d / 2    subject to  g + g' d <= max(g, 0),  |d| <= radius,  low <= x + d

Limits that hold at every step are one row each: the largest of them has a one-sided slope only.

Weighed: on a saw-toothed limit (tests/tuning/test_feasible_sqp.py) CasADi's sqpmethod leaves the
tooth and ends with the limit violated; its feasiblesqpmethod stays feasible, but prints every
iteration to the standard output, which no option stops, and takes all rows into its program.

Source: Nocedal, Wright, "Numerical Optimization" (2006), section 18.5, with the merit of the search
in place of a penalty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..core.arrays import Array

FIRST_RADIUS, MIN_RADIUS = 0.05, 1e-4
"""Largest change of a variable (a logarithm of a gain) in the first step, and below which the
search ends: 5 % and 0.01 % of a gain."""
MAX_STEPS = 40
"""Most steps, accepted or rejected."""
ACTIVE = 2e-3
"""Distance from a limit, in its scale, or from the end of a range, below which it is active: twice
the largest violation of a solution (problem.TOLERANCE)."""
MIN_SENSITIVITY = 1e-2
"""Change of a limit, in its scale, by a gain e times as large, below which no gain affects it."""


@dataclass(frozen=True)
class QuadraticModel:
    """Objective and limits about a point x (n,)."""

    gradient: Array
    """Gradient of the objective (n,)."""
    limits: Array
    """Values of the limits (m,): at most 0 where they are met."""
    jacobian: Array
    """Jacobian of the limits (m, n)."""
    hessian: Array
    """Positive definite Hessian of the objective's model (n, n)."""
    low: Array
    """Largest decrease of each variable (n,), at most 0."""
    high: Array
    """Largest increase of each variable (n,), at least 0."""

    def step(
        self, radius: float = FIRST_RADIUS, relaxation: Array | float = 0.0
    ) -> tuple[Array, float] | None:
        """The best step (n,) and its change of the objective; None where no step is feasible.

        relaxation (m,): added to the bounds of the limits.
        """
        near = self.limits + np.abs(self.jacobian).sum(axis=1) * radius > 0.0
        room = (np.maximum(-self.limits, 0.0) + relaxation)[near]
        size = len(self.gradient)
        solver = ca.conic(
            "step",
            "daqp",
            {"h": ca.Sparsity.dense(size, size), "a": ca.Sparsity.dense(len(room), size)},
            {"error_on_fail": False},
        )
        found = solver(
            h=self.hessian, g=self.gradient, a=self.jacobian[near], lba=-np.inf, uba=room,
            lbx=np.maximum(self.low, -radius), ubx=np.minimum(self.high, radius),
        )  # fmt: skip
        step = np.array(found["x"]).ravel()
        return (step, float(found["cost"])) if solver.stats()["success"] else None

    def predicted_decrease(self) -> float:
        """Decrease of the objective that the model predicts for a first step; the objective is a
        logarithm, so this is a part of its value."""
        found = self.step()
        return 0.0 if found is None else float(max(-found[1], 0.0))

    def multipliers(self) -> tuple[Array, Array]:
        """Multipliers of the limits (m,), and of the ends of the ranges (2 n,), low ends first.

        Non-negative least squares on the stationarity of the Lagrangian: the result depends neither
        on the solver's barrier nor on where it stopped. The residual is measured in the norm of
        H^-1, so that a slope that a tiny step would level counts for little. Source: Fiacco,
        "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming" (1983).
        """
        size = len(self.gradient)
        affected = np.abs(self.jacobian[:, :-1]).max(axis=1) > MIN_SENSITIVITY
        active = np.flatnonzero((self.limits > -ACTIVE) & affected)
        ends = np.flatnonzero(np.concatenate([self.low, -self.high]) > -ACTIVE)
        walls = np.concatenate([-np.eye(size), np.eye(size)])[ends]
        columns = np.concatenate([self.jacobian[active], walls]).T
        root = np.linalg.cholesky(self.hessian)
        found = nnls(*(np.linalg.solve(root, b) for b in (columns, -self.gradient)))[0]
        limits, ranges = np.zeros(len(self.limits)), np.zeros(2 * size)
        limits[active], ranges[ends] = found[: len(active)], found[len(active) :]
        return limits, ranges

    def one_sided_multipliers(
        self, rows: NDArray[np.bool_], by: float
    ) -> tuple[float, float] | None:
        """Gain of the objective when the limits `rows` (m,) are relaxed by `by`, and its cost when
        they are tightened, each divided by `by`; None where no step meets the tightened limits.

        They differ where moving the limit changes which others are active: a kink of the objective.
        Source: Gauvin, "A necessary and sufficient regularity condition to have bounded multipliers
        in nonconvex programming" (Math. Programming 12, 1977).
        """
        shift = by * rows.astype(np.float64)
        steps = [self.step(relaxation=sign * shift) for sign in (0.0, 1.0, -1.0)]
        changes = [found[1] for found in steps if found is not None]
        if len(changes) < len(steps):
            return None
        unchanged, relaxed, tightened = changes
        return (unchanged - relaxed) / by, (tightened - unchanged) / by


def descend(
    x: Array,
    model: Callable[[Array], QuadraticModel],
    limits: Callable[[Array], Array],
    merit: Callable[[Array, Array], float],
) -> tuple[Array, int]:
    """Minimize `merit(x, limits(x))` from a feasible x (n,): the last x, and the number of steps.

    merit must be large where a limit is not met.
    """
    here = model(x)
    value, radius, count = merit(x, here.limits), FIRST_RADIUS, 0
    while radius > MIN_RADIUS and count < MAX_STEPS:
        count += 1
        found = here.step(radius)
        if found is None:
            radius *= 0.5
            continue
        step = np.clip(found[0], here.low, here.high)
        new = merit(x + step, limits(x + step))
        if not new < value:
            radius = 0.5 * min(radius, float(np.abs(step).max()))
            continue
        x, value, radius = x + step, new, 2.0 * radius
        here = model(x)
    return x, count


def descent_message(count: int) -> str:
    """How a descent of `count` steps ended."""
    reason = f"no change of the gains by more than {100 * MIN_RADIUS:g} % reduces the objective"
    if count >= MAX_STEPS:
        reason = f"{MAX_STEPS} steps were made"
    return f"stopped at the best gains that meet the limits, after a descent along them: {reason}"
