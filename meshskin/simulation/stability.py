"""Which steps the closed loop can take: judged before it runs.

Two limits. Stability: at rest in contact at the reference force, the step's own Jacobian must have
no eigenvalue outside the unit circle. Accuracy: the touch must be resolved. With the touch's speed
v (twice law.touch_speed, for the arm lags), the reference depth d_ref and the depth of the impact
d_hit, the force changes within

    tau = max(d_ref, min(d_hit, STOP v / rate)) / v,    d_hit = (5/4 m v^2 / K_c)^(2/5),

m the arm's inertia along the normal (Johnson, "Contact Mechanics", 11.4), rate that of the law's
velocity gain. Steps up to TOUCH tau keep the force within ERROR of its peak of CVODES' solution
(tests/hard/test_motion_stability.py measures it).

What a run's force is good for is stated apart, by running its touch ahead with the run's step and
with steps an eighth as long. A method of order p errs by 8^p / (8^p - 1) of their difference, at
most 8/7; SAFETY times the difference is stated. For steps within the two limits it bounds the true
error, against CVODES, from E = 10 kPa to 200 GPa, from 10 us to 10 ms, to 0.5 m/s of impact; far
longer ones may leap over the touch. Source: Richardson's extrapolation; Hairer, Norsett, Wanner,
"Solving Ordinary Differential Equations I" (1993), II.4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ..core.content_cache import cached_by_content
from ..core.errors import SimulationError
from ..core.se3 import Array, hat
from . import law as compliance
from .closed_loop_model import ClosedLoopModel, Parameters
from .step import Blocks, step

if TYPE_CHECKING:
    from ..robot.arm import Arm
    from .simulator import Simulator

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
FINER, SAFETY = 8, 2.0
"""Steps of the finer run a step; stated error over the runs' difference."""
LEAST = 1e-5
"""Least stated error: what the reference itself is good for where contact begins."""
RESPONSES = 8
"""Response times of the law in which a disturbance of it has died away."""
AHEAD = 64
"""Steps of a block of the run ahead."""


@dataclass(frozen=True)
class StepLimit:
    """Longest steps, s."""

    stable: float
    accurate: float

    @property
    def longest(self) -> float:
        """The shorter of the two."""
        return min(self.stable, self.accurate)


def check(machine: Simulator, q: Array, reference: Array) -> None:
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


def reference_depth(loop: ClosedLoopModel, curvature: Array) -> float:
    """Depth of the contact under the reference force, m, at principal curvatures (2,), 1/m."""
    patch = loop.contact.patches(
        force=loop.law.force_reference,
        curvature=curvature,
        indenter_radius=loop.indenter_radius,
        effective_modulus=loop.effective_modulus,
    )
    return float(patch.depth)


def touch_limit(loop: ClosedLoopModel, mass: float, curvature: Array, v: float) -> float:
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


def inertia(loop: ClosedLoopModel, q: Array) -> float:
    """Mass of the arm along the indenter at the body's origin, kg; 0 without an arm."""
    if loop.mode == "quasi_static":
        return 0.0
    mass = _mass_matrix(loop.arm)(q).full()
    row = loop.indenter_direction @ loop.arm.jacobian(q)[:3]
    return float(1.0 / (row @ np.linalg.solve(mass, row)))


@cached_by_content
def _mass_matrix(arm: Arm) -> ca.Function:
    q = ca.SX.sym("q", len(arm.joint_names))
    return ca.Function("mass", [q], [arm.dynamics().mass_matrix(q)])


def touch_error(machine: Simulator, q: Array, reference: Array, parts: int = 1) -> float:
    """Stated error of the force at the touch, part of its peak, with a `parts`-th of the loop's dt.

    The touch as the machine makes it: from rest in the air, until the force has settled.
    """
    loop, law = machine.loop, machine.loop.law
    depth, most = reference_depth(loop, machine.curvature), law.approach_speed
    slow, lag = compliance.touch_speed(law, depth), RESPONSES * (1.0 / law.rate + 1.0 / law.gamma)
    gap = min(max(_gap(machine), 0.0), lag * most)  # higher up the approach is at rest in itself
    seconds = gap / most + math.log(most / slow) / law.gamma + lag
    count = round(seconds / loop.dt * parts)
    return stated_error(machine, _above(machine, q, depth + gap), reference, count, parts)


def stated_error(
    machine: Simulator, state: Array, reference: Array, count: int, parts: int = 1
) -> float:
    """Stated error of the force, part of its peak, over `count` steps of dt / parts from a state.

    state: in the air, or without a delay; reference (18,): a row of a path that rests there.
    Infinite where a number is not finite; 0 for CVODES, which is the reference.
    """
    if machine.loop.integrator == "cvodes" and machine.loop.joints:
        return 0.0
    mine = forces_ahead(machine, state, reference, count, parts)
    finer = forces_ahead(machine, state, reference, FINER * count, FINER * parts)[::FINER]
    if not (np.isfinite(mine).all() and np.isfinite(finer).all()):
        return math.inf
    peak = max(finer.max(), machine.loop.law.force_reference)
    return max(float(SAFETY * np.abs(mine - finer).max() / peak), LEAST)


def forces_ahead(
    machine: Simulator, state: Array, reference: Array, count: int, parts: int = 1
) -> Array:
    """Contact forces (count,), N, with steps of dt / parts on the machine's first face."""
    loop, function = machine.loop, machine.function
    if loop.delay and parts > 1:  # as old as they were, in more steps
        state = _padded(loop, state, parts)
        loop = replace(loop, delay=loop.delay * parts)
        function = step(loop)
    blocks = Blocks(loop, AHEAD, function)
    blocks.parameters[0] = loop.dt / parts
    blocks.references[:] = reference
    blocks.anchors[:] = machine.at_start(state[: machine.size])[1]
    blocks.state[:] = state
    found = np.empty((math.ceil(count / AHEAD), AHEAD))
    for forces in found:
        blocks.run()
        forces[:] = blocks.outputs[:, loop.outputs["force"].start]
        blocks.state[:] = blocks.states[-1]
    return found.ravel()[:count]


def spectral_radius(machine: Simulator, q: Array, reference: Array, dt: float) -> float:
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


def stable_limit(machine: Simulator, q: Array, reference: Array, most: float) -> float:
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


def _gap(machine: Simulator) -> float:
    """Gap between body and indenter at the machine's start, m."""
    state, anchor = machine.at_start(machine.start)
    row = np.zeros(machine.function.size1_in(1))
    output = machine.function(state, row, anchor, machine.loop.parameters.values)[1]
    return -float(output[machine.loop.outputs["depth"].start])


def _above(machine: Simulator, q: Array, lift: float) -> Array:
    """State at rest with the body lifted off the indenter by `lift` (m) from configuration q."""
    loop, (state, _) = machine.loop, machine.at_start(q)
    up = lift * loop.indenter_direction
    if not loop.joints:
        state[:3] += up
    else:
        tip = loop.arm.pose(q)
        jacobian = loop.arm.jacobian(q)
        jacobian[:3] -= hat((tip @ loop.mount)[:3, 3] - tip[:3, 3]) @ jacobian[3:]
        state[: len(q)] += np.linalg.pinv(jacobian, rcond=1e-6)[:, :3] @ up
    if loop.delay:  # readings of the gap so far
        depth = reference_depth(loop, machine.curvature) - lift
        state[-2 - loop.memory : -2] = np.tile([depth, 0.0], loop.delay)
    return state


def _padded(loop: ClosedLoopModel, state: Array, parts: int) -> Array:
    """A state for `parts` times as many readings on their way, each of them for as many steps."""
    readings = state[-2 - loop.memory : -2].reshape(-1, 2).repeat(parts, axis=0)
    return np.concatenate([state[: -2 - loop.memory], readings.ravel(), state[-2:]])
