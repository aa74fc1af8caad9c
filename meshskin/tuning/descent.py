"""Downhill along the limits: sequential quadratic programming that keeps every limit it meets.

The torque of a touch depends on where between two steps it falls, so that limits are saw-toothed
over the gains. A search that may break limits on its way leaves its tooth by the first step and
does not come back; this one goes on from a point that meets them, within a region of trust:

    min  f' d + d' H d / 2    subject to  g + g' d <= max(g, 0),  |d| <= radius,  low <= x + d

Limits that hold at every step are a row each: the largest of them has a slope to one side only.

Source: Nocedal, Wright, "Numerical Optimization" (2006), section 18.5, with the merit of the search
in place of a penalty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ..core.se3 import Array

RADIUS, LEAST = 0.05, 1e-4
"""Largest change of a variable in the first step, and below which there is no further one."""
STEPS = 40
"""Most steps, taken or refused."""


@dataclass(frozen=True)
class Model:
    """Objective and limits about a point x (n,)."""

    slope: Array
    """Gradient of the objective (n,)."""
    limits: Array
    """(m,), at most 0 where they are met."""
    slopes: Array
    """Their Jacobian (m, n)."""
    bent: Array
    """Curvature (n, n), positive definite."""
    low: Array
    """Largest fall of each variable (n,), at most 0."""
    high: Array
    """Largest rise (n,)."""

    def step(self, radius: float, moved: Array | float = 0.0) -> tuple[Array, float] | None:
        """The best step (n,) and the objective's change by it, with limits wider by `moved` (m,);
        None where no step meets them.
        """
        near = self.limits + np.abs(self.slopes).sum(axis=1) * radius > 0.0
        room = (np.maximum(-self.limits, 0.0) + moved)[near]
        size = len(self.slope)
        solver = ca.conic(
            "step",
            "daqp",
            {"h": ca.Sparsity.dense(size, size), "a": ca.Sparsity.dense(len(room), size)},
            {"error_on_fail": False},
        )
        found = solver(
            h=self.bent, g=self.slope, a=self.slopes[near], lba=-np.inf, uba=room,
            lbx=np.maximum(self.low, -radius), ubx=np.minimum(self.high, radius),
        )  # fmt: skip
        step = np.array(found["x"]).ravel()
        return (step, float(found["cost"])) if solver.stats()["success"] else None


def descend(
    x: Array,
    model: Callable[[Array], Model],
    limits: Callable[[Array], Array],
    merit: Callable[[Array, Array], float],
) -> tuple[Array, int]:
    """From x (n,), where `merit(x, limits(x))` is to become small: x in the end, and the steps."""
    here = model(x)
    now, radius, count = merit(x, here.limits), RADIUS, 0
    while radius > LEAST and count < STEPS:
        count += 1
        found = here.step(radius)
        if found is None:
            radius *= 0.5
            continue
        step = np.clip(found[0], here.low, here.high)
        then = merit(x + step, limits(x + step))
        if not then < now:
            radius = 0.5 * min(radius, float(np.abs(step).max()))
            continue
        x, now, radius = x + step, then, 2.0 * radius
        here = model(x)
    return x, count


def descended(count: int) -> str:
    """How the descent along the limits ended, in words."""
    why = f"no change of the gains by more than {100 * LEAST:g} % makes it less"
    if count >= STEPS:
        why = f"{STEPS} steps were taken"
    return f"stopped at the best gains that meet the limits, downhill along them: {why}"
