"""The closed loop without an arm: the body moves exactly as the compliance law asks.

State (9): position of the body's origin (3), its orientation as a unit quaternion (w, x, y, z), the
foot (u, v). Euler steps of the position, steps on the unit sphere of the quaternion.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ..core.se3 import Array
from . import law as compliance
from .closed_loop_model import ANCHOR, PARAMETERS, REFERENCE, ClosedLoopModel, Parameters
from .delayed_reading import delayed_reading, kept
from .integrators import NAMES
from .surface_contact import touch


def step(loop: ClosedLoopModel) -> ca.Function:
    """(state, reference, anchor, parameters) -> (next state, output), as the integrators' step."""
    state, reference, anchor, parameters = (
        ca.SX.sym(name, k)
        for name, k in zip(NAMES[0], (9 + loop.memory, REFERENCE, ANCHOR, PARAMETERS), strict=True)
    )
    p = Parameters.split(parameters)
    position, turn, memory, uv = state[:3], state[3:7], state[7:-2], state[-2:]
    rotation = matrix(turn)
    t = touch(anchor, uv, rotation.T @ (ca.DM(loop.indenter_position) - position), p, loop.contact)
    normal, lever = rotation @ t.normal, rotation @ t.point
    reading, believed = delayed_reading(memory, t), t.believed(loop.law.effective_modulus)
    firm = believed.slope_at(compliance.floored(reading.depth, believed.reference_depth))
    speed = (1.0 - p.free) * compliance.force_speed(p, firm, reading.depth, reading.force)
    omega, velocity = compliance.along(
        reference, p.tracking, position, rotation, lever, normal, p.free
    )
    # the law's speed is that of the contact point; the body's origin is at -lever from it
    origin = velocity + speed * normal - ca.cross(omega, lever)
    rate = 0.5 * ca.vertcat(-ca.dot(turn[1:], omega), turn[0] * omega + ca.cross(omega, turn[1:]))
    after = turn + p.dt * rate
    after /= ca.norm_2(after)
    return ca.Function(
        "step",
        [state, reference, anchor, parameters],
        [
            ca.vertcat(position + p.dt * origin, after, kept(memory, t), t.u, t.v),
            ca.vertcat(t.point, t.normal, t.force, t.depth, t.radius),
        ],
        *NAMES,
        {"cse": True},
    )


def matrix(q: ca.SX) -> ca.SX:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = (q[k] for k in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def start(pose: Array) -> Array:
    """The state's first seven numbers for a body at T_w_b (4, 4)."""
    r = pose[:3, :3]
    # the eigenvector of the largest eigenvalue is the quaternion, whatever the angle
    k = np.array(
        [
            [np.trace(r), r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0.0, 2 * r[0, 0] - np.trace(r), r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0.0, 0.0, 2 * r[1, 1] - np.trace(r), r[1, 2] + r[2, 1]],
            [0.0, 0.0, 0.0, 2 * r[2, 2] - np.trace(r)],
        ]
    )
    return np.concatenate([pose[:3, 3], np.linalg.eigh(k.T)[1][:, -1]])
