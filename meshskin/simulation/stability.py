"""Limits of the closed loop's step, checked before it runs, and the force's error at the touch.

Stability: at rest in contact at the reference force, no eigenvalue of the step's Jacobian may lie
outside the unit circle. Accuracy: the touch must be resolved. With the touch's speed v (twice
law.touch_speed, as the arm lags), the reference depth d_ref and the depth of the impact d_hit, the
force changes within the touch time

    tau = max(d_ref, min(d_hit, d_stop)) / v,    d_hit = (5/4 m v^2 / K_c)^(2/5),

d_stop = STOPPING_DISTANCE v / rate, m the arm's inertia along the normal (Johnson, "Contact
Mechanics", 11.4), rate that of the law's velocity gain. Steps up to STEP_PER_TOUCH_TIME tau keep
the force within MAX_FORCE_ERROR of its peak in CVODES' solution
(tests/hard/test_motion_stability.py measures it).

The error of a run's force is estimated separately: its touch is predicted with the run's step and
with steps an eighth as long. A method of order p errs by 8^p / (8^p - 1) of their difference, at
most 8/7; SAFETY times the difference is stated. For steps within the two limits it bounds the true
error, against CVODES, from E = 10 kPa to 200 GPa, from 10 us to 10 ms, up to 0.5 m/s of impact;
far longer steps may jump over the touch. Source: Richardson's extrapolation; Hairer, Norsett,
Wanner, "Solving Ordinary Differential Equations I" (1993), II.4.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ..core.arrays import Array
from ..core.content_cache import cached_by_content
from ..core.errors import SimulationError
from ..core.se3 import hat
from . import law as compliance
from .closed_loop_model import ClosedLoopModel
from .rollout import StepBlock

if TYPE_CHECKING:
    from ..robot.arm import Arm
    from .simulator import Simulator

MAX_FORCE_ERROR = 0.2
"""Largest error of the force, relative to its peak or to the reference, whichever is larger, at the
longest accurate step."""
STEP_PER_TOUCH_TIME = {
    "semi_implicit": 0.2,
    "linearly_implicit": 0.2,
    "rk4": 0.5,
    "cvodes": math.inf,
}
"""Longest accurate step over the touch time, by integrator: the largest round numbers that keep
MAX_FORCE_ERROR over the grid of tests/hard/test_motion_stability.py."""
STOPPING_DISTANCE = 0.3
"""Distance in which the law's velocity control takes up an impact, over v / rate: 1 - log 2."""
EIGENVALUE_TOLERANCE = 1e-4
"""Largest excess of an eigenvalue's modulus over 1: rounding of the difference quotients."""
MAX_STEP = 0.01
"""Longest step that is suggested, s: ten times the default step."""
REFINEMENT, SAFETY = 8, 2.0
"""Steps of the finer prediction per step; stated error over the difference of the predictions."""
ERROR_FLOOR = 1e-5
"""Least stated error: CVODES' own where contact begins and the force is not smooth."""
SETTLING_TIMES = 8
"""Response times of the law after which a disturbance has died away: exp(-8) = 3e-4."""
BLOCK_LENGTH = 64
"""Steps of a block of the predictions."""


def check_step(simulator: Simulator, q: Array, reference: Array) -> None:
    """Raise SimulationError for a step that is too long, and name one that works.

    q (n,): configuration at rest in contact at the reference depth, on the simulator's first face;
    reference (18,): the row of the path there.
    """
    loop = simulator.loop
    curvature = simulator.curvature
    speed = 2.0 * compliance.touch_speed(loop.law, reference_depth(loop, curvature))
    speed = min(speed, loop.law.approach_speed)
    accurate = touch_limit(loop, inertia(loop, q), curvature, speed)
    stable = is_stable(simulator, q, reference, loop.dt)
    if loop.dt <= accurate and stable:
        return
    if loop.delay and not stable:
        raise SimulationError(
            f"the closed loop is unstable with readings {loop.delay} steps old",
            value=f"law.gamma = {loop.law.gamma:g} 1/s",
            remedy="lower law.gamma, or loop.delay_ms",
        )
    longest = min(stable_limit(simulator, q, reference, min(accurate, MAX_STEP)), accurate)
    purpose = "resolve the touch" if loop.dt > accurate else "be stable"
    raise SimulationError(
        f"the step of {loop.integrator} is too long to {purpose}",
        value=f"loop.dt_ms = {1e3 * loop.dt:g}",
        limit=f"{1e3 * longest:.3g} ms",
        remedy=f"set loop.dt_ms = {1e3 * _rounded(longest):g}, lower law.approach_speed or loop "
        "gains, or use another loop.integrator",
    )


def reference_depth(loop: ClosedLoopModel, curvature: Array) -> float:
    """Depth of the contact at the reference force, m, at principal curvatures (2,), 1/m."""
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
    parameters, depth = loop.parameters, reference_depth(loop, curvature)
    stiffness = loop.law.force_reference / depth**1.5
    impact = (1.25 * mass * v * v / stiffness) ** 0.4
    rate = parameters.rate if loop.law.shape == "inertia" else parameters.rate / mass
    stop = STOPPING_DISTANCE * v / rate if loop.law.torque != "off" else math.inf
    if loop.mode == "quasi_static":
        impact = 0.0
    part = STEP_PER_TOUCH_TIME[loop.integrator if loop.mode == "arm" else "semi_implicit"]
    return part * max(depth, min(impact, stop)) / v


def inertia(loop: ClosedLoopModel, q: Array) -> float:
    """Effective mass of the arm along the indenter at the tip's origin, kg; 0 without an arm."""
    if loop.mode == "quasi_static":
        return 0.0
    mass = _mass_matrix(loop.arm)(q).full()
    row = loop.indenter_direction @ loop.arm.jacobian(q)[:3]
    return float(1.0 / (row @ np.linalg.solve(mass, row)))


@cached_by_content
def _mass_matrix(arm: Arm) -> ca.Function:
    q = ca.SX.sym("q", len(arm.joint_names))
    return ca.Function("mass", [q], [arm.dynamics().mass_matrix(q)])


def touch_error(simulator: Simulator, q: Array, reference: Array) -> float:
    """Estimated error of the force at the touch, relative to its peak.

    The touch is that of the simulator: from rest in the air, until the force has settled.
    """
    loop, law = simulator.loop, simulator.loop.law
    depth, speed = reference_depth(loop, simulator.curvature), law.approach_speed
    slow = compliance.touch_speed(law, depth)
    lag = SETTLING_TIMES * (1.0 / law.rate + 1.0 / law.gamma)
    start = simulator.output(*simulator.rest_state(simulator.start))
    gap = max(-float(start[loop.outputs["depth"].start]), 0.0)
    gap = min(gap, lag * speed)  # higher up the approach is steady
    seconds = gap / speed + math.log(speed / slow) / law.gamma + lag
    state = _lifted_state(simulator, q, depth + gap)
    return estimate_error(simulator, state, reference, round(seconds / loop.dt))


def estimate_error(simulator: Simulator, state: Array, reference: Array, count: int) -> float:
    """Estimated error of the force, relative to its peak, over `count` steps.

    state: of the start, without contact, or of a loop without a delay; reference (18,): a row of a
    path at rest. Infinite where a number is not finite; 0 for CVODES, which is the reference.
    """
    if simulator.loop.integrator == "cvodes" and simulator.loop.joints:
        return 0.0
    coarse = predict_forces(simulator, state, reference, count)
    fine = predict_forces(simulator, state, reference, REFINEMENT * count, REFINEMENT)[::REFINEMENT]
    if not (np.isfinite(coarse).all() and np.isfinite(fine).all()):
        return math.inf
    peak = max(fine.max(), simulator.loop.law.force_reference)
    return max(float(SAFETY * np.abs(coarse - fine).max() / peak), ERROR_FLOOR)


def predict_forces(
    simulator: Simulator, state: Array, reference: Array, count: int, parts: int = 1
) -> Array:
    """Contact forces (count,), N, with steps of dt / parts on the simulator's first face."""
    loop = simulator.loop
    if loop.delay and parts > 1:  # the same delay in more steps: each measurement lasts for `parts`
        end = -2 - loop.memory
        readings = state[end:-2].reshape(-1, 2).repeat(parts, axis=0)
        state = np.concatenate([state[:end], readings.ravel(), state[-2:]])
        loop = replace(loop, delay=loop.delay * parts)
    block = StepBlock(loop, BLOCK_LENGTH)
    block.parameters[:, 0] = loop.dt / parts
    block.references[:] = reference
    block.anchors[:] = simulator.rest_state(state[: simulator.size])[1]
    block.state[:] = state
    found = np.empty((math.ceil(count / BLOCK_LENGTH), BLOCK_LENGTH))
    for forces in found:
        block.run()
        forces[:] = block.outputs[:, loop.outputs["force"].start]
        block.state[:] = block.states[-1]
    return found.ravel()[:count]


def spectral_radius(simulator: Simulator, q: Array, reference: Array, dt: float) -> float:
    """Largest modulus of an eigenvalue of the step at rest in contact; 0 for CVODES.

    The Jacobian is by central differences: of order 2 in steps small against the depth, on which
    the force depends nonlinearly.
    """
    loop = simulator.loop
    if loop.integrator == "cvodes" and loop.mode == "arm":
        return 0.0
    state, anchor = simulator.rest_state(q)
    size = len(state) - 2
    steps = np.full(size, 1e-6)
    steps[: len(q)] = 1e-3 * reference_depth(loop, simulator.curvature)
    moved = np.concatenate([np.diag(steps), -np.diag(steps)])
    states = np.concatenate([state[:size] + moved, np.tile(state[size:], (2 * size, 1))], axis=1)
    values = replace(loop.parameters, dt=dt).values
    after = simulator.function(states.T, reference, anchor, values)[0].full()[:size]
    jacobian = (after[:, :size] - after[:, size:]) / (2.0 * steps)
    return float(np.abs(np.linalg.eigvals(jacobian)).max())


def is_stable(simulator: Simulator, q: Array, reference: Array, dt: float) -> bool:
    """Whether the step `dt`, s, is stable at rest in contact."""
    return spectral_radius(simulator, q, reference, dt) <= 1 + EIGENVALUE_TOLERANCE


def stable_limit(simulator: Simulator, q: Array, reference: Array, longest: float) -> float:
    """Longest stable step up to `longest`, s, to 5 %; raises SimulationError where none is."""
    if is_stable(simulator, q, reference, longest):
        return longest
    low, high = longest / 2, longest
    while not is_stable(simulator, q, reference, low):
        low, high = low / 2, low
        if low < 1e-7:
            raise SimulationError(
                "the closed loop is unstable at every step",
                value=f"law.gamma = {simulator.loop.law.gamma:g} 1/s",
                remedy="lower law.gamma, or raise law.rate",
            )
    while high / low > 1.05:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_stable(simulator, q, reference, middle) else (low, middle)
    return low


def _rounded(dt: float) -> float:
    """A step with two digits, at least 5 % shorter than `dt`."""
    digits = 1 - math.floor(math.log10(0.95 * dt))
    return math.floor(0.95 * dt * 10**digits) / 10**digits


def _lifted_state(simulator: Simulator, q: Array, lift: float) -> Array:
    """State at rest with the body lifted off the indenter by `lift` (m) from configuration q."""
    loop, (state, _) = simulator.loop, simulator.rest_state(q)
    up = lift * loop.indenter_direction
    if not loop.joints:
        state[:3] += up
    else:
        tip = loop.arm.pose(q)
        jacobian = loop.arm.jacobian(q)
        jacobian[:3] -= hat((tip @ loop.mount)[:3, 3] - tip[:3, 3]) @ jacobian[3:]
        state[: len(q)] += np.linalg.pinv(jacobian, rcond=1e-6)[:, :3] @ up
    if loop.delay:  # the delayed measurements are those of the gap
        depth = reference_depth(loop, simulator.curvature) - lift
        state[-2 - loop.memory : -2] = np.tile([depth, 0.0], loop.delay)
    return state
