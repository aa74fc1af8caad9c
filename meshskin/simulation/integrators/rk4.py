"""The classical Runge-Kutta method of order 4, for soft contact and smooth paths.

Source: Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I" (1993), II.1.
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics
from ..closed_loop_model import ClosedLoopModel
from . import step_function

STAGES = ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0))
"""Time of each stage, in steps, and its weight times 6: a stage starts from the slope of the one
before it."""


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step (state, reference, anchor, parameters) -> (next state, output)."""
    # the foot point must be accurate to the method's order: two Newton steps
    dynamics, n = ClosedLoopDynamics(loop, newton=2), loop.joints
    derivative = dynamics.derivative()
    state, q, qdot, contact_state = dynamics.state()
    h = dynamics.p.dt
    speed, acceleration = qdot, ca.SX.zeros(n)
    mean_speed, mean_acceleration = ca.SX.zeros(n), ca.SX.zeros(n)
    first = None
    for time, weight in STAGES:
        there, speed = q + time * h * speed, qdot + time * h * acceleration
        now = derivative(there, speed, contact_state, time * h, *dynamics.inputs)
        acceleration = now[0]
        mean_speed += weight / 6.0 * speed
        mean_acceleration += weight / 6.0 * acceleration
        first = first or now
    assert first is not None
    after = ca.vertcat(q + h * mean_speed, qdot + h * mean_acceleration, first[1])
    return step_function([state, *dynamics.inputs], after, first[2])
