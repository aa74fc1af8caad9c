"""The compliance law: joint velocities and torques that hold the contact force.

Source: Cannata, Denei, Mastrogiovanni, "Towards automated self-calibration of robot skin" (ICRA
2010), eq. 2-11. For a contact with outward body normal n, penetration delta and distance d between
the centres of body and indenter, a velocity v of the body's centre changes the contact force
f_c = -K_c delta^(3/2) n by

    d f_c / dt = -K_c zeta v,    zeta = -(delta^(3/2) / d) (I - n n^T) + (3/2) delta^(1/2) n n^T

and the law asks for qdot_f = (gamma / K_c) (zeta J)^+ (f_c - f*), f* = -f_ref n. The printed eq. 10
has delta in place of delta^(3/2) in its last form and a sign in its second line that the third
takes back; both are put right here (tests compare zeta with automatic differentiation).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from .ldl import Factor


def zeta(delta: Any, d: Any, n: Any) -> Any:
    """The matrix zeta (3, 3) of eq. 10; delta, d in m, n (3,) the outward body normal."""
    nn = n @ n.T
    return -(delta * ca.sqrt(delta) / d) * (ca.DM.eye(3) - nn) + 1.5 * ca.sqrt(delta) * nn


def general_zeta(delta: Any, n: Any, shape: Any) -> Any:
    """The matrix Z (3, 6) of eq. 10 for any surface: d f_c / dt = -K_c Z (v, omega).

    (v, omega): the body's velocity at the indenter's centre and its angular velocity; the contact
    moves with the whole twist. shape (3, 3): dn/dc, how the normal n (3,) turns with the centre c
    in the body's frame, in world axes; on a sphere (I - n n^T) / d, which gives `zeta`. The change
    of K_c with the curvature along the surface is left out, as it is zero on the sphere.
    """
    press = 1.5 * ca.sqrt(delta) * n @ n.T
    turn = delta * ca.sqrt(delta)
    return ca.horzcat(press - turn * shape, -turn * ca.skew(n))


def force_rows(jacobian: Any, n: Any, shape: Any, length: Any) -> Any:
    """Rows (3, n) whose inverse times `force_speed` n is (Z J)^+ (gamma / K_c) (f_c - f*).

    jacobian (6, n) at the indenter's centre. f_c - f* is along n, an eigenvector of the normal part
    of Z; its tangential part, that the normal must not turn, is scaled by `length`, m (the distance
    of the centres on the sphere), in place of delta^(3/2).
    """
    linear, angular = jacobian[:3, :], jacobian[3:, :]
    turning = shape @ linear + ca.skew(n) @ angular
    return n @ (n.T @ linear) + length * turning


def force_speed(gains: Any, slope: Any, delta: Any, force: Any) -> Any:
    """Speed along n of the force part: gamma (f_ref - F) / slope, limited.

    gains: a Law, or anything with its gamma, force_reference and approach_speed. slope:
    dF/d(depth), N/m, at `floored` depth; on the paper's sphere it is (3/2) K_c delta^(1/2), and
    this is zeta^-1 (gamma / K_c) (f_c - f*): f_c - f* = (f_ref - F) n lies in the normal eigenspace
    of zeta, so that zeta's inverse is a division. The speed is limited to the approach speed, which
    makes approach and touch part of the law. Across a gap the speed grows with the gap at the rate
    gamma: stiff contact, where the force part alone crawls, is approached fast and touched slowly
    (`touch_speed`).
    """
    speed = gains.gamma * (gains.force_reference - force) / slope
    speed += gains.gamma * ca.fmax(-delta, 0.0)
    return ca.fmax(-gains.approach_speed, ca.fmin(gains.approach_speed, speed))


def floored(delta: Any, delta_reference: Any) -> Any:
    """Depth at which the force part takes its slope: zeta is singular at delta = 0."""
    return ca.fmax(delta, 0.25 * delta_reference)


def touch_speed(gains: Any, delta_reference: float) -> float:
    """`force_speed` at the touch, m/s: 4/3 gamma delta_reference, or the approach speed."""
    return float(min(gains.approach_speed, 4.0 / 3.0 * gains.gamma * delta_reference))


def speed_slope(gains: Any, touch: Any, believed: Any) -> Any:
    """Derivative of `force_speed` by the depth at the contact `touch`, 1/s: at most zero.

    believed: the contact as the law takes it to be.
    """
    delta = ca.SX.sym("delta")
    slope = believed.slope_at(floored(delta, believed.reference_depth))
    speed = force_speed(gains, slope, delta, touch.force_at(delta))
    return ca.substitute(ca.gradient(speed, delta), delta, touch.depth)


def along(
    reference: Any,
    tracking: Any,
    position: Any,
    rotation: Any,
    lever: Any,
    normal: Any,
    free: Any = 0.0,
    ahead: Any = 0.0,
) -> tuple[Any, Any]:
    """Angular velocity and velocity (3,) of the contact point that follow the path.

    reference (18,), see loop.REFERENCE, taken `ahead` s on; position, rotation: of the body;
    lever: from the body's origin to the contact, normal: there; all in world axes. The velocity is
    kept out of the normal, the force's direction, unless `free` is 1.
    """
    goal = ca.reshape(reference[3:12], 3, 3)
    turn = 0.5 * sum(ca.cross(rotation[:, k], goal[:, k]) for k in range(3))
    omega = reference[15:18] + tracking * (turn + ahead * reference[15:18])
    velocity = reference[12:15] + tracking * (reference[:3] + ahead * reference[12:15] - position)
    velocity += ca.cross(omega, lever)
    return omega, velocity - (1.0 - free) * normal * ca.dot(normal, velocity)


def torque(kind: str, bias: Any, gain: Any, excess: Any, lift: Any) -> Any:
    """Joint torques (n,) of the law, eq. 11.

    kind: of TORQUES; gain: L (n, n); excess: qdot - qdot_f - qdot_r (n,); lift: -J^T f_c (n,).
    """
    if kind == "off":
        return 0.0 * bias
    asked = bias - gain @ excess
    return asked + lift if kind == "compensated" else asked


def damped_inverse(jacobian: Any, rows: Any, twist: Any) -> Any:
    """J^T (J J^T + diag(rows)^2)^-1 twist: joint velocities (n,), damped row by row.

    jacobian (r, n), rows (r,) damping of each row, twist (r,).
    """
    gram = jacobian @ jacobian.T + ca.diag(rows**2)
    return jacobian.T @ Factor.of(gram).solve(twist)


def velocity_gain(shape: str, rate: Any, mass_matrix: Any) -> Any:
    """The matrix L (n, n) of eq. 11: rate M(q) with shape "inertia", rate I with "identity"."""
    return rate * (mass_matrix if shape == "inertia" else ca.DM.eye(mass_matrix.shape[0]))
