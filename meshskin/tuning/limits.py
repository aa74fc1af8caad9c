"""Objective and limits of a manoeuvre as expressions of the gains.

Each limit holds at every step. The solver gets the largest value in windows of WINDOW steps, so
that a handful of constraints stand for thousands; multipliers are computed from all steps, as the
largest of several values has a one-sided slope only. Between steps, values are interpolated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from ..core.errors import ConfigError
from ..simulation.stability import STEP_PER_TOUCH_TIME
from .gains import Demands, Gains
from .shooting import SingleShooting

OBJECTIVES = ("time", "force_error", "settling")
WINDOW = 20
"""Steps whose largest value is one constraint: some tens of constraints a limit."""
OVERSHOOT_SCALE, MIN_OVERSHOOT = 0.01, 1e-5
"""Scale of the overshoot, so that its tolerance is a hundredth of that of other forces; and the
bound that stands for no overshoot: the objective is flat towards 0, a solver would not reach it."""
SAFE_DEPTH = 0.97
"""Part of the reference depth with which the step's limit is computed: a margin for the curvature,
which varies along the slide."""
FOREVER = 1e3
"""Rest of a manoeuvre that is judged by its touch alone, s."""


@dataclass(frozen=True)
class Limit:
    """A quantity (k,) that must not exceed its bound."""

    name: str
    quantity: ca.MX
    """(k,): one value a step, or a few values."""
    bound: float
    scale: float
    """Unit of the constraint's tolerance."""
    unit: str

    @property
    def relaxation(self) -> float:
        """Change of the bound by a slack of 1, and the unit of multipliers: the scale, or 1 for a
        quantity without a unit."""
        return self.scale if self.unit else 1.0

    @property
    def excess(self) -> ca.MX:
        """(quantity - bound) / scale (k,)."""
        return (self.quantity - self.bound) / self.scale

    @property
    def peaks(self) -> ca.MX:
        """The largest excess in each window; a quantity of a few values is returned as it is."""
        count = self.quantity.shape[0] // WINDOW
        excess = self.excess
        if not count:
            return excess
        return ca.vertcat(*(ca.mmax(excess[k * WINDOW : (k + 1) * WINDOW]) for k in range(count)))


@dataclass(frozen=True)
class Objective:
    """What is minimized in one scenario."""

    value: ca.MX
    residuals: ca.MX = field(default_factory=ca.MX)
    """(k,), where `value` is their weighted RMS; else empty."""
    weights: ca.MX = field(default_factory=ca.MX)
    """(k,), of sum 1."""

    def curvature(self, x: ca.MX) -> ca.MX:
        """Positive semidefinite part of the second derivative of log `value` by x.

        With value^2 = sum w r^2 it is the Gauss-Newton term J^T W J / value^2, J = dr/dx. Where the
        residuals can vanish it grows as 1 / value^2 and dominates.
        """
        if not self.residuals.numel():
            return ca.MX(x.shape[0], x.shape[0])
        slopes = ca.jacobian(self.residuals, x)
        weighted = slopes * ca.repmat(self.weights, 1, x.shape[0])
        return slopes.T @ weighted / self.value**2


def objective_and_limits(
    shooting: SingleShooting,
    gains: Gains,
    demands: Demands,
    objective: str,
    steps: int,
    force: float,
) -> tuple[Objective, list[Limit]]:
    """The objective of one scenario over `steps` steps, and its limits.

    objective: one of OBJECTIVES; force: that the scene asks for, N.
    """
    touch_only, dt = objective == "settling", shooting.loop.dt
    rolled_gains = replace(gains, settle=FOREVER) if touch_only else gains
    rolled = shooting.roll(ca.vertcat(*rolled_gains.values), steps)
    rows = {name: rolled[s, :] for name, s in shooting.rows().items()}
    contact_force, since = rows["force"].T, rows["since"].T
    slide = shooting.manoeuvre.distance / gains.speed + gains.ramp
    end = (steps - 1) * dt
    duration = end - since[-1] + gains.settle + slide
    overshoot = contact_force / gains.force_reference - 1.0
    error = contact_force / force - 1.0
    ramps = gains.ramp * gains.speed / shooting.manoeuvre.distance
    limits = [
        Limit("overshoot", overshoot, max(demands.overshoot, MIN_OVERSHOOT), OVERSHOOT_SCALE, ""),
        *_force_limits(overshoot, error, since, gains, demands, touch_only, dt),
        *_duration_limits(duration, slide, end, demands, touch_only, dt),
        Limit("ramp", ramps, 0.999, 1.0, ""),  # a slide needs a time between its ramps
        *step_limit(shooting, gains),
        *joint_limits(shooting, rows, demands),
    ]
    if objective == "time":
        return Objective(duration), limits
    if touch_only:
        return Objective(ca.MX(gains.settle)), limits
    t = since - gains.settle
    sliding = _smooth_step(t / dt) * _smooth_step((slide - t) / dt)
    count = ca.sum1(sliding)
    squares = ca.sum1(sliding * error**2) / count
    return Objective(ca.sqrt(squares + 1e-12), error, sliding / count), limits


def _force_limits(
    overshoot: ca.MX, error: ca.MX, since: ca.MX, gains: Gains, demands: Demands,
    touch_only: bool, dt: float,
) -> Iterator[Limit]:  # fmt: skip
    """The force has settled when the rest is over, and is within its bounds from the slide's begin;
    where no slide follows, it stays settled. Before, it is still rising."""
    at = interpolate(overshoot, since, gains.settle, dt)
    yield Limit("settled", ca.vertcat(at, -at), demands.settled, 1.0, "")
    rising = ca.fmin(ca.fmax((gains.settle - since) / (2.0 * dt), 0.0), 1.0)  # 0 from its end on
    if touch_only:
        yield Limit("settled", ca.fabs(overshoot) - rising, demands.settled, 1.0, "")
    else:
        yield Limit("least force", -error - rising, demands.force, 1.0, "")
        yield Limit("largest force", error - rising, demands.force, 1.0, "")


def _duration_limits(
    duration: ca.MX, slide: Any, end: float, demands: Demands, touch_only: bool, dt: float
) -> Iterator[Limit]:
    """The manoeuvre ends before the shooting does, and in the time demanded, with a step to spare:
    the rest is rounded up to whole steps of `dt`."""
    longest = end if demands.time is None else demands.time
    if touch_only:
        yield Limit("length of the shooting", duration - slide, end, end, "s")
        if demands.time is None:
            return
    else:
        longest = min(longest, end)
    rounded = duration if demands.time is None else duration + dt
    yield Limit("time", rounded, longest, longest, "s")


def step_limit(shooting: SingleShooting, gains: Gains) -> Iterator[Limit]:
    """The touch must be resolved by the steps: stability.touch_limit, on its safe side."""
    integrator = shooting.loop.integrator if shooting.joints else "semi_implicit"
    part, scene = STEP_PER_TOUCH_TIME[integrator], shooting.scene
    if not np.isfinite(part):
        return
    depth = ca.MX(float(scene.patch.depth))
    depth *= (gains.force_reference / scene.law.force_reference) ** (2.0 / 3.0)
    speed = ca.fmin(gains.approach_speed, 8.0 / 3.0 * gains.gamma * depth)
    steps = speed * shooting.loop.dt / (SAFE_DEPTH * part * depth)
    yield Limit("step of the loop", steps, 1.0, 1.0, "")


def joint_limits(
    shooting: SingleShooting, rows: dict[str, ca.MX], demands: Demands
) -> Iterator[Limit]:
    """Torque, speed and position of every joint that has such a limit."""
    arm = shooting.arm
    for j, name in enumerate(arm.joint_names[: shooting.joints]):
        for kind, key, limit, part, unit in (
            ("torque", "torque", float(arm.effort_limit[j]), demands.torque, "N m"),
            ("speed", "qdot", float(arm.velocity_limit[j]), demands.velocity, "rad/s"),
        ):
            if np.isfinite(limit):
                size = ca.fabs(rows[key][j, :].T)
                yield Limit(f"{kind} of {name}", size, part * limit, limit, unit)
        low, high = arm.lower[j] + demands.position, arm.upper[j] - demands.position
        if np.isfinite(low) and np.isfinite(high):
            middle, half = 0.5 * (low + high), float(0.5 * (high - low))
            if half <= 0.0:
                raise ConfigError(
                    f"Demands.position leaves no range for {name}",
                    value=f"{demands.position:g} rad from its ends",
                    limit=f"less than {demands.position + half:.3g} rad",
                    remedy="set a smaller Demands.position",
                )
            distance = ca.fabs(rows["q"][j, :].T - middle)
            yield Limit(f"position of {name}", distance, half, half, "rad")


def interpolate(values: ca.MX, times: ca.MX, at: Any, dt: float) -> ca.MX:
    """`values` (k,) at equidistant `times` (k,), at one time: by cubic convolution.

    Source: Keys, "Cubic convolution interpolation" (IEEE Trans. ASSP 29(6), 1981).
    """
    u = ca.fabs(times - at) / dt
    near, far = 1.0 + u * u * (1.5 * u - 2.5), 2.0 + u * (-4.0 + u * (2.5 - 0.5 * u))
    return ca.sum1(ca.if_else(u < 1.0, near, ca.if_else(u < 2.0, far, 0.0)) * values)


def _smooth_step(t: ca.MX) -> ca.MX:
    """0 before -1/2, 1 after 1/2."""
    return ca.fmin(ca.fmax(t + 0.5, 0.0), 1.0)
