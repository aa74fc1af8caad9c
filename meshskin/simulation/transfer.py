"""Motion through the air: depth of the indenter in the body, and paths from posture to posture.

A path goes up (where the indenter points), over in joint space, and down. Between places the arm is
not under the compliance law but under its own joint controllers, which follow a smooth joint path;
their torque is that of inverse dynamics.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ..core.arrays import Array
from ..core.content_cache import cached_by_content
from ..core.errors import ReachError
from ..core.se3 import interpolate, inverse, log_so3, transform
from ..exploration.path import time_scaling
from ..geometry.body import Body
from ..geometry.surface.closest_point import Closest
from ..robot import turntable
from ..robot.arm import Arm
from .closed_loop_model import ClosedLoopModel

HEIGHTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Heights, m, that are tried, the lowest first, by which the body is lifted before the joints turn.
"""
RISE_STEP = 0.01
"""Distance, m, of the poses of the lift for which inverse kinematics is solved."""
SPEED_FRACTION = 0.4
"""Part of the joints' speed limits that is used."""
MAX_JOINT_SPEED = 1.0
"""Largest joint speed, rad/s, also of a joint without a limit."""
RAMP = 0.2
"""Time to speed up and to slow down, s: with MAX_JOINT_SPEED an acceleration of some 8 rad/s^2."""
AIR_SPEED, AIR_TURN_RATE = 0.1, 1.0
"""Largest speeds of a body that is moved without an arm, m/s and rad/s."""
MIN_CLEARANCE = 1e-3
"""Least distance of body and indenter on the path, m."""
CLEARANCE_SAMPLES = 60
"""Poses of the path at which the distance and the joints' ranges are checked."""
CURVATURE_RANGE = (-0.5, 1.0)
"""Curvatures of the body, relative to the indenter's, to which they are clipped for the force while
a body lifts off: over a hollow or an edge that it passes, no contact model holds."""


def penetration(loop: ClosedLoopModel, body: Body, poses: Array) -> tuple[Closest, Array]:
    """The body's points (k) closest to the indenter at T_w_b (k, 4, 4), and its depth (k,), m.

    On an open surface the distance is unsigned: far from it, its sign has no meaning.
    """
    centres = loop.indenter_centres(poses)
    if body.surface.closed:
        hit = body.closest(centres)
        return hit, loop.indenter_radius - hit.distance
    hit = body.surface.nearest(centres)
    return hit, loop.indenter_radius - np.abs(hit.distance)


def joint_path(loop: ClosedLoopModel, body: Body, start: Array, goal: Array) -> Array:
    """Joint angles (k, n), one row a step, from `start` (n,) to `goal` (n,), both in the air.

    The lowest path that keeps the body off the loop's indenter, and the joints within their ranges.
    Raises ReachError if there is none among HEIGHTS.
    """
    from scipy.interpolate import PchipInterpolator

    arm = loop.arm
    rate = np.minimum(SPEED_FRACTION * arm.velocity_limit, MAX_JOINT_SPEED)
    for height in HEIGHTS:
        try:
            up, down = (lift_path(loop, q, height) for q in (start, goal))
        except ReachError:
            continue
        points = np.concatenate([up, down[::-1]])
        moves = np.abs(np.diff(points, axis=0)).max(axis=1) > 1e-9
        points = points[np.concatenate([[True], moves])]
        if len(points) < 2:
            return goal[None]
        durations = (np.abs(np.diff(points, axis=0)) / rate).max(axis=1)
        seconds = np.concatenate([[0.0], np.cumsum(durations)])
        curve = PchipInterpolator(seconds, points)  # monotone: never beyond its points
        samples = curve(np.linspace(0.0, seconds[-1], CLEARANCE_SAMPLES))
        within = (samples >= arm.lower).all() and (samples <= arm.upper).all()
        wanted = loop.indenter_radius + min(MIN_CLEARANCE, height + 1e-4)
        centres = loop.indenter_centres(loop.body_poses(samples))
        if within and body.closest(centres).distance.min() > wanted:
            return np.asarray(curve(time_scaling(seconds[-1], RAMP, loop.dt) * seconds[-1]))
    raise ReachError(
        f"{arm.name} has no collision-free path over the indenter to the next posture",
        value=f"joint angles {start.round(3).tolist()} to {goal.round(3).tolist()} rad",
        limit=f"{HEIGHTS[-1]} m of lift",
        remedy="lower the indenter, or explore a smaller region",
    )


def lift_path(loop: ClosedLoopModel, q: Array, height: float) -> Array:
    """Joint angles (k, n) from `q` (n,) with the tip moved by `height`, m, where the indenter
    points."""
    if height == 0.0:
        return q[None]
    rise = np.linspace(0.0, height, max(int(np.ceil(height / RISE_STEP)), 1) + 1)
    tips = np.repeat(loop.arm.pose(q)[None], len(rise), axis=0)
    tips[:, :3, 3] += rise[:, None] * loop.indenter_direction
    line = loop.indenter_position, loop.indenter_direction
    return np.concatenate([q[None], turntable.follow(loop.arm, tips, q, *line)[1:]])


def contact_outputs(loop: ClosedLoopModel, hit: Closest, depth: Array) -> Array:
    """Outputs (k, m), see ClosedLoopModel.outputs, of a body that is moved; torques are zero.

    hit: the body's points (k) closest to the indenter; depth (k,), m.
    """
    force = np.zeros(len(depth))
    rows = np.flatnonzero(depth > 0)
    if len(rows):
        force[rows] = loop.contact.force(
            depth=depth[rows],
            curvature=np.clip(
                hit.curvature[rows], *np.array(CURVATURE_RANGE) / loop.indenter_radius
            ),
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


def transfer_torques(loop: ClosedLoopModel, q: Array) -> Array:
    """Joint torques (k, n), N m, along joint angles (k, n), one row a step, within their limits."""
    speed = np.gradient(q, loop.dt, axis=0)
    acceleration = np.gradient(speed, loop.dt, axis=0)
    wanted = inverse_dynamics(loop.arm)(q.T, speed.T, acceleration.T).full().T
    return np.clip(wanted, -loop.arm.effort_limit, loop.arm.effort_limit)


@cached_by_content
def inverse_dynamics(arm: Arm) -> ca.Function:
    """(q, qd, qdd) -> joint torques (n,), N m, of a motion in the air."""
    n = len(arm.joint_names)
    q, qd, qdd = (ca.SX.sym(name, n) for name in ("q", "qd", "qdd"))
    model = arm.dynamics()
    torque = model.mass_matrix(q) @ qdd + model.bias(q, qd)
    return ca.Function("inverse_dynamics", [q, qd, qdd], [torque], {"cse": True})


def raised(pose: Array, shift: Array) -> Array:
    """A pose (4, 4) shifted by (3,), world frame, m."""
    raised = pose.copy()
    raised[:3, 3] += shift
    return raised


def blend(start: Array, end: Array, dt: float, middle: Array | None = None) -> Array:
    """Poses (k, 4, 4) from one to another, one a step, with a speed of half a sine wave.

    middle (3,), m, body frame: what moves on a straight line, and the body turns about; by default
    its origin, which may be far from it.
    """
    carried = transform(np.eye(3), np.zeros(3) if middle is None else middle)
    start, end = start @ carried, end @ carried
    angle = float(np.linalg.norm(log_so3(end[:3, :3] @ start[:3, :3].T)))
    distance = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
    time = 0.5 * np.pi * max(distance / AIR_SPEED, angle / AIR_TURN_RATE)
    count = max(int(np.ceil(time / dt)), 2)
    part = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, count))
    return np.asarray(interpolate(start, end, part) @ inverse(carried))
