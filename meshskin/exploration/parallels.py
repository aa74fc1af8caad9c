"""The paper's exploration: parallels about the skin's axis, back and forth over the fixed indenter.

The contact point follows parallels of the surface normal about the skin's mean normal. The arm sets
the polar angle; the spin about the skin's axis sets the azimuth, which runs from -180 to 180
degrees on one lane and back on the next, so that the last joint does not wind up. At every sample
the outward normal at the contact point opposes the indenter's direction.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.arrays import Array
from ..core.errors import ReachError, SimulationError
from ..core.se3 import exp_so3, inverse, orthonormal_basis, perpendicular, transform
from ..scene.scene import Scene
from ..scene.settings import Exploration
from .path import Path, body_twists, start_configuration, time_scaling

HEADINGS = 8
"""Directions about the indenter that are tried for the first meridian: every 45 degrees. Chosen."""
COARSE = 50
"""Stride, in steps of the loop, of the paths that are tried: 2.5 mm at 50 mm/s and 1 ms."""
CHECKS = 400
"""Samples of a trial path at which the joint angles are solved, at least, where it has as many:
the paper's sphere has 474."""
SPHERICITY = 0.02
"""Largest relative deviation of the taxels' curvatures from their mean on a sphere: 25 times that
of a sphere meshed with 1,280 faces (8e-4; 5e-5 with 5,120)."""


def is_cap(scene: Scene) -> bool:
    """Whether the skin lies on a sphere: convex, with equal curvatures at all taxels."""
    curvature = scene.body.closest(scene.skin.positions).curvature
    mean = float(curvature.mean())
    return bool(mean > 0 and np.abs(curvature - mean).max() < SPHERICITY * mean)


def reachable_parallels(scene: Scene) -> Path:
    """The parallels whose heading keeps the arm farthest from its joint limits.

    Raises ReachError, with the reason of the first heading, if the arm cannot follow any.
    """
    arm, tip_body = scene.arm, inverse(scene.mount_pose)
    best: tuple[float, float, Array] | None = None
    reason: ReachError | None = None
    for heading in np.arange(HEADINGS) * 2 * np.pi / HEADINGS:
        trial = parallels(scene, heading, COARSE * scene.loop.dt)
        rows = slice(None, None, max(len(trial.poses) // CHECKS, 1))
        poses = trial.poses[rows] @ tip_body
        middle = _middle(trial.normals[rows], scene.axis)
        try:
            # back along the path itself: a half turn straight to the start is ambiguous
            first = arm.inverse_kinematics(poses[middle::-1], arm.solve(poses[middle]))[-1]
            q = arm.inverse_kinematics(poses, first)
            start_configuration(scene, replace(trial, postures=first[None]))
        except ReachError as error:
            reason = reason or error
            continue
        margin = float(np.minimum(q - arm.lower, arm.upper - q).min())
        if best is None or margin > best[0]:
            best = margin, heading, first
    if best is None:
        raise ReachError(
            f"the arm {arm.name} cannot turn the skin over the indenter at "
            f"{tuple(round(float(x), 3) for x in scene.indenter.position)} m: {reason}",
            remedy="move indenter.position_m, change the mount, or set exploration.pattern lanes",
        ) from reason
    _, heading, first = best
    return replace(parallels(scene, heading, scene.loop.dt), postures=first[None])


def _middle(normals: Array, axis: Array) -> int:
    """The sample, of normals (k, 3) along parallels, about halfway and at azimuth zero.

    From there the last joint has equally far to go either way.
    """
    e1, e2, _ = orthonormal_basis(axis, perpendicular(axis)).T
    azimuth, count = np.abs(np.arctan2(normals @ e2, normals @ e1)), len(normals)
    return int(np.argmin(azimuth + np.abs(np.arange(count) / count - 0.5)))


def parallels(scene: Scene, heading: float, dt: float) -> Path:
    """The path along the parallels, without postures.

    heading: angle of the first meridian about the indenter's direction, rad; dt: period, s. Raises
    SimulationError if the surface is flat or concave at the skin's centre, ReachError where the
    body is not convex about the skin.
    """
    body, axis, exploration = scene.body, scene.axis, scene.exploration
    centre = body.surface.bounds.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(body.surface.bounds, axis=0)))
    at = body.closest(scene.skin.positions)
    _check_convex(body.closest(at.point + 10 * size * at.normal).point - at.point, exploration, dt)
    pole = body.closest((centre + size * axis)[None])
    radius = 1.0 / max(float(pole.curvature.mean()), 1e-6)
    if radius > size:
        raise SimulationError(
            "parallels need a convex skin", value=f"radius {radius:.3g} m at its centre",
            limit=f"the body's size {size:.3g} m", remedy="give a convex skin region",
        )  # fmt: skip
    extent = float(np.arccos(np.clip(scene.skin.normals @ axis, -1.0, 1.0).min()))
    polar = polar_angles(extent, radius, exploration)
    polar, azimuth = lane_angles(polar, radius, exploration, dt).T[:, :, None]
    e1, e2, _ = orthonormal_basis(axis, perpendicular(axis)).T
    s = np.sin(polar)
    wanted = np.cos(polar) * axis + s * np.cos(azimuth) * e1 + s * np.sin(azimuth) * e2
    # the closest point of a convex body to a distant point has about the direction's normal
    hit = body.closest(centre + 10 * size * wanted)
    _check_convex(np.diff(hit.point, axis=0), exploration, dt)
    rotations = scene.indenter.rotation @ body_rotations(hit.normal, axis, heading)
    centres = scene.rig.indenter_centres(hit.point, hit.normal)
    positions = np.array(scene.indenter.position) - np.einsum("kij,kj->ki", rotations, centres)
    poses = transform(rotations, positions)
    return Path(dt, hit.point, hit.normal, poses, body_twists(poses, dt), hit.face)


def _check_convex(shifts: Array, exploration: Exploration, dt: float) -> None:
    """Raise ReachError for a shift (k, 3), m, to the outermost place of another part of the body:
    from a taxel in the direction of its normal, or from one row of a path to the next."""
    limit = exploration.lane_spacing + 2.0 * exploration.speed * dt
    longest = float(np.linalg.norm(shifts, axis=1).max())
    if longest > limit:
        raise ReachError(
            "parallels need a body that is convex about the skin: they lead to another part of it",
            value=f"{1e3 * longest:.3g} mm away", limit=f"{1e3 * limit:.3g} mm",
            remedy="set exploration.pattern lanes",
        )  # fmt: skip


def polar_angles(extent: float, radius: float, exploration: Exploration) -> Array:
    """Polar angles of the lanes, rad, for a skin up to the polar angle `extent`, rad.

    radius: mean radius of curvature along the meridian, m.
    """
    last = extent + exploration.margin / radius
    pitch = exploration.lane_spacing / radius
    count = max(int(np.ceil(last / pitch)), 2)
    return np.asarray((np.arange(count) + 0.5) * last / (count - 0.5), dtype=float)


def lane_angles(polar: Array, radius: float, exploration: Exploration, dt: float) -> Array:
    """Polar angle and azimuth (k, 2), rad, of the contact's normal, every `dt` s."""

    def cruise(angle: float, lever: float) -> float:
        return max(angle * lever / exploration.speed, angle / exploration.turn_rate)

    angles = [np.array([[polar[0], -np.pi]])]
    for k, theta in enumerate(polar):
        start = -np.pi if k % 2 == 0 else np.pi
        s = time_scaling(cruise(2 * np.pi, radius * np.sin(theta)), exploration.ramp, dt)
        angles.append(np.stack([np.full_like(s, theta), start * (1 - 2 * s)], axis=1))
        if k + 1 < len(polar):
            step = polar[k + 1] - theta
            s = time_scaling(cruise(step, radius), exploration.ramp, dt)
            angles.append(np.stack([theta + step * s, np.full_like(s, -start)], axis=1))
    return np.concatenate(angles)


def body_rotations(normals: Array, axis: Array, heading: float) -> Array:
    """Rotations (k, 3, 3) of the body in the indenter's frame with normals (k, 3) along its -z.

    A spin about the skin's axis turns the normal into one meridian, then a tilt lowers it;
    `heading`, rad, is the direction of that meridian about the frame's z.
    """
    basis = orthonormal_basis(axis, perpendicular(axis))
    e1, e2, _ = basis.T
    polar = np.arctan2(np.hypot(normals @ e1, normals @ e2), normals @ axis)
    azimuth = np.unwrap(np.arctan2(normals @ e2, normals @ e1))
    h = np.array([np.cos(heading), np.sin(heading), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    side = np.cross(down, h)
    # columns: images of e1, e2 and axis without tilt
    untilted = np.stack([h, side, down], axis=1) @ basis.T
    tilt, spin = exp_so3(-polar[:, None] * side), exp_so3(-azimuth[:, None] * axis)
    return np.asarray(tilt @ untilted @ spin)
