"""SUNDIALS CVODES through CasADi: variable order and step, the reference for the other integrators.

Each step of the loop is one integration to a relative tolerance of 1e-10; it takes several hundred
times as long as a step of the others. Source: Hindmarsh et al., "SUNDIALS", ACM TOMS 31 (2005).
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics
from ..closed_loop_model import ClosedLoopModel
from . import NAMES

OPTIONS = {"reltol": 1e-10, "abstol": 1e-12, "max_num_steps": 1_000_000}
"""Tolerances five decimal digits below the smallest stated force error (stability.ERROR_FLOOR)."""


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step (state, reference, anchor, parameters) -> (next state, output) by CVODES."""
    dynamics, n = ClosedLoopDynamics(loop, newton=4), loop.joints
    derivative = dynamics.derivative()
    x, t = ca.SX.sym("x", 2 * n), ca.SX.sym("t")
    contact_state = ca.SX.sym("contact_state", loop.memory + 2)
    h = dynamics.p.dt
    acceleration = derivative(x[:n], x[n:], contact_state, t * h, *dynamics.inputs)[0]
    problem = {
        "x": x,
        "t": t,
        "p": ca.vertcat(contact_state, *dynamics.inputs),
        "ode": h * ca.vertcat(x[n:], acceleration),
    }
    solver = ca.integrator("cvodes", "cvodes", problem, 0.0, 1.0, OPTIONS)
    state, *inputs = (
        ca.MX.sym(name, v.shape[0])
        for name, v in zip(NAMES[0], (ca.vertcat(x, contact_state), *dynamics.inputs), strict=True)
    )
    end = solver(x0=state[: 2 * n], p=ca.vertcat(state[2 * n :], *inputs))["xf"]
    now = derivative(state[:n], state[n : 2 * n], state[2 * n :], 0.0, *inputs)
    return ca.Function("step", [state, *inputs], [ca.vertcat(end, now[1]), now[2]], *NAMES)
