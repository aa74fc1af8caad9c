"""Semi-implicit (symplectic) Euler: qdot' = qdot + h qdd(q, qdot), q' = q + h qdot'.

Order 1. With constant mass matrix and no control it is symplectic: the energy of a contact
oscillates but does not drift. Source: Hairer, Lubich, Wanner, "Geometric Numerical Integration"
(2006), I.1.
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics
from ..closed_loop_model import ClosedLoopModel
from . import NAMES


def step(loop: ClosedLoopModel) -> ca.Function:
    """See the package."""
    # a foot one Newton step behind takes 2e-6 of a swing's energy a period: nothing beside control
    newton = 2 if loop.law.torque == "off" else 1
    field, n = ClosedLoopDynamics(loop, newton), loop.joints
    state = ca.SX.sym("state", 2 * n + loop.memory + 2)
    q, qdot, last = state[:n], state[n : 2 * n], state[2 * n :]
    now = field.at(q, qdot, last)
    after = qdot + field.p.dt * now.acceleration
    return ca.Function(
        "step",
        [state, field.reference, field.anchor, field.parameters],
        [ca.vertcat(q + field.p.dt * after, after, now.foot), now.output],
        *NAMES,
        {"cse": True},
    )
