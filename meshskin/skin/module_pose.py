"""Poses of rigid triangular modules on a surface: the best fit, its validity, overlaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.arrays import Array
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import onto
from ..geometry.surface.closest_point import Closest
from . import slots

MAX_OFFSET = 2.5e-3
"""Largest distance of a taxel from the surface, m. A module fitted to a sphere of radius R (mm) is
off by 32 mm^2 / R: spheres down to a radius of 13 mm, a finger, can be covered."""
ITERATIONS = 3
"""Linear least-squares fits of a pose to the surface; each starts at the closest points of the
last."""
TAXEL_OFFSETS = slots.OFFSETS[list(slots.TAXELS)]
"""(10, 3) taxels in the module's frame, m."""
CIRCUMRADIUS = slots.SIDE / np.sqrt(3.0)
"""Distance from the triangle's centre to its corners, m; twice the distance to its sides."""


def corners(poses: Array) -> Array:
    """(k, 3, 3) corners of the triangles at poses (k, 4, 4), m, counter-clockwise from outside."""
    return np.asarray(slots.CORNERS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3])


def fit(body: Body, region: regions.Region, centres: Array, headings: Array) -> Array:
    """Valid poses (k, 4, 4) on the surface near centres and headings (n, 3), k <= n."""
    if not len(centres):
        return np.zeros((0, 4, 4))
    at = body.closest(centres)
    poses = upright(at.point, at.normal, headings)
    for _ in range(ITERATIONS):
        poses = fit_to_surface(body, poses)
    return poses[is_valid(body, region, poses)]


def is_valid(body: Body, region: regions.Region, poses: Array) -> NDArray[np.bool_]:
    """Whether all taxels of modules at poses (k, 4, 4) are near the surface, above the region."""
    hit, feet, points = _closest(body, poses)
    offset = np.linalg.norm(feet - points, axis=2).max(axis=1)
    inside = region.contains(body, hit).reshape(len(poses), -1).all(axis=1)
    return np.asarray((offset < MAX_OFFSET) & inside)


def fit_to_surface(body: Body, poses: Array) -> Array:
    """Poses (k, 4, 4) shifted and tilted to the least squares of the distances to the surface.

    The plane through the taxels is fitted to the heights of their closest points above it.
    """
    plane = np.column_stack([np.ones(len(TAXEL_OFFSETS)), TAXEL_OFFSETS[:, :2]])
    _, feet, points = _closest(body, poses)
    height = np.einsum("ksi,ki->ks", feet - points, poses[:, :3, 2])
    lift, slope_x, slope_y = np.linalg.pinv(plane) @ height.T
    x, y, z = (poses[:, :3, k] for k in range(3))
    up = z - slope_x[:, None] * x - slope_y[:, None] * y
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return upright(poses[:, :3, 3] + lift[:, None] * z, up, x)


def upright(origins: Array, normals: Array, headings: Array) -> Array:
    """Poses (k, 4, 4) at origins with z along unit normals and x near headings (k, 3 each)."""
    return se3.transform(se3.orthonormal_basis(normals, onto(headings, normals)), origins)


def _closest(body: Body, poses: Array) -> tuple[Closest, Array, Array]:
    """Closest points (k, 10, 3) to the taxels (k, 10, 3) of modules at poses (k, 4, 4)."""
    points = TAXEL_OFFSETS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    hit = body.closest(points.reshape(-1, 3))
    return hit, hit.point.reshape(points.shape), points


def overlapping(pose: Array, others: Array) -> NDArray[np.bool_]:
    """Which of the modules at `others` (k, 4, 4) overlap that at `pose`, along the mean normal.

    Two triangles overlap if no side of either separates them (separating axis theorem). Modules
    whose normals are more than 90 degrees apart do not overlap.
    """
    near = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1) < 2.0 * CIRCUMRADIUS
    near &= others[:, :3, 2] @ pose[:3, 2] > 0.0
    found = np.zeros(len(others), dtype=bool)
    rows = np.flatnonzero(near)
    if len(rows):
        one = np.broadcast_to(pose, others[rows].shape)
        found[rows] = separation(one, others[rows])[0] < 0.0
    return found


def separation(one: Array, two: Array) -> tuple[Array, Array, Array]:
    """Gaps (k,), m, of triangles at poses (k, 4, 4) over the side that separates them most.

    They are measured in the plane of the mean normal, and negative where triangles overlap. Also
    the unit direction (k, 3) from the first triangle to the second, and the corner (k, 3), m, that
    is nearest to the side.
    """
    z = one[:, :3, 2] + two[:, :3, 2]
    normals = z / np.linalg.norm(z, axis=1, keepdims=True)
    frames = np.swapaxes(se3.orthonormal_basis(normals), 1, 2)[:, :2]
    origin = one[:, None, :3, 3]
    a, b = (np.einsum("kci,kji->kcj", corners(p) - origin, frames) for p in (one, two))
    gap, direction, corner = _edge_gap(a, b)
    back, back_direction, back_corner = _edge_gap(b, a)
    other = (back > gap)[:, None]
    direction = np.where(other, -back_direction, direction)
    corner = np.where(other, back_corner, corner)
    return (
        np.maximum(gap, back),
        np.einsum("kj,kji->ki", direction, frames),
        np.einsum("kj,kji->ki", corner, frames) + origin[:, 0],
    )


def _edge_gap(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Gaps (k,) of triangles b (k, 3, 2) from the side of a that separates them most.

    Also the outward normal (k, 2) of that side, and the corner (k, 2) of b nearest to it. Both
    triangles are counter-clockwise.
    """
    side = np.roll(a, -1, axis=1) - a
    outward = np.stack([side[..., 1], -side[..., 0]], axis=2)
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    height = np.einsum("kscj,ksj->ksc", b[:, None] - a[:, :, None], outward)
    best, row = np.argmax(height.min(axis=2), axis=1), np.arange(len(a))
    corner = np.argmin(height[row, best], axis=1)
    return height[row, best, corner], outward[row, best], b[row, corner]
