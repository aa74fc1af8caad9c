"""Semi-implicit (symplectic) Euler: qdot' = qdot + h qdd(q, qdot), q' = q + h qdot'.

Order 1. With a constant mass matrix and no control it is symplectic: the energy of a contact
oscillates but does not drift. Source: Hairer, Lubich, Wanner, "Geometric Numerical Integration"
(2006), I.1.
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics
from ..closed_loop_model import ClosedLoopModel
from . import step_function


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step (state, reference, anchor, parameters) -> (next state, output)."""
    # with one Newton step the foot point lags and takes 2e-6 of the energy of an oscillation in
    # each period: negligible beside the control, but not without it
    dynamics = ClosedLoopDynamics(loop, newton=2 if loop.law.torque == "off" else 1)
    state, q, qdot, contact_state = dynamics.state()
    now, h = dynamics.at(q, qdot, contact_state), dynamics.p.dt
    after = qdot + h * now.acceleration
    state_after = ca.vertcat(q + h * after, after, now.contact_state)
    return step_function([state, *dynamics.inputs], state_after, now.output)
