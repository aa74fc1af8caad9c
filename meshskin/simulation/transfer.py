"""Moves through the air from one posture to another: up, over in joint space, and down.

Up is where the indenter points.

Between places the arm is not under the compliance law but under its own joint controllers, which
follow a smooth way between the joint angles; their torque is that of inverse dynamics.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ..core.content_cache import cached_by_content
from ..core.errors import ReachError
from ..core.se3 import Array
from ..exploration.path import time_scaling
from ..geometry.body import Body
from ..geometry.surface.closest_point import Closest
from ..robot.arm import Arm
from .closed_loop_model import ClosedLoopModel
from .penetration import centres, poses

HEIGHTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Heights tried over which the body is lifted before the joints turn, m."""
RISE = 0.01
"""Distance of the poses on the way up and down, m."""
SHARE = 0.4
"""Part of the joints' speed limits that is used."""
SLOWEST = 1.0
"""Speed of a joint without a limit, rad/s."""
RAMP = 0.2
"""Time to speed up and to slow down, s."""
GAP = 1e-3
"""Least distance of body and indenter on the way, m."""
LOOKS = 60
"""Poses of the way at which the distance is taken."""
BENDS = (-0.5, 1.0)
"""Curvatures, in parts of the indenter's, between which a force is told while a body lifts off."""


def way(loop: ClosedLoopModel, body: Body, start: Array, goal: Array) -> Array:
    """Joint angles (k, n), one row a step, from `start` (n,) to `goal` (n,), both in the air.

    The lowest way that keeps the body off the loop's indenter, and the joints within their limits.
    Raises ReachError if none does.
    """
    from scipy.interpolate import PchipInterpolator

    arm = loop.arm
    rate = np.minimum(SHARE * arm.velocity_limit, SLOWEST)
    for height in HEIGHTS:
        try:
            up, down = (lifted_off(loop, q, height) for q in (start, goal))
        except ReachError:
            continue
        points = np.concatenate([up, down[::-1]])
        points = points[
            np.concatenate([[True], np.abs(np.diff(points, axis=0)).max(axis=1) > 1e-9])
        ]
        if len(points) < 2:
            return goal[None]
        seconds = np.concatenate(
            [[0.0], np.cumsum((np.abs(np.diff(points, axis=0)) / rate).max(1))]
        )
        line = PchipInterpolator(seconds, points)  # never beyond its points
        look = line(np.linspace(0.0, seconds[-1], LOOKS))
        within = (look >= arm.lower).all() and (look <= arm.upper).all()
        if within and clearance(loop, body, look) > loop.indenter_radius + min(GAP, height + 1e-4):
            return np.asarray(line(time_scaling(seconds[-1], RAMP, loop.dt) * seconds[-1]))
    raise ReachError(
        f"{arm.name} cannot get over the indenter from one posture to the next",
        value=f"joint angles {start.round(3).tolist()} to {goal.round(3).tolist()} rad",
        limit=f"{HEIGHTS[-1]} m of lift",
        remedy="lower the indenter, or explore a smaller region",
    )


def lifted_off(loop: ClosedLoopModel, q: Array, height: float) -> Array:
    """Joint angles (k, n) from `q` (n,) with the tip carried straight up by `height`, m."""
    arm = loop.arm
    if height == 0.0:
        return q[None]
    rise = np.linspace(0.0, height, max(int(np.ceil(height / RISE)), 1) + 1)
    poses = np.repeat(arm.pose(q)[None], len(rise), axis=0)
    poses[:, :3, 3] += rise[:, None] * loop.indenter_direction
    return np.concatenate([q[None], arm.inverse_kinematics(poses, q)[1:]])


def clearance(loop: ClosedLoopModel, body: Body, q: Array) -> float:
    """Least distance, m, of the body's surface from the indenter's centre in q (k, n)."""
    return float(body.closest(centres(loop, poses(loop, q))).distance.min())


def pressed(loop: ClosedLoopModel, hit: Closest, depth: Array) -> Array:
    """Outputs (k, m), see Loop.outputs, of the contact where the body is carried; no torques.

    hit: the body's points (k) next to the indenter; depth (k,), m: how deep it is in.
    """
    force = np.zeros(len(depth))
    rows = np.flatnonzero(depth > 0)
    if len(rows):  # over a hollow or an edge the lifting passes, no model holds
        force[rows] = loop.contact.force(
            depth=depth[rows],
            curvature=np.clip(hit.curvature[rows], *np.array(BENDS) / loop.indenter_radius),
            indenter_radius=loop.indenter_radius,
            effective_modulus=loop.effective_modulus,
        )
    columns = {
        "point": hit.point,
        "normal": hit.normal,
        "force": force[:, None],
        "depth": depth[:, None],
        "radius": 1.0 / (hit.curvature.mean(axis=1) + 1.0 / loop.indenter_radius)[:, None],
    }
    outputs = np.zeros((len(depth), loop.outputs["torque"].stop))
    for name, column in columns.items():
        outputs[:, loop.outputs[name]] = column
    return outputs


def torques(loop: ClosedLoopModel, q: Array) -> Array:
    """Joint torques (k, n), N m, along joint angles (k, n), one row a step, within their limits."""
    rates = np.gradient(q, loop.dt, axis=0)
    bends = np.gradient(rates, loop.dt, axis=0)
    wanted = inverse_dynamics(loop.arm)(q.T, rates.T, bends.T).full().T
    return np.clip(wanted, -loop.arm.effort_limit, loop.arm.effort_limit)


@cached_by_content
def inverse_dynamics(arm: Arm) -> ca.Function:
    """(q, qd, qdd) -> joint torques (n,), N m, of a motion in the air."""
    n = len(arm.joint_names)
    q, qd, qdd = (ca.SX.sym(name, n) for name in ("q", "qd", "qdd"))
    model = arm.dynamics()
    torque = model.mass_matrix(q) @ qdd + model.bias(q, qd)
    return ca.Function("inverse_dynamics", [q, qd, qdd], [torque], {"cse": True})
