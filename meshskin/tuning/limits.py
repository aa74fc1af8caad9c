"""The limits of a manoeuvre as expressions of the gains, and what is to become small.

Each limit holds at every step. For the solver it is the largest in windows of WINDOW steps, so that
a handful of constraints stand for thousands; what a limit costs is judged by all of them, as the
largest of several has a slope to one side only. Between steps, values are interpolated.
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
from .shooting import ShootingInterval

OBJECTIVES = ("time", "force_error", "settling")
WINDOW = 20
"""Steps whose largest value is one constraint."""
FINE, LEAST = 0.01, 1e-5
"""Scale of the overshoot, that it is kept to a hundredth of what other forces are, and the one that
stands for none: the way to none at all is flat, a solver would not find it."""
SAFE = 0.97
"""Part of the touch's depth on which its step is judged."""
FOREVER = 1e3
"""Rest of a manoeuvre that is judged by its touch alone, s."""


@dataclass(frozen=True)
class Limit:
    """A quantity (k,) that must not exceed its bound."""

    name: str
    quantity: ca.MX
    """(k,), of every step or of none in particular."""
    bound: float
    scale: float
    """In which it is kept to."""
    unit: str

    @property
    def whole(self) -> float:
        """What a slack of 1 adds to the bound, and what multipliers are told for: its scale, or 1
        where it has no unit."""
        return self.scale if self.unit else 1.0

    @property
    def excess(self) -> ca.MX:
        """(k,) above the bound, in the scale."""
        return (self.quantity - self.bound) / self.scale

    @property
    def peaks(self) -> ca.MX:
        """The largest of `excess` in each window; where there are no steps, itself."""
        return self.excess if self.quantity.shape[0] < WINDOW else windows(self.excess)


@dataclass(frozen=True)
class Aim:
    """What is to become small in one scenario."""

    value: ca.MX
    residuals: ca.MX = field(default_factory=ca.MX)
    """What `value` is the weighted RMS of (k,); empty where it is no such thing."""
    weights: ca.MX = field(default_factory=ca.MX)
    """Theirs (k,), of sum 1."""

    def curvature(self, x: ca.MX) -> ca.MX:
        """Second derivative of log `value` by x, without the part that is not positive.

        With value^2 = sum w r^2 it is J^T W J / value^2, J = dr/dx, as of Gauss and Newton. Where
        the residuals can be made to vanish it is as large as 1 / value^2, and all that counts.
        """
        if not self.residuals.numel():
            return ca.MX(x.shape[0], x.shape[0])
        slopes = ca.jacobian(self.residuals, x)
        scaled = slopes * ca.repmat(self.weights, 1, x.shape[0])
        return slopes.T @ scaled / self.value**2


class Judge:
    """Objective and limits of a manoeuvre `steps` steps long; target: the force asked for, N."""

    def __init__(self, demands: Demands, objective: str, steps: int, target: float) -> None:
        self.demands, self.objective = demands, objective
        self.steps, self.target = steps, target

    def __call__(self, shot: ShootingInterval, gains: Gains) -> tuple[Aim, list[Limit]]:
        """The objective of one scenario, and its limits."""
        still = self.objective == "settling"
        lived = replace(gains, settle=FOREVER) if still else gains
        rolled = shot.roll(ca.vertcat(*lived.values), self.steps)
        row = {name: rolled[s, :] for name, s in shot.rows().items()}
        force, since, dt = row["force"].T, row["since"].T, shot.loop.dt
        slide = shot.manoeuvre.distance / gains.speed + gains.ramp
        end = (self.steps - 1) * dt
        duration = end - since[-1] + gains.settle + slide
        error = force / gains.force_reference - 1.0
        found = [
            Limit("overshoot", error, max(self.demands.overshoot, LEAST), FINE, ""),
            *self._settled(error, since, gains, still, dt),
            *self._slid(force, since, gains, lived, dt),
            *self._length(duration, slide, end, still),
            Limit("ramp", gains.ramp * gains.speed / shot.manoeuvre.distance, 0.999, 1.0, ""),
            *step_limit(shot, gains),
            *joint_limits(shot, row, self.demands),
        ]
        if self.objective == "time":
            return Aim(duration), found
        if still:
            return Aim(ca.MX(gains.settle)), found
        t = since - gains.settle
        sliding = _step(t / dt) * _step((slide - t) / dt)
        apart, whole = force / self.target - 1.0, ca.sum1(sliding)
        squares = ca.sum1(sliding * apart**2) / whole
        return Aim(ca.sqrt(squares + 1e-12), apart, sliding / whole), found

    def _settled(
        self, error: ca.MX, since: ca.MX, gains: Gains, still: bool, dt: float
    ) -> Iterator[Limit]:
        """The force is there when the rest is over; where nothing follows it, it stays there."""
        at, within = interpolated(error, since, gains.settle, dt), self.demands.settled
        yield Limit("settled", ca.vertcat(at, -at), within, 1.0, "")
        if still:
            after = ca.fabs(error) - _before(since, gains.settle, dt)
            yield Limit("settled", after, within, 1.0, "")

    def _slid(
        self, force: ca.MX, since: ca.MX, gains: Gains, lived: Gains, dt: float
    ) -> Iterator[Limit]:
        """From the slide's begin the force is within its bounds: before, it is still rising."""
        rising, part = _before(since, lived.settle, dt), self.demands.force
        apart = force / self.target - 1.0
        if lived is gains:
            yield Limit("least force", -apart - rising, part, 1.0, "")
            yield Limit("largest force", apart - rising, part, 1.0, "")

    def _length(self, duration: ca.MX, slide: Any, end: float, still: bool) -> Iterator[Limit]:
        """The manoeuvre ends before the shot does, and in time."""
        asked = self.demands.time
        if still:
            yield Limit("length of the shot", duration - slide, end, end, "s")
            if asked is not None:
                yield Limit("time", duration, asked, asked, "s")
            return
        longest = end if asked is None else min(asked, end)
        yield Limit("time", duration, longest, longest, "s")


def step_limit(shot: ShootingInterval, gains: Gains) -> Iterator[Limit]:
    """The touch must be resolved by the steps: stability.touch_limit, on its safe side."""
    part = STEP_PER_TOUCH_TIME[shot.loop.integrator if shot.joints else "semi_implicit"]
    if not np.isfinite(part):
        return
    depth = ca.MX(float(shot.scene.patch.depth))
    depth *= (gains.force_reference / shot.scene.law.force_reference) ** (2.0 / 3.0)
    speed = ca.fmin(gains.approach_speed, 8.0 / 3.0 * gains.gamma * depth)
    yield Limit("step of the loop", speed * shot.loop.dt / (SAFE * part * depth), 1.0, 1.0, "")


def joint_limits(
    shot: ShootingInterval, row: dict[str, ca.MX], demands: Demands
) -> Iterator[Limit]:
    """Torque, speed and position of every joint that has such a limit."""
    arm = shot.arm
    for j, name in enumerate(arm.joint_names[: shot.joints]):
        for kind, key, limit, share in (
            ("torque", "torque", arm.effort_limit[j], demands.torque),
            ("speed", "qdot", arm.velocity_limit[j], demands.velocity),
        ):
            if np.isfinite(limit):
                unit = "N m" if kind == "torque" else "rad/s"
                size = ca.fabs(row[key][j, :].T)
                yield Limit(f"{kind} of {name}", size, float(share * limit), float(limit), unit)
        low, high = arm.lower[j] + demands.position, arm.upper[j] - demands.position
        if np.isfinite(low) and np.isfinite(high):
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            if half <= 0.0:
                raise ConfigError(
                    f"nothing is left of the range of {name}",
                    value=f"{demands.position:g} rad from its ends",
                    limit=f"less than {demands.position + half:.3g} rad",
                    remedy="ask for a smaller Demands.position",
                )
            away = ca.fabs(row["q"][j, :].T - middle)
            yield Limit(f"position of {name}", away, float(half), float(half), "rad")


def windows(values: ca.MX) -> ca.MX:
    """Largest of `values` (k WINDOW,) in each window (k,)."""
    count = values.shape[0] // WINDOW
    return ca.vertcat(*(ca.mmax(values[k * WINDOW : (k + 1) * WINDOW]) for k in range(count)))


def interpolated(values: ca.MX, times: ca.MX, at: Any, dt: float) -> ca.MX:
    """`values` (k,) at equidistant `times` (k,), at one time: by cubic convolution.

    Source: Keys, "Cubic convolution interpolation" (IEEE Trans. ASSP 29(6), 1981).
    """
    u = ca.fabs(times - at) / dt
    near, far = 1.0 + u * u * (1.5 * u - 2.5), 2.0 + u * (-4.0 + u * (2.5 - 0.5 * u))
    return ca.sum1(ca.if_else(u < 1.0, near, ca.if_else(u < 2.0, far, 0.0)) * values)


def _before(since: ca.MX, at: Any, dt: float) -> ca.MX:
    """1 up to 2 dt before a time after the touch, 0 from it on."""
    return ca.fmin(ca.fmax((at - since) / (2.0 * dt), 0.0), 1.0)


def _step(t: ca.MX) -> ca.MX:
    """0 before -1/2, 1 after 1/2."""
    return ca.fmin(ca.fmax(t + 0.5, 0.0), 1.0)
