"""A way run in time: the path of the body, as slow as speeds, turns and joints ask."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..errors import ReachError
from ..se3 import Array, inverse, log_so3
from .path import Exploration, Path, timed, twists
from .ways import Setup, Way, transported, turned

SMOOTHED = (6.0, 2.0, 0.0)
"""Widths, in samples, over which the spin is smoothed: the first that the joints allow."""


def free(setup: Setup, way: Way, exploration: Exploration, dt: float) -> Path:
    """The path over one way of a body without an arm."""
    tangents = transported(way.normals)
    return _path(setup, way, tangents, np.zeros((len(way), 0)), None, exploration, dt)


def followed(
    setup: Setup,
    way: Way,
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
        headings = turned(tangents, way.normals, smooth)
        poses = setup.poses(way.points, way.normals, headings) @ inverse(setup.mount)
        try:
            follow = arm.inverse_kinematics(poses, q[0])
        except ReachError as error:
            reason = error
            continue
        return _path(setup, way, headings, follow, follow[:1], exploration, dt)
    raise reason


def _path(
    setup: Setup,
    way: Way,
    headings: Array,
    q: Array,
    first: Array | None,
    exploration: Exploration,
    dt: float,
) -> Path:
    """The samples of a way, with their headings (k, 3) and joint angles (k, n), run in time."""
    from scipy.interpolate import CubicSpline

    cost = _seconds(setup, way, headings, q, exploration)
    points, frames = [way.points[:1]], [headings[:1]]
    for start, end in pairwise(way.stops):
        u = np.concatenate([[0.0], np.cumsum(cost[start:end])])
        along = timed(u[-1], exploration.ramp, dt) * u[-1]
        leg = np.concatenate([way.points, headings], axis=1)[start : end + 1]
        fine = CubicSpline(u, leg)(along) if len(leg) > 2 else _straight(u, leg, along)
        points.append(fine[:, :3])
        frames.append(fine[:, 3:])
    hit = setup.body.closest(np.concatenate(points))
    tangents = np.concatenate(frames)
    tangents -= np.einsum("ij,ij->i", tangents, hit.normal)[:, None] * hit.normal
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    poses = setup.poses(hit.point, hit.normal, tangents)
    return Path(dt, hit.point, hit.normal, poses, twists(poses, dt), hit.face, (), first)


def _straight(u: Array, leg: Array, along: Array) -> Array:
    return np.stack([np.interp(along, u, column) for column in leg.T], axis=1)


def _seconds(setup: Setup, way: Way, headings: Array, q: Array, exploration: Exploration) -> Array:
    """Least time (k - 1,), s, from each sample to the next."""
    length = np.linalg.norm(np.diff(way.points, axis=0), axis=1)
    rotation = setup.poses(way.points, way.normals, headings)[:, :3, :3]
    turn = np.linalg.norm(log_so3(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)), axis=1)
    least = np.maximum(length / exploration.speed, turn / exploration.turn_rate)
    if q.shape[1]:
        assert setup.arm is not None
        rate = exploration.joint_share * setup.arm.velocity_limit
        least = np.maximum(least, (np.abs(np.diff(q, axis=0)) / rate).max(axis=1))
    return np.maximum(least, 1e-6)
