"""The compliance law: joint velocities and torques that hold the contact force.

Source: Cannata, Denei, Mastrogiovanni, "Towards automated self-calibration of robot skin" (ICRA
2010), eq. 2-11. For a contact with outward body normal n, penetration delta and distance d between
the centers of body and indenter, a velocity v of the body's center changes the contact force
f_c = -K_c delta^(3/2) n by

    d f_c / dt = -K_c zeta v,    zeta = -(delta^(3/2) / d) (I - n n^T) + (3/2) delta^(1/2) n n^T

and the law asks for qdot_f = (gamma / K_c) (zeta J)^+ (f_c - f*), f* = -f_ref n. Two misprints of
eq. 10 are corrected here: delta in place of delta^(3/2) in its last form, and a sign in its second
line (tests compare zeta with automatic differentiation).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from .ldl import Factor

MIN_SLOPE_DEPTH = 0.25
"""Depth, relative to the reference depth, below which the force's slope is taken at this depth: the
slope vanishes at depth 0. It makes the speed at the touch 4/3 gamma times the reference depth."""


def zeta(delta: Any, d: Any, n: Any) -> Any:
    """The matrix zeta (3, 3) of eq. 10; delta, d in m, n (3,) the outward body normal."""
    nn = n @ n.T
    return -(delta * ca.sqrt(delta) / d) * (ca.DM.eye(3) - nn) + 1.5 * ca.sqrt(delta) * nn


def general_zeta(delta: Any, n: Any, shape: Any) -> Any:
    """The matrix Z (3, 6) of eq. 10 for any surface: d f_c / dt = -K_c Z (v, omega).

    (v, omega): the body's velocity at the indenter's center and its angular velocity; the contact
    moves with the whole twist. shape (3, 3): dn/dc, derivative of the normal n (3,) by the center c
    in the body's frame, in world axes; on a sphere it is (I - n n^T) / d, which gives `zeta`. The
    change of K_c with the curvature along the surface is neglected; it is zero on the sphere.
    """
    normal_part = 1.5 * ca.sqrt(delta) * n @ n.T
    turn = delta * ca.sqrt(delta)
    return ca.horzcat(normal_part - turn * shape, -turn * ca.skew(n))


def force_rows(jacobian: Any, n: Any, shape: Any, length: Any) -> Any:
    """Rows (3, n) whose pseudoinverse times `force_speed` n is (Z J)^+ (gamma / K_c) (f_c - f*).

    jacobian (6, n) at the indenter's center. f_c - f* is along n, an eigenvector of the normal part
    of Z. The tangential part, which keeps the normal from turning, is scaled by `length`, m (the
    distance of the centers on the sphere), in place of delta^(3/2).
    """
    linear, angular = jacobian[:3, :], jacobian[3:, :]
    turning = shape @ linear + ca.skew(n) @ angular
    return n @ (n.T @ linear) + length * turning


def force_speed(gains: Any, slope: Any, delta: Any, force: Any) -> Any:
    """Speed along n that the force part asks for, m/s: gamma (f_ref - F) / slope, limited.

    gains: a Law or Parameters. slope: dF/d(depth), N/m, at `slope_depth`; on the paper's sphere it
    is (3/2) K_c delta^(1/2), and this is zeta^-1 (gamma / K_c) (f_c - f*): f_c - f* = (f_ref - F) n
    lies in the normal eigenspace of zeta, where the inverse is a division. The limit is the
    approach speed, so that approach and touch are part of the law. Without contact, gamma times the
    gap is added: a stiff contact, where the force part alone is slow, is approached fast and
    touched slowly (`touch_speed`).
    """
    speed = gains.gamma * (gains.force_reference - force) / slope
    speed += gains.gamma * ca.fmax(-delta, 0.0)
    return ca.fmax(-gains.approach_speed, ca.fmin(gains.approach_speed, speed))


def slope_depth(delta: Any, delta_reference: Any) -> Any:
    """Depth, m, at which the force part evaluates its slope; see MIN_SLOPE_DEPTH."""
    return ca.fmax(delta, MIN_SLOPE_DEPTH * delta_reference)


def touch_speed(gains: Any, delta_reference: float) -> float:
    """`force_speed` at depth 0 and force 0, m/s: 4/3 gamma delta_reference, at most the approach
    speed. It holds for a Hertz contact: f_ref / slope = delta_ref^(3/2) / (3/2 delta^(1/2))."""
    return float(min(gains.approach_speed, 4.0 / 3.0 * gains.gamma * delta_reference))


def speed_slope(gains: Any, contact: Any, assumed: Any) -> Any:
    """Derivative of `force_speed` by the depth, at a SurfaceContact, 1/s: at most zero.

    assumed: the contact with the E* that the law assumes.
    """
    delta = ca.SX.sym("delta")
    slope = assumed.slope_at(slope_depth(delta, assumed.reference_depth))
    speed = force_speed(gains, slope, delta, contact.force_at(delta))
    return ca.substitute(ca.gradient(speed, delta), delta, contact.depth)


def path_twist(
    reference: Any,
    tracking: Any,
    position: Any,
    rotation: Any,
    lever: Any,
    normal: Any,
    track_normal: Any = 0.0,
    ahead: Any = 0.0,
) -> tuple[Any, Any]:
    """Angular velocity (3,) and velocity (3,) of the contact point that follow the path.

    reference (18,): see closed_loop_model.REFERENCE, extrapolated by `ahead` seconds; position,
    rotation: of the body; lever: from the body's origin to the contact point; normal: there; all in
    world axes. The velocity has no part along the normal, the force's direction, unless
    `track_normal` is 1.
    """
    goal = ca.reshape(reference[3:12], 3, 3)
    turn = 0.5 * sum(ca.cross(rotation[:, k], goal[:, k]) for k in range(3))
    omega = reference[15:18] + tracking * (turn + ahead * reference[15:18])
    velocity = reference[12:15] + tracking * (reference[:3] + ahead * reference[12:15] - position)
    velocity += ca.cross(omega, lever)
    return omega, velocity - (1.0 - track_normal) * normal * ca.dot(normal, velocity)


def torque(kind: str, bias: Any, gain: Any, velocity_error: Any, contact_torque: Any) -> Any:
    """Joint torques (n,) of the law, eq. 11, N m.

    kind: one of TORQUES; gain: L (n, n); velocity_error: qdot - qdot_f - qdot_r (n,);
    contact_torque: -J^T f_c (n,).
    """
    if kind == "off":
        return 0.0 * bias
    asked = bias - gain @ velocity_error
    return asked + contact_torque if kind == "compensated" else asked


def damped_inverse(jacobian: Any, damping: Any, twist: Any) -> Any:
    """J^T (J J^T + diag(damping)^2)^-1 twist: joint velocities (n,), damped row by row.

    jacobian (r, n), damping (r,) of each row, twist (r,).
    """
    gram = jacobian @ jacobian.T + ca.diag(damping**2)
    return jacobian.T @ Factor.of(gram).solve(twist)


def velocity_gain(shape: str, rate: Any, mass_matrix: Any) -> Any:
    """The matrix L (n, n) of eq. 11: rate M(q) with shape "inertia", rate I with "identity"."""
    return rate * (mass_matrix if shape == "inertia" else ca.DM.eye(mass_matrix.shape[0]))
