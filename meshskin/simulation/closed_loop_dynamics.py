"""The closed loop in continuous time: arm dynamics, contact, law and torque at one instant.

    M(q) qdd = tau + J^T f_c - bias(q, qdot) - friction(qdot)

tau is limited to the arm's torque limits. The integrators turn these equations into a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from . import law as compliance
from .closed_loop_model import ANCHOR, PARAMETERS, REFERENCE, ClosedLoopModel, Parameters
from .law import Factor
from .surface_contact import SurfaceContact, delayed_reading, shift_memory, surface_contact

ROTATION_DAMPING, FORCE_DAMPING = 0.02, 1e-6
"""Damping of the inverses' rows: rotations (dimensionless) and positions, m. A damped row loses the
part (damping / singular value)^2 of its motion, 4e-4 of a rotation in a regular posture, and joint
speeds stay bounded near singular ones. Lost position is path error: those rows have next to none
(tests/hard/test_motion_stability.py runs the Puma through its wrist's singularity)."""
MIN_CURVATURE = 1.0
"""Curvature, 1/m, below which the force part of the law treats the body as a sphere of 1 m: its
centre must stay at a finite distance."""
COULOMB_SPEED = 5e-3
"""Joint speed, rad/s, at which the smoothed Coulomb friction is tanh(1) of its full value: far
below the joint speeds of an exploration, and resolved by steps of 1 ms."""
UNLIMITED_TORQUE = 1e30
"""Torque limit, N m, of a joint without one: CasADi's min and max need a finite number."""


@dataclass(frozen=True)
class DynamicsTerms:
    """Expressions of the closed loop at one state."""

    contact: SurfaceContact
    mass: ca.SX
    """Mass matrix M (n, n)."""
    factor: Factor
    """LDL^T factors of M."""
    force: ca.SX
    """Generalized force tau + J^T f_c - bias - friction (n,), N m."""
    depth_gradient: ca.SX
    """d(depth)/dq (n,), m/rad."""
    stiffness: ca.SX
    """-d(force)/d(depth) (n,), N/rad: contact stiffness and slope of the force law."""
    unlimited: ca.SX
    """1 where a joint's torque is within its limit, 0 where it is at the limit (n,)."""
    memory: ca.SX
    """Delayed measurements after this step."""
    output: ca.SX
    """The output row; see ClosedLoopModel.outputs."""

    @property
    def contact_state(self) -> ca.SX:
        """The part of the next state that follows from this contact: delayed measurements, (u, v)
        of the foot point."""
        return ca.vertcat(self.memory, self.contact.u, self.contact.v)

    @property
    def acceleration(self) -> ca.SX:
        """Joint acceleration (n,), rad/s^2."""
        return self.factor.solve(self.force)


class ClosedLoopDynamics:
    """The equations of a closed loop.

    The inputs of a step are symbols: reference (18,), anchor (69,), parameters (9,). `newton`:
    Newton steps from the previous foot point of the indenter's centre to the new one.
    """

    def __init__(self, loop: ClosedLoopModel, newton: int = 1) -> None:
        self.loop, self.newton = loop, newton
        self.reference = ca.SX.sym("reference", REFERENCE)
        self.anchor = ca.SX.sym("anchor", ANCHOR)
        self.parameters = ca.SX.sym("parameters", PARAMETERS)
        self.p = Parameters.split(self.parameters)
        self.model = loop.arm.dynamics()
        limit = np.asarray(loop.arm.effort_limit, dtype=float)
        self.limit = ca.DM(np.where(np.isfinite(limit), limit, UNLIMITED_TORQUE))

    @property
    def inputs(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The symbols (reference, anchor, parameters)."""
        return self.reference, self.anchor, self.parameters

    def state(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Symbols of a state: the whole (2 n + memory + 2,), q, qdot, and the contact's part."""
        n = self.loop.joints
        state = ca.SX.sym("state", 2 * n + self.loop.memory + 2)
        return state, state[:n], state[n : 2 * n], state[2 * n :]

    def at(
        self, q: ca.SX, qdot: ca.SX, contact_state: ca.SX, ahead: ca.SX | float = 0.0
    ) -> DynamicsTerms:
        """The terms at (q, qdot), `ahead` seconds after the reference; contact_state: that of the
        previous step."""
        loop, p = self.loop, self.p
        memory, uv = contact_state[:-2], contact_state[-2:]
        mass, bias = self.model.mass_matrix(q), self.model.bias(q, qdot)
        tip, jacobian = loop.arm.kinematics(q)
        pose = tip @ ca.DM(loop.mount)
        rotation, position = pose[:3, :3], pose[:3, 3]
        jacobian = shift_jacobian(jacobian, position - tip[:3, 3])

        centre = rotation.T @ (ca.DM(loop.indenter_position) - position)
        contact = surface_contact(self.anchor, uv, centre, p, loop.contact, self.newton)
        normal, lever = rotation @ contact.normal, rotation @ contact.point
        at_contact = shift_jacobian(jacobian, lever)
        depth_gradient = at_contact[:3, :].T @ normal

        depth, force = delayed_reading(memory, contact)
        assumed = contact.with_modulus(loop.law.effective_modulus)
        slope = assumed.slope_at(compliance.slope_depth(depth, assumed.reference_depth))
        speed = compliance.force_speed(p, slope, depth, force) * (1.0 - p.track_normal)
        rows = self.force_rows(jacobian, contact, uv, centre, pose)
        normal_motion = compliance.damped_inverse(rows, ca.DM([FORCE_DAMPING] * 3), normal)
        omega, velocity = compliance.path_twist(
            self.reference, p.tracking, position, rotation, lever, normal, p.track_normal, ahead
        )
        damping = ca.DM([FORCE_DAMPING] * 3 + [ROTATION_DAMPING] * 3)
        path_motion = compliance.damped_inverse(at_contact, damping, ca.vertcat(velocity, omega))
        wanted = speed * normal_motion + path_motion

        gain = p.rate * (mass if loop.law.shape == "inertia" else ca.DM.eye(loop.joints))
        asked = compliance.torque(
            loop.law.torque, bias, gain, qdot - wanted, depth_gradient * force
        )
        torque = ca.fmin(ca.fmax(asked, -self.limit), self.limit)
        unlimited = (ca.fabs(asked) < self.limit) * (loop.law.torque != "off")
        stiffness = depth_gradient * contact.slope
        if not loop.delay:  # a delayed measurement does not depend on the present depth
            speed_slope = compliance.speed_slope(p, contact, assumed) * (1.0 - p.track_normal)
            compensated = unlimited if loop.law.torque == "compensated" else 0.0
            stiffness = stiffness * (1.0 - compensated)
            stiffness -= unlimited * (gain @ normal_motion) * speed_slope
        return DynamicsTerms(
            contact=contact,
            mass=mass,
            factor=Factor.of(mass),
            force=torque - depth_gradient * contact.force - bias - self.friction(qdot),
            depth_gradient=depth_gradient,
            stiffness=stiffness,
            unlimited=unlimited,
            memory=shift_memory(memory, contact),
            output=ca.vertcat(contact.output, torque),
        )

    def force_rows(
        self, jacobian: ca.SX, contact: SurfaceContact, uv: ca.SX, centre: ca.SX, pose: ca.SX
    ) -> ca.SX:
        """Rows (3, n) of the force part of the law.

        jacobian (6, n) of the body's frame; centre (3,) of the indenter, body frame, m; pose (4, 4)
        of the body.
        """
        loop, rotation, position = self.loop, pose[:3, :3], pose[:3, 3]
        normal = rotation @ contact.normal
        curvature = ca.fmax(contact.curvature, MIN_CURVATURE)
        if loop.law.surface == "exact":
            shape = rotation @ self.normal_gradient(uv, centre) @ rotation.T
            at_centre = shift_jacobian(jacobian, ca.DM(loop.indenter_position) - position)
            distance = 1.0 / curvature + self.p.indenter_radius - contact.depth
            return compliance.force_rows(at_centre, normal, shape, distance)
        # the paper's sphere: the Jacobian of the (osculating) sphere's centre
        return shift_jacobian(jacobian, rotation @ contact.point - normal / curvature)[:3, :]

    def friction(self, qdot: ca.SX) -> ca.SX:
        """Friction torque of the joints (n,), N m: viscous, and Coulomb friction smoothed by tanh
        over COULOMB_SPEED."""
        arm, drag = self.loop.arm, ca.SX(*qdot.shape)
        if np.any(arm.damping):
            drag += ca.DM(arm.damping) * qdot
        if np.any(arm.friction):
            drag += ca.DM(arm.friction) * ca.tanh(qdot / COULOMB_SPEED)
        return drag

    def normal_gradient(self, uv: ca.SX, centre: ca.SX) -> ca.SX:
        """dn/dc (3, 3), 1/m, of the contact normal by the indenter's centre, body frame, by
        automatic differentiation."""
        c = ca.SX.sym("c", 3)
        contact = surface_contact(self.anchor, uv, c, self.p, self.loop.contact, self.newton)
        return ca.substitute(ca.jacobian(contact.normal, c), c, centre)

    def derivative(self) -> ca.Function:
        """(q, qdot, contact state, ahead, reference, anchor, parameters) -> (acceleration, next
        contact state, output)."""
        n = self.loop.joints
        sizes = {"q": n, "qdot": n, "contact_state": self.loop.memory + 2, "ahead": 1}
        state = [ca.SX.sym(name, k) for name, k in sizes.items()]
        now = self.at(*state)
        return ca.Function(
            "derivative",
            [*state, *self.inputs],
            [now.acceleration, now.contact_state, now.output],
            {"cse": True},
        )


def shift_jacobian(jacobian: ca.SX, lever: ca.SX) -> ca.SX:
    """Jacobian (6, n), linear part first, of the point displaced by `lever` (3,), world axes."""
    return ca.vertcat(jacobian[:3, :] - ca.skew(lever) @ jacobian[3:, :], jacobian[3:, :])
