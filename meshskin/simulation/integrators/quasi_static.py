"""The closed loop without an arm: the body moves exactly at the velocity of the compliance law.

State (9 + memory,): position of the body's origin (3), its orientation as a unit quaternion
(w, x, y, z), the delayed measurements, the foot point (u, v). Explicit Euler steps; the quaternion
is normalized after each.
"""

from __future__ import annotations

import casadi as ca

from ...core.se3 import casadi_rotation
from .. import law as compliance
from ..closed_loop_model import ANCHOR, PARAMETERS, REFERENCE, ClosedLoopModel, Parameters
from ..surface_contact import delayed_reading, shift_memory, surface_contact
from . import NAMES, step_function


def step(loop: ClosedLoopModel) -> ca.Function:
    """The step (state, reference, anchor, parameters) -> (next state, output)."""
    inputs = [
        ca.SX.sym(name, k)
        for name, k in zip(NAMES[0], (9 + loop.memory, REFERENCE, ANCHOR, PARAMETERS), strict=True)
    ]
    state, reference, anchor, parameters = inputs
    p = Parameters.split(parameters)
    position, turn, memory, uv = state[:3], state[3:7], state[7:-2], state[-2:]
    rotation = casadi_rotation(ca.vertcat(turn[1:], turn[0]))
    centre = rotation.T @ (ca.DM(loop.indenter_position) - position)
    contact = surface_contact(anchor, uv, centre, p, loop.contact)
    normal, lever = rotation @ contact.normal, rotation @ contact.point
    depth, force = delayed_reading(memory, contact)
    assumed = contact.with_modulus(loop.law.effective_modulus)
    slope = assumed.slope_at(compliance.slope_depth(depth, assumed.reference_depth))
    speed = (1.0 - p.track_normal) * compliance.force_speed(p, slope, depth, force)
    omega, velocity = compliance.path_twist(
        reference, p.tracking, position, rotation, lever, normal, p.track_normal
    )
    # the law's velocity is that of the contact point; the body's origin is at -lever from it
    velocity += speed * normal - ca.cross(omega, lever)
    rate = 0.5 * ca.vertcat(-ca.dot(turn[1:], omega), turn[0] * omega + ca.cross(omega, turn[1:]))
    turned = turn + p.dt * rate
    turned /= ca.norm_2(turned)
    moved = (position + p.dt * velocity, turned, shift_memory(memory, contact))
    return step_function(inputs, ca.vertcat(*moved, contact.u, contact.v), contact.output)
