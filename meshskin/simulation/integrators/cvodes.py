"""SUNDIALS CVODES through CasADi: variable order and step, the reference for the other integrators.

Each step of the loop is one integration to 1e-10; several hundred times slower than the others.
Source: Hindmarsh et al., "SUNDIALS", ACM TOMS 31 (2005).
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics
from ..closed_loop_model import ClosedLoopModel
from . import NAMES

OPTIONS = {"reltol": 1e-10, "abstol": 1e-12, "max_num_steps": 1_000_000}


def step(loop: ClosedLoopModel) -> ca.Function:
    """See the package."""
    field, n = ClosedLoopDynamics(loop, newton=4), loop.joints
    rate = field.rate()
    x, t = ca.SX.sym("x", 2 * n), ca.SX.sym("t")
    last = ca.SX.sym("last", loop.memory + 2)
    held = (field.reference, field.anchor, field.parameters)
    h = field.p.dt
    qdd = rate(x[:n], x[n:], last, t * h, *held)[0]
    problem = {"x": x, "t": t, "p": ca.vertcat(last, *held), "ode": h * ca.vertcat(x[n:], qdd)}
    solver = ca.integrator("cvodes", "cvodes", problem, 0.0, 1.0, OPTIONS)
    state, *inputs = (
        ca.MX.sym(k, v.shape[0])
        for k, v in zip(NAMES[0], (ca.vertcat(x, last), *held), strict=True)
    )
    end = solver(x0=state[: 2 * n], p=ca.vertcat(state[2 * n :], *inputs))["xf"]
    _, foot, output = rate(state[:n], state[n : 2 * n], state[2 * n :], 0.0, *inputs)
    return ca.Function("step", [state, *inputs], [ca.vertcat(end, foot), output], *NAMES)
