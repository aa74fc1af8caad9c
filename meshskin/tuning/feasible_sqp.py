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

from ..core.arrays import Array

FIRST_RADIUS, MIN_RADIUS = 0.05, 1e-4
"""Largest change of a variable (a logarithm of a gain) in the first step, and below which the
search ends: 5 % and 0.01 % of a gain."""
MAX_STEPS = 40
"""Most steps, accepted or rejected."""


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
