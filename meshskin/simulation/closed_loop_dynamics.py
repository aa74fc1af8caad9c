"""The closed loop in continuous time: arm dynamics, contact, law and torque at one instant.

    M(q) qdd = tau + J^T f_c - bias(q, qdot)

tau is held within the arm's torque limits. The integrators make a step of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from . import law as compliance
from .closed_loop_model import ANCHOR, PARAMETERS, REFERENCE, ClosedLoopModel, Parameters
from .delayed_reading import delayed_reading, kept
from .ldl import Factor
from .surface_contact import Touch, touch

ROTATION_DAMPING = 0.02
FORCE_DAMPING = 1e-6
"""Row dampings of the inverses, in m; damping costs path accuracy, hence the rotation rows only."""
FLATTEST = 1.0
"""Curvature below which the body counts as a sphere of 1 m in the force part, 1/m."""
SLIP = 5e-3
"""Joint speed at which Coulomb friction is at tanh(1) of its full value, rad/s."""


@dataclass(frozen=True)
class Instant:
    """Expressions of the closed loop at one state."""

    touch: Touch
    mass: ca.SX
    """M (n, n)."""
    factor: Factor
    """Its factors."""
    effort: ca.SX
    """tau + J^T f_c - bias - friction (n,), N m."""
    row: ca.SX
    """d(depth)/dq (n,), m/rad."""
    pull: ca.SX
    """d(effort)/d(depth) with opposite sign (n,): contact stiffness and law slope, N/rad."""
    free: ca.SX
    """1 where a joint's torque is within its limit, 0 where it is held there (n,)."""
    memory: ca.SX
    """Readings on their way to the law after this step."""
    output: ca.SX
    """The row that Loop.outputs describes."""

    @property
    def foot(self) -> ca.SX:
        """What the next step knows of this contact: readings on their way, (u, v) of the foot."""
        return ca.vertcat(self.memory, self.touch.u, self.touch.v)

    @property
    def acceleration(self) -> ca.SX:
        """qdd (n,), rad/s^2."""
        return self.factor.solve(self.effort)


class ClosedLoopDynamics:
    """The closed loop's equations for one scene.

    The inputs of a step are symbols: reference (18,), anchor (69,), parameters (9,). `newton` steps
    find the foot of the indenter's centre, from that of the last step.
    """

    def __init__(self, loop: ClosedLoopModel, newton: int = 1) -> None:
        self.loop, self.newton = loop, newton
        self.reference = ca.SX.sym("reference", REFERENCE)
        self.anchor = ca.SX.sym("anchor", ANCHOR)
        self.parameters = ca.SX.sym("parameters", PARAMETERS)
        self.p = Parameters.split(self.parameters)
        self.model = loop.arm.dynamics()
        limit = np.asarray(loop.arm.effort_limit, dtype=float)
        self.limit = ca.DM(np.where(np.isfinite(limit), limit, 1e30))

    def at(self, q: ca.SX, qdot: ca.SX, foot: ca.SX, ahead: ca.SX | float = 0.0) -> Instant:
        """The closed loop at (q, qdot), `ahead` s after the reference; foot: the last one."""
        loop, p = self.loop, self.p
        memory, uv = foot[:-2], foot[-2:]
        mass, bias = self.model.mass_matrix(q), self.model.bias(q, qdot)
        tip = self.model.pose(q)
        pose = tip @ ca.DM(loop.mount)
        rotation, position = pose[:3, :3], pose[:3, 3]
        jacobian = moved(self.model.jacobian(q), position - tip[:3, 3])

        centre = rotation.T @ (ca.DM(loop.indenter_position) - position)
        t = touch(self.anchor, uv, centre, p, loop.contact, self.newton)
        normal, lever = rotation @ t.normal, rotation @ t.point
        row = moved(jacobian, lever)[:3, :].T @ normal

        reading, believed = delayed_reading(memory, t), t.believed(loop.law.effective_modulus)
        firm = believed.slope_at(compliance.floored(reading.depth, believed.reference_depth))
        speed = compliance.force_speed(p, firm, reading.depth, reading.force) * (1.0 - p.free)
        curvature = ca.fmax(t.curvature, FLATTEST)
        if loop.law.surface == "exact":
            shape = rotation @ self.shape(uv, centre) @ rotation.T
            there = moved(jacobian, ca.DM(loop.indenter_position) - position)
            reach = 1.0 / curvature + p.indenter_radius - t.depth
            rows = compliance.force_rows(there, normal, shape, reach)
        else:  # the paper's sphere: the Jacobian of the (osculating) sphere's centre
            rows = moved(jacobian, lever - normal / curvature)[:3, :]
        push_away = compliance.damped_inverse(rows, ca.DM([FORCE_DAMPING] * 3), normal)
        omega, velocity = compliance.along(
            self.reference, p.tracking, position, rotation, lever, normal, p.free, ahead
        )
        twist = ca.vertcat(velocity, omega)
        damping = ca.DM([FORCE_DAMPING] * 3 + [ROTATION_DAMPING] * 3)
        wish = speed * push_away + compliance.damped_inverse(moved(jacobian, lever), damping, twist)

        gain = compliance.velocity_gain(loop.law.shape, p.rate, mass)
        asked = compliance.torque(loop.law.torque, bias, gain, qdot - wish, row * reading.force)
        torque = ca.fmin(ca.fmax(asked, -self.limit), self.limit)
        free = (ca.fabs(asked) < self.limit) * (loop.law.torque != "off")
        pull = row * t.slope
        if not loop.delay:  # an old reading does not answer to the depth of the moment
            slope = compliance.speed_slope(p, t, believed) * (1.0 - p.free)
            lifted = free if loop.law.torque == "compensated" else 0.0
            pull = pull * (1.0 - lifted) - free * (gain @ push_away) * slope
        return Instant(
            touch=t,
            mass=mass,
            factor=Factor.of(mass),
            effort=torque - row * t.force - bias - self.friction(qdot),
            row=row,
            pull=pull,
            free=free,
            memory=kept(memory, t),
            output=ca.vertcat(t.point, t.normal, t.force, t.depth, t.radius, torque),
        )

    def friction(self, qdot: ca.SX) -> ca.SX:
        """Friction of the joints (n,), N m: viscous, and Coulomb's, smooth about rest."""
        arm, drag = self.loop.arm, ca.SX(*qdot.shape)
        if np.any(arm.damping):
            drag += ca.DM(arm.damping) * qdot
        if np.any(arm.friction):
            drag += ca.DM(arm.friction) * ca.tanh(qdot / SLIP)
        return drag

    def shape(self, uv: ca.SX, centre: ca.SX) -> ca.SX:
        """dn/dc (3, 3), 1/m, body frame: by automatic differentiation of the contact's foot."""
        c = ca.SX.sym("c", 3)
        normal = touch(self.anchor, uv, c, self.p, self.loop.contact, self.newton).normal
        return ca.substitute(ca.jacobian(normal, c), c, centre)

    def rate(self) -> ca.Function:
        """(q, qdot, foot, ahead, reference, anchor, parameters) -> (qdd, foot, output)."""
        n = self.loop.joints
        sizes = {"q": n, "qdot": n, "foot": self.loop.memory + 2, "ahead": 1}
        q, qdot, foot, ahead = (ca.SX.sym(name, k) for name, k in sizes.items())
        now = self.at(q, qdot, foot, ahead)
        return ca.Function(
            "rate",
            [q, qdot, foot, ahead, self.reference, self.anchor, self.parameters],
            [now.acceleration, now.foot, now.output],
            {"cse": True},
        )


def moved(jacobian: ca.SX, lever: ca.SX) -> ca.SX:
    """Jacobian (6, n), linear first, of the point displaced by `lever` (world axes)."""
    return ca.vertcat(jacobian[:3, :] - ca.skew(lever) @ jacobian[3:, :], jacobian[3:, :])
