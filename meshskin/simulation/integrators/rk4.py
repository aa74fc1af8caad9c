"""The classical Runge-Kutta method of order 4, for soft contact and smooth paths.

Source: Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I" (1993), II.1.
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics
from ..closed_loop_model import ClosedLoopModel
from . import NAMES

STAGES = ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0))
"""Time of each stage and its weight; a stage starts from the slope of the one before it."""


def step(loop: ClosedLoopModel) -> ca.Function:
    """See the package."""
    # the foot is needed to the method's order: two Newton steps
    field, n = ClosedLoopDynamics(loop, newton=2), loop.joints
    rate = field.rate()
    inputs = (field.reference, field.anchor, field.parameters)
    state, h = ca.SX.sym("state", 2 * n + loop.memory + 2), field.p.dt
    q, qdot, last = state[:n], state[n : 2 * n], state[2 * n :]
    speed, push, total_q, total_v = qdot, ca.SX.zeros(n), ca.SX.zeros(n), ca.SX.zeros(n)
    starts = []
    for time, weight in STAGES:
        there, speed = q + time * h * speed, qdot + time * h * push
        push, foot, output = rate(there, speed, last, time * h, *inputs)
        total_q += weight / 6.0 * speed
        total_v += weight / 6.0 * push
        starts.append((foot, output))
    foot, output = starts[0]
    return ca.Function(
        "step",
        [state, *inputs],
        [ca.vertcat(q + h * total_q, qdot + h * total_v, foot), output],
        *NAMES,
        {"cse": True},
    )
