"""One step of the closed loop, as a CasADi expression of the scene's parts.

Arm dynamics, the local surface patch, Hertz contact, the compliance law, the torque and a
semi-implicit Euler integration, in one function; `Blocks` maps it over many steps. The surface
enters as the coefficients of one face's patch (parameters), the foot of the indenter's centre on it
as a state, so that a step costs the same on any mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from ..geometry.patch import POWERS, casadi_foot
from ..physics.contact import hertz
from ..se3 import Array
from . import law as compliance
from .law import Law

if TYPE_CHECKING:
    from .arm import Arm

REFERENCE = 18  # body position 3, body rotation 9 (columns), velocity 3, angular velocity 3
ROTATION_DAMPING = 0.02
FORCE_DAMPING = 1e-6
"""Row dampings of the inverses, in m; damping costs path accuracy, hence the rotation rows only."""


@dataclass(frozen=True)
class Loop:
    """What the step function needs to know of a scene."""

    arm: Arm
    """The arm with its payload."""
    mount: Array
    """T_tip_body (4, 4)."""
    indenter_position: Array
    """Centre of the indenter (3,), world, m."""
    indenter_radius: float
    effective_modulus: float
    """E*, Pa."""
    law: Law
    dt: float
    """Step, s."""

    @property
    def joints(self) -> int:
        """Number of joints n."""
        return len(self.arm.joint_names)

    @property
    def outputs(self) -> dict[str, slice]:
        """Rows of a step's output: contact point and normal (body frame), force, depth, torques."""
        n = self.joints
        return {
            "point": slice(0, 3),
            "normal": slice(3, 6),
            "force": slice(6, 7),
            "depth": slice(7, 8),
            "torque": slice(8, 8 + n),
        }


def reference_depth(loop: Loop, radius: ca.SX) -> ca.SX:
    """Depth delta at which Hertz gives the reference force; `radius` relative, m."""
    return (0.75 * loop.law.force_reference / loop.effective_modulus) ** (2 / 3) / radius ** (1 / 3)


def step(loop: Loop) -> ca.Function:
    """One step: (state, reference, patch) -> (next state, output).

    state (2 n + 2): q, qdot, (u, v) of the foot; reference (18,): pose and twist of the body along
    the path (world); patch (63,): the face's coefficients, column-major (21, 3); output as
    Loop.outputs says.
    """
    n = loop.joints
    state, reference = ca.SX.sym("state", 2 * n + 2), ca.SX.sym("reference", REFERENCE)
    patch = ca.SX.sym("patch", len(POWERS), 3)
    q, qdot, u, v = state[:n], state[n : 2 * n], state[2 * n], state[2 * n + 1]

    model = loop.arm.dynamics()
    mass, bias = model.mass_matrix(q), model.bias(q, qdot)
    pose = model.pose(q) @ ca.DM(loop.mount)
    rotation, position = pose[:3, :3], pose[:3, 3]
    shift = position - model.pose(q)[:3, 3]
    jacobian = _at(model.jacobian(q), shift)

    centre = rotation.T @ (ca.DM(loop.indenter_position) - position)
    u, v, point, normal, curvature = casadi_foot(patch, u, v, centre)
    depth = loop.indenter_radius - ca.dot(normal, centre - point)
    mean = 0.5 * (curvature[0] + curvature[1])
    radius = 1.0 / (mean + 1.0 / loop.indenter_radius)
    force = hertz.force(ca.fmax(depth, 0.0), radius, loop.effective_modulus)

    n_w, lever = rotation @ normal, rotation @ point
    # the paper's sphere: the Jacobian of the (osculating) sphere's centre; flat bodies are capped
    hub = lever - n_w / ca.fmax(mean, 1.0)
    stiffness = 4.0 / 3.0 * loop.effective_modulus * ca.sqrt(radius)
    speed = compliance.force_speed(loop.law, stiffness, depth, force, reference_depth(loop, radius))
    qdot_f = compliance.damped_inverse(
        _at(jacobian, hub)[:3, :], ca.DM([FORCE_DAMPING] * 3), speed * n_w
    )
    twist = _exploration(loop.law, reference, position, rotation, lever, n_w)
    rows = ca.DM([FORCE_DAMPING] * 3 + [ROTATION_DAMPING] * 3)
    qdot_r = compliance.damped_inverse(_at(jacobian, lever), rows, twist)

    push = -_at(jacobian, lever)[:3, :].T @ (force * n_w)
    gain = compliance.velocity_gain(loop.law, mass)
    torque = bias - gain @ (qdot - qdot_f - qdot_r)
    if loop.law.torque == "compensated":
        torque -= push
    upper = ca.chol(mass)
    qddot = ca.solve(upper, ca.solve(upper.T, torque + push - bias))
    qdot_next = qdot + loop.dt * qddot
    q_next = q + loop.dt * qdot_next

    return ca.Function(
        "step",
        [state, reference, ca.vec(patch)],
        [ca.vertcat(q_next, qdot_next, u, v), ca.vertcat(point, normal, force, depth, torque)],
        ["state", "reference", "patch"],
        ["next", "output"],
        {"cse": True},
    )


def _at(jacobian: ca.SX, lever: ca.SX) -> ca.SX:
    """Jacobian (6, n), linear first, of the point displaced by `lever` (world axes)."""
    return ca.vertcat(jacobian[:3, :] - ca.skew(lever) @ jacobian[3:, :], jacobian[3:, :])


def _exploration(
    law: Law, reference: ca.SX, position: ca.SX, rotation: ca.SX, lever: ca.SX, normal: ca.SX
) -> ca.SX:
    """Twist (6,) at the contact point that follows the path, kept out of the force's direction."""
    goal = ca.reshape(reference[3:12], 3, 3)
    turn = 0.5 * sum(ca.cross(rotation[:, k], goal[:, k]) for k in range(3))
    omega = reference[15:18] + law.tracking * turn
    velocity = reference[12:15] + law.tracking * (reference[:3] - position)
    velocity += ca.cross(omega, lever)
    return ca.vertcat(velocity - normal * ca.dot(normal, velocity), omega)


class Blocks:
    """The step function mapped over `length` steps, called without CasADi's Python overhead."""

    def __init__(self, loop: Loop, length: int) -> None:
        one = step(loop)
        self.length, self.loop = length, loop
        state = ca.MX.sym("state", one.size1_in(0))
        references = ca.MX.sym("references", REFERENCE, length)
        patch = ca.MX.sym("patch", one.size1_in(2))
        mapped = one.mapaccum("steps", length)
        states, outputs = mapped(state, references, ca.repmat(patch, 1, length))
        function = ca.Function("block", [state, references, patch], [states, outputs])
        self.state = np.zeros(one.size1_in(0))
        self.references = np.zeros((length, REFERENCE))
        self.patch = np.zeros(one.size1_in(2))
        self.states = np.zeros((length, one.size1_out(0)))
        self.outputs = np.zeros((length, one.size1_out(1)))
        # the buffer keeps the addresses, so the arrays must stay the same objects
        self._buffer, self._run = function.buffer()
        for k, array in enumerate((self.state, self.references, self.patch)):
            self._buffer.set_arg(k, memoryview(array))
        for k, array in enumerate((self.states, self.outputs)):
            self._buffer.set_res(k, memoryview(array))
        self.instructions = one.n_instructions()

    @property
    def run(self) -> Callable[[], None]:
        """Run the block: read state, references, patch; fill states (after), outputs (before)."""
        return self._run  # type: ignore[no-any-return]
