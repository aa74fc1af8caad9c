"""Linearly implicit Euler: stable for stiff contact and high gains, one linear solve a step.

With the generalized force f(q, qdot) = M qdd and its derivatives by the stiff terms only (contact
and force law along the contact normal, velocity gain L), a step solves

    (M + h L + h^2 a b^T) dv = h (f - h a (b . qdot)),    qdot' = qdot + dv,  q' = q + h qdot',

b = d(depth)/dq, a = -d(f)/d(depth). L and the law's part of a are dropped for joints whose torque
is at its limit. Order 1. Source: Hairer, Wanner, "Solving Ordinary Differential Equations II"
(1996), IV.7, with an approximate Jacobian.
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics, DynamicsTerms
from ..closed_loop_model import ClosedLoopModel
from ..law import Factor
from . import step_function


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step (state, reference, anchor, parameters) -> (next state, output)."""
    dynamics = ClosedLoopDynamics(loop)
    state, q, qdot, contact_state = dynamics.state()
    now, h = dynamics.at(q, qdot, contact_state), dynamics.p.dt
    a, b = now.stiffness, now.depth_gradient
    right = ca.horzcat(h * (now.force - h * a * ca.dot(b, qdot)), h * h * a)
    x = _damped_solve(loop, now, h * dynamics.p.rate, right)
    # Sherman-Morrison formula for the part of rank one
    dv = x[:, 0] - x[:, 1] * (ca.dot(b, x[:, 0]) / (1.0 + ca.dot(b, x[:, 1])))
    after = qdot + dv
    state_after = ca.vertcat(q + h * after, after, now.contact_state)
    return step_function([state, *dynamics.inputs], state_after, now.output)


def _damped_solve(loop: ClosedLoopModel, now: DynamicsTerms, gain: ca.SX, right: ca.SX) -> ca.SX:
    """(M + gain D L_1)^-1 right, D = diag(unlimited), L_1 = M or I: symmetric in either case."""
    if loop.law.shape == "inertia":  # (I + gain D) M
        damping = 1.0 + gain * now.unlimited
        return now.factor.solve(ca.horzcat(right[:, 0] / damping, right[:, 1] / damping))
    return Factor.of(now.mass + gain * ca.diag(now.unlimited)).solve(right)
