"""A way run in time: the path of the body, as slow as speeds, turns and joints ask."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..core.errors import ReachError
from ..core.se3 import Array, inverse, log_so3
from ..geometry.geodesics import rotate_about, transport_along
from ..robot.contact_rig import ContactRig
from ..scene.settings import Exploration
from .path import Path, timed, twists
from .tour import ContactPath

SMOOTHED = (6.0, 2.0, 0.0)
"""Widths, in samples, over which the spin is smoothed: the first that the joints allow."""

BLUR = 0.015
"""Time over which the body's pose is smoothed, s."""


def free(setup: ContactRig, way: ContactPath, exploration: Exploration, dt: float) -> Path:
    """The path over one way of a body without an arm."""
    tangents = transport_along(way.normals)
    return _path(setup, way, tangents, np.zeros((len(way), 0)), None, exploration, dt)


def followed(
    setup: ContactRig,
    way: ContactPath,
    tangents: Array,
    angle: Array,
    q: Array,
    exploration: Exploration,
    dt: float,
) -> Path:
    """The path over a way with the spin of a chain of postures, smoothed as far as joints allow."""
    from scipy.ndimage import gaussian_filter1d

    arm = setup.arm
    assert arm is not None
    assert setup.mount is not None
    for width in SMOOTHED:
        smooth = gaussian_filter1d(angle, width, mode="nearest") if width else angle
        headings = rotate_about(way.normals, tangents, smooth)
        poses = setup.poses(setup.tips(way.points, way.normals), way.normals, headings) @ inverse(
            setup.mount
        )
        try:
            follow = arm.inverse_kinematics(poses, q[0])
        except ReachError as error:
            reason = error
            continue
        return _path(setup, way, headings, follow, follow[:1], exploration, dt)
    raise reason


def _path(
    setup: ContactRig,
    way: ContactPath,
    headings: Array,
    q: Array,
    first: Array | None,
    exploration: Exploration,
    dt: float,
) -> Path:
    """The samples of a way, with their headings (k, 3) and joint angles (k, n), run in time."""
    from scipy.interpolate import PchipInterpolator, make_interp_spline
    from scipy.ndimage import gaussian_filter1d

    pace, length = _pace(setup, way, headings, q, exploration)
    rows = np.concatenate([way.points, headings], axis=1)
    parts = [rows[:1]]
    for start, end in pairwise(way.stops):
        s = np.concatenate([[0.0], np.cumsum(length[start:end])])
        u = np.concatenate([[0.0], np.cumsum((pace * length)[start:end])])
        at = PchipInterpolator(u, s)(timed(u[-1], exploration.ramp, dt) * u[-1])
        parts.append(make_interp_spline(s, rows[start : end + 1], k=min(3, end - start))(at))
    fine = np.concatenate(parts)
    hit = setup.body.closest(fine[:, :3])
    # over a seam the normal turns with a jerk that the body need not follow
    width = BLUR / dt
    tips, normals, tangents = (
        gaussian_filter1d(rows, width, axis=0, mode="nearest")
        for rows in (setup.tips(hit.point, hit.normal), hit.normal, fine[:, 3:])
    )
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    tangents -= np.einsum("ij,ij->i", tangents, normals)[:, None] * normals
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    poses = setup.poses(tips, normals, tangents)
    return Path(dt, hit.point, hit.normal, poses, twists(poses, dt), hit.face, (), first)


def _pace(
    setup: ContactRig, way: ContactPath, headings: Array, q: Array, exploration: Exploration
) -> tuple[Array, Array]:
    """Least time a metre (k - 1,), s/m, from each sample to the next, and the lengths, m."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    length = np.maximum(np.linalg.norm(np.diff(way.points, axis=0), axis=1), 1e-9)
    rotation = setup.poses(way.points, way.normals, headings)[:, :3, :3]
    turn = np.linalg.norm(log_so3(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)), axis=1)
    least = np.maximum(length / exploration.speed, turn / exploration.turn_rate)
    if q.shape[1]:
        assert setup.arm is not None
        rate = exploration.joint_share * setup.arm.velocity_limit
        least = np.maximum(least, (np.abs(np.diff(q, axis=0)) / rate).max(axis=1))
    # slow down ahead of what must be slow, and speed up after it, without a jerk
    return gaussian_filter1d(maximum_filter1d(least / length, 5), 1.0, mode="nearest"), length
