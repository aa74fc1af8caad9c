"""The compliance law: joint velocities and torques that hold the contact force.

Source: Cannata, Denei, Mastrogiovanni, "Towards automated self-calibration of robot skin" (ICRA
2010), eq. 2-11. For a contact with outward body normal n, penetration delta and distance d between
the centres of body and indenter, a velocity v of the body's centre changes the contact force
f_c = -K_c delta^(3/2) n by

    d f_c / dt = -K_c zeta v,    zeta = -(delta^(3/2) / d) (I - n n^T) + (3/2) delta^(1/2) n n^T

and the law asks for qdot_f = (gamma / K_c) (zeta J)^+ (f_c - f*), f* = -f_ref n. Two misprints of
eq. 10 are corrected here: delta in place of delta^(3/2) in its last form, and a sign in its second
line (tests compare zeta with automatic differentiation). On any surface the contact moves with the
body's whole twist (v, omega), v at the indenter's centre, and zeta becomes

    d f_c / dt = -K_c Z (v, omega),
    Z = ((3/2) delta^(1/2) n n^T - delta^(3/2) S, -delta^(3/2) [n]_x),

S = dn/dc (3, 3) the derivative of the normal by the centre in the body's frame, in world axes;
(I - n n^T) / d on a sphere. The change of K_c along the surface is neglected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

MIN_SLOPE_DEPTH = 0.25
"""Depth, relative to the reference depth, below which the force's slope is taken at this depth: the
slope vanishes at depth 0. It makes the speed at the touch 4/3 gamma times the reference depth."""


def force_rows(jacobian: Any, n: Any, shape: Any, length: Any) -> Any:
    """Rows (3, n) whose pseudoinverse times `force_speed` n is (Z J)^+ (gamma / K_c) (f_c - f*).

    jacobian (6, n) at the indenter's centre; shape (3, 3): S. f_c - f* is along n, an eigenvector
    of the normal part of Z. The tangential part, which keeps the normal from turning, is scaled by
    `length`, m (the distance of the centres on the sphere), in place of delta^(3/2).
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


@dataclass(frozen=True)
class Factor:
    """LDL^T factors of a small symmetric positive definite matrix (n, n): A = L D L^T.

    One reciprocal per row and no square root: in machine code this takes half the time of `ca.chol`
    or `ca.solve`, whose divisions and roots depend on each other. `ca.ldl` keeps the divisions in
    its solves. Source: Golub, Van Loan, "Matrix Computations" (2013), 4.1.
    """

    lower: list[list[Any]]
    """Rows of L to the left of its unit diagonal."""
    inverse: list[Any]
    """1 / D (n,)."""

    @classmethod
    def of(cls, matrix: Any) -> Factor:
        """The factors of a symmetric matrix (n, n); only its lower triangle is read."""
        lower: list[list[Any]] = []
        inverse: list[Any] = []
        for i in range(matrix.shape[0]):
            scaled: list[Any] = []  # L_ij D_j
            for j in range(i):
                inner = sum(scaled[k] * lower[j][k] for k in range(j))
                scaled.append(matrix[i, j] - inner)
            row = [s * d for s, d in zip(scaled, inverse, strict=True)]
            inner = sum(s * x for s, x in zip(scaled, row, strict=True))
            lower.append(row)
            inverse.append(1.0 / (matrix[i, i] - inner))
        return cls(lower, inverse)

    def solve(self, right: Any) -> Any:
        """A^-1 right (n, k)."""
        return ca.horzcat(*(self._solve(right[:, k]) for k in range(right.shape[1])))

    def _solve(self, right: Any) -> Any:
        x: list[Any] = []
        for i, row in enumerate(self.lower):
            x.append(right[i] - sum(row[k] * x[k] for k in range(i)))
        x = [value * d for value, d in zip(x, self.inverse, strict=True)]
        for i in reversed(range(len(x))):
            for k in range(i):
                x[k] = x[k] - self.lower[i][k] * x[i]
        return ca.vertcat(*x)
