"""Downhill along the limits: sequential quadratic programming that keeps every limit it meets.

The torque of a touch depends on where between two steps it falls, so that limits are saw-toothed
over the gains. A search that may break limits on its way leaves its tooth by the first step and
does not come back; this one goes on from a point that meets them, within a region of trust:

    min  f' d + d' H d / 2    subject to  g + g' d <= max(g, 0),  |d| <= radius,  low <= x + d

Source: Nocedal, Wright, "Numerical Optimization" (2006), section 18.5, with the merit of the search
in place of a penalty.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from ..se3 import Array

RADIUS, LEAST = 0.05, 1e-4
"""Largest change of a variable in the first step, and below which there is no further one."""
STEPS = 40
"""Most steps, taken or refused."""

Model = Callable[[Array], tuple[Array, Array, Array]]
"""x -> gradient of the objective (n,), Jacobian of the limits (m, n), curvature (n, n)."""


def descend(
    x: Array,
    limits: Callable[[Array], Array],
    model: Model,
    merit: Callable[[Array, Array], float],
    low: Array,
    high: Array,
) -> tuple[Array, Array, int]:
    """From x (n,), where `merit(x, limits(x))` is to become small: x, its limits, and the steps."""
    g = limits(x)
    now, radius, count = merit(x, g), RADIUS, 0
    slope, slopes, bent = model(x)
    solver = ca.conic(
        "step",
        "daqp",
        {"h": ca.Sparsity.dense(*bent.shape), "a": ca.Sparsity.dense(*slopes.shape)},
        {"error_on_fail": False},
    )
    while radius > LEAST and count < STEPS:
        count += 1
        found = solver(
            h=bent, g=slope, a=slopes, lba=-np.inf, uba=np.maximum(-g, 0.0),
            lbx=np.maximum(low - x, -radius), ubx=np.minimum(high - x, radius),
        )  # fmt: skip
        step = np.array(found["x"]).ravel()
        tried = np.clip(x + step, low, high)
        there = limits(tried)
        then = merit(tried, there)
        if not (solver.stats()["success"] and then < now):
            radius = 0.5 * min(radius, float(np.abs(step).max()))
            continue
        x, g, now, radius = tried, there, then, 2.0 * radius
        slope, slopes, bent = model(x)
    return x, g, count
