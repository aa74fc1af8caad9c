"""Which steps the closed loop can take: judged before it runs.

Two limits. Stability: at rest in contact at the reference force, the step's own Jacobian must have
no eigenvalue outside the unit circle. Accuracy: the touch must be resolved. With the touch's speed
v (twice law.touch_speed, for the arm lags), the reference depth d_ref and the depth of the impact
d_hit, the force changes within

    tau = max(d_ref, min(d_hit, STOP v / rate)) / v,    d_hit = (5/4 m v^2 / K_c)^(2/5),

m the arm's inertia along the normal (Johnson, "Contact Mechanics", 11.4), rate that of the law's
velocity gain. Steps up to TOUCH tau keep the force within ERROR of its peak of CVODES' solution
(tests/hard/test_motion_stability.py measures it).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ..errors import SimulationError
from ..se3 import Array
from . import law as compliance
from .loop import Loop, Parameters

if TYPE_CHECKING:
    from .machine import Machine

ERROR = 0.2
"""Largest error of the force, part of its peak or of the reference, whichever is larger."""
TOUCH = {"semi_implicit": 0.2, "linearly_implicit": 0.2, "rk4": 0.5, "cvodes": math.inf}
"""Largest step over the time of the touch tau, by integrator."""
STOP = 0.3
"""Way that the law takes to stop, over v / rate: 1 - log 2."""
GROWTH = 1e-4
"""Largest excess of an eigenvalue over 1: the rounding of differences."""
LONGEST = 0.01
"""Longest step that is offered, s."""


@dataclass(frozen=True)
class StepLimit:
    """Longest steps, s."""

    stable: float
    accurate: float

    @property
    def longest(self) -> float:
        """The shorter of the two."""
        return min(self.stable, self.accurate)


def check(machine: Machine, q: Array, reference: Array) -> None:
    """Refuse a step that is too long, and name one that works.

    q: configuration at rest in contact at the reference depth, on the machine's first face;
    reference (18,): the row of the path there. Raises SimulationError.
    """
    loop = machine.loop
    curvature = machine.curvature
    speed = 2.0 * compliance.touch_speed(loop.law, reference_depth(loop, curvature))
    speed = min(speed, loop.law.approach_speed)
    accurate = touch_limit(loop, inertia(loop, q), curvature, speed)
    stable = spectral_radius(machine, q, reference, loop.dt) <= 1 + GROWTH
    if loop.dt <= accurate and stable:
        return
    if loop.delay and not stable:
        raise SimulationError(
            f"the closed loop is unstable with readings {loop.delay} steps old",
            value=f"law.gamma = {loop.law.gamma:g} 1/s",
            remedy="lower law.gamma, or loop.delay_ms",
        )
    limit = StepLimit(stable_limit(machine, q, reference, min(accurate, LONGEST)), accurate)
    works = _rounded(limit.longest)
    why = "resolve the touch" if loop.dt > accurate else "be stable"
    raise SimulationError(
        f"the step of {loop.integrator} is too long to {why}",
        value=f"loop.dt_ms = {1e3 * loop.dt:g}",
        limit=f"{1e3 * limit.longest:.3g} ms",
        remedy=f"set loop.dt_ms = {1e3 * works:g}, lower law.approach_speed or loop gains, "
        "or take another loop.integrator",
    )


def reference_depth(loop: Loop, curvature: Array) -> float:
    """Depth of the contact under the reference force, m, at principal curvatures (2,), 1/m."""
    patch = loop.contact.patches(
        force=loop.law.force_reference,
        curvature=curvature,
        indenter_radius=loop.indenter_radius,
        effective_modulus=loop.effective_modulus,
    )
    return float(patch.depth)


def touch_limit(loop: Loop, mass: float, curvature: Array, v: float) -> float:
    """Longest step that resolves a touch at the speed v (m/s), s.

    mass: along the normal, kg; curvature (2,): of the body, 1/m.
    """
    p, wanted = loop.parameters, reference_depth(loop, curvature)
    stiffness = loop.law.force_reference / wanted**1.5
    hit = (1.25 * mass * v * v / stiffness) ** 0.4
    rate = p.rate if loop.law.shape == "inertia" else p.rate / mass
    stop = STOP * v / rate if loop.law.torque != "off" else math.inf
    if loop.mode == "quasi_static":
        hit = 0.0
    part = TOUCH[loop.integrator if loop.mode == "arm" else "semi_implicit"]
    return part * max(wanted, min(hit, stop)) / v


def inertia(loop: Loop, q: Array) -> float:
    """Mass of the arm along the vertical at the body's origin, kg; 0 without an arm."""
    if loop.mode == "quasi_static":
        return 0.0
    angles = ca.SX.sym("q", loop.joints)
    mass = ca.Function("mass", [angles], [loop.arm.dynamics().mass_matrix(angles)])(q).full()
    row = loop.arm.jacobian(q)[2]
    return float(1.0 / (row @ np.linalg.solve(mass, row)))


def spectral_radius(machine: Machine, q: Array, reference: Array, dt: float) -> float:
    """Largest modulus of an eigenvalue of the step at rest in contact; 0 for CVODES."""
    loop = machine.loop
    if loop.integrator == "cvodes" and loop.mode == "arm":
        return 0.0
    state, anchor = machine.at_start(q)
    size = len(state) - 2
    p: Parameters = replace(loop.parameters, dt=dt)
    depth = reference_depth(loop, machine.curvature)
    steps = np.full(size, 1e-6)
    steps[: len(q)] = 1e-3 * depth  # small against the depth: the force is not linear in it
    moved = np.concatenate([np.diag(steps), -np.diag(steps)])
    states = np.concatenate([state[:size] + moved, np.tile(state[size:], (2 * size, 1))], axis=1)
    after = machine.function(states.T, reference, anchor, p.values)[0].full()[:size]
    jacobian = (after[:, :size] - after[:, size:]) / (2.0 * steps)
    return float(np.abs(np.linalg.eigvals(jacobian)).max())


def stable_limit(machine: Machine, q: Array, reference: Array, most: float) -> float:
    """Longest stable step up to `most`, s, to 5 %; raises SimulationError where none is."""

    def stable(dt: float) -> bool:
        return spectral_radius(machine, q, reference, dt) <= 1 + GROWTH

    if stable(most):
        return most
    low, high = most / 2, most
    while not stable(low):
        low, high = low / 2, low
        if low < 1e-7:
            raise SimulationError(
                "the closed loop is unstable at every step",
                value=f"law.gamma = {machine.loop.law.gamma:g} 1/s",
                remedy="lower law.gamma, or raise law.rate",
            )
    while high / low > 1.05:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def _rounded(dt: float) -> float:
    """A step with two digits, a little shorter than `dt`."""
    digits = 1 - math.floor(math.log10(0.95 * dt))
    return math.floor(0.95 * dt * 10**digits) / 10**digits
