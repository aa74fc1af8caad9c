"""Linearly implicit Euler: stiff contact and high gains at one solve a step, without iterations.

With effort e(q, qdot) = M qdd, and its slopes by the stiff parts, contact and force law along the
contact normal and the velocity gain L, the step solves

    (M + h L + h^2 a b^T) dv = h (e - h a (b . qdot)),    qdot' = qdot + dv,  q' = q + h qdot',

b = d(depth)/dq, a = -d(e)/d(depth). L and the law's part of a stop where a torque is at its limit.
Order 1. Source: Hairer, Wanner, "Solving Ordinary Differential Equations II" (1996), IV.7, with an
approximate Jacobian.
"""

from __future__ import annotations

import casadi as ca

from ..closed_loop_dynamics import ClosedLoopDynamics, Instant
from ..closed_loop_model import ClosedLoopModel
from ..ldl import Factor
from . import NAMES


def step(loop: ClosedLoopModel) -> ca.Function:
    """See the package."""
    field, n = ClosedLoopDynamics(loop), loop.joints
    state = ca.SX.sym("state", 2 * n + loop.memory + 2)
    q, qdot, last = state[:n], state[n : 2 * n], state[2 * n :]
    now, h = field.at(q, qdot, last), field.p.dt
    right = h * (now.effort - h * now.pull * ca.dot(now.row, qdot))
    flat = _damped_solve(loop, now, h * field.p.rate, ca.horzcat(right, h * h * now.pull))
    # Sherman-Morrison for the part of rank one
    change = flat[:, 0] - flat[:, 1] * (
        ca.dot(now.row, flat[:, 0]) / (1.0 + ca.dot(now.row, flat[:, 1]))
    )
    after = qdot + change
    return ca.Function(
        "step",
        [state, field.reference, field.anchor, field.parameters],
        [ca.vertcat(q + h * after, after, now.foot), now.output],
        *NAMES,
        {"cse": True},
    )


def _damped_solve(loop: ClosedLoopModel, now: Instant, gain: ca.SX, right: ca.SX) -> ca.SX:
    """(M + diag(free) gain L_1)^-1 right, with L_1 = M or I: symmetric in either case."""
    if loop.law.shape == "inertia":  # (I + gain diag(free)) M
        damping = 1.0 + gain * now.free
        return now.factor.solve(ca.horzcat(right[:, 0] / damping, right[:, 1] / damping))
    return Factor.of(now.mass + gain * ca.diag(now.free)).solve(right)
