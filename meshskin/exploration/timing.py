"""Time along a contact path: as slow as the limits of speed, rotation and joints require."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..core.arrays import Array
from ..core.errors import ReachError
from ..core.se3 import log_so3
from ..geometry.geodesics import rotate_about, transport_along
from ..robot.contact_rig import ContactRig
from ..scene.settings import Exploration
from .path import Path, body_twists, time_scaling
from .tour import ContactPath

SPIN_WIDTHS = (6.0, 2.0, 0.0)
"""Standard deviations, in samples, of the Gaussian filter of the spin: the first that the joints
allow is taken. The spins are those of a grid of 15 degrees; 6 samples blur its steps."""
POSE_WIDTH = 0.015
"""Standard deviation, s, of the Gaussian filter of the body's pose: over a seam of the surface the
normal turns with a jerk that the body need not follow."""


def free_path(rig: ContactRig, path: ContactPath, exploration: Exploration, dt: float) -> Path:
    """The path over one contact path of a body without an arm, every `dt` s."""
    joints = np.zeros((len(path), 0))
    return _path(rig, path, transport_along(path.normals), joints, None, exploration, dt)


def arm_path(
    rig: ContactRig,
    path: ContactPath,
    tangents: Array,
    spin: Array,
    posture: Array,
    exploration: Exploration,
    dt: float,
) -> Path:
    """The path over one contact path that an arm follows from a posture (n,), every `dt` s.

    tangents (k, 3): headings at spin 0; spin (k,), rad, is smoothed as far as the joints allow.
    Raises ReachError.
    """
    from scipy.ndimage import gaussian_filter1d

    for width in SPIN_WIDTHS:
        smooth = gaussian_filter1d(spin, width, mode="nearest") if width else spin
        headings = rotate_about(path.normals, tangents, smooth)
        poses = rig.contact_poses(path.points, path.normals, headings)
        try:
            q, held = rig.follow(poses, posture)
            if held is not poses:
                headings = rig.headings(held)
            return _path(rig, path, headings, q, q[:1], exploration, dt)
        except ReachError as error:
            reason = error
    raise reason


def _path(
    rig: ContactRig,
    path: ContactPath,
    headings: Array,
    q: Array,
    posture: Array | None,
    exploration: Exploration,
    dt: float,
) -> Path:
    """The path in time over samples with headings (k, 3) and joint angles (k, n)."""
    from scipy.interpolate import PchipInterpolator, make_interp_spline
    from scipy.ndimage import gaussian_filter1d

    slowness, length = _slowness(rig, path, headings, q, exploration)
    rows = np.concatenate([path.points, headings], axis=1)
    parts = [rows[:1]]
    for start, end in pairwise(path.stops):
        s = np.concatenate([[0.0], np.cumsum(length[start:end])])
        t = np.concatenate([[0.0], np.cumsum((slowness * length)[start:end])])
        at = PchipInterpolator(t, s)(time_scaling(t[-1], exploration.ramp, dt) * t[-1])
        parts.append(make_interp_spline(s, rows[start : end + 1], k=min(3, end - start))(at))
    samples = np.concatenate(parts)
    hit = rig.body.surface.nearest(samples[:, :3])
    centres, normals, tangents = (
        gaussian_filter1d(x, POSE_WIDTH / dt, axis=0, mode="nearest")
        for x in (rig.indenter_centres(hit.point, hit.normal), hit.normal, samples[:, 3:])
    )
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    tangents -= np.einsum("ij,ij->i", tangents, normals)[:, None] * normals
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    poses = rig.poses(centres, normals, tangents)
    if posture is not None:
        poses = rig.held_poses(poses, posture[0])
    twists = body_twists(poses, dt)
    return Path(dt, hit.point, hit.normal, poses, twists, hit.face, (), posture)


def _slowness(
    rig: ContactRig, path: ContactPath, headings: Array, q: Array, exploration: Exploration
) -> tuple[Array, Array]:
    """Least time per length (k - 1,), s/m, between samples, and their distances (k - 1,), m."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    length = np.maximum(np.linalg.norm(np.diff(path.points, axis=0), axis=1), 1e-9)
    rotation = rig.poses(path.points, path.normals, headings)[:, :3, :3]
    turn = np.linalg.norm(log_so3(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)), axis=1)
    least = np.maximum(length / exploration.speed, turn / exploration.turn_rate)
    if rig.arm is not None:
        rate = exploration.joint_share * rig.arm.velocity_limit
        least = np.maximum(least, (np.abs(np.diff(q, axis=0)) / rate).max(axis=1))
    # slow down before a slow stretch and speed up after it without a jerk
    return gaussian_filter1d(maximum_filter1d(least / length, 5), 1.0, mode="nearest"), length
