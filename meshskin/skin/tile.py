"""A rigid triangular module on a surface: its best pose, whether it fits, what it overlaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import onto
from ..geometry.surface.closest_point import Closest
from . import slots

Array = NDArray[np.float64]

MOST_OFF = 2.5e-3
"""m, the most that a taxel may lie off the surface"""
FITS = 3
"""times a pose is brought nearer to the surface"""
MIDDLES = slots.OFFSETS[list(slots.TAXELS)]
"""(10, 3) taxels in the module's frame, m"""
OUTLINE = slots.SIDE / np.sqrt(3.0)
"""m, from a triangle's middle to its corners, and twice as far as to its sides"""


def corners(poses: Array) -> Array:
    """(k, 3, 3) corners of the triangles at poses (k, 4, 4), m, counter-clockwise from outside."""
    return np.asarray(slots.CORNERS @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3])


def fit(body: Body, region: regions.Region, middles: Array, headings: Array) -> Array:
    """Poses (k, 4, 4) on the surface near middles and headings (n, 3), of those that fit there."""
    if not len(middles):
        return np.zeros((0, 4, 4))
    at = body.closest(middles)
    poses = posed(at.point, at.normal, headings)
    for _ in range(FITS):
        poses = nearer(body, poses)
    return poses[fits(body, region, poses)]


def fits(body: Body, region: regions.Region, poses: Array) -> NDArray[np.bool_]:
    """Whether the taxels of modules at poses (k, 4, 4) are near the surface, over the region."""
    hit, feet, points = _feet(body, poses)
    off = np.linalg.norm(feet - points, axis=2).max(axis=1)
    inside = region.contains(body, hit).reshape(len(poses), -1).all(axis=1)
    return np.asarray((off < MOST_OFF) & inside)


def nearer(body: Body, poses: Array) -> Array:
    """Poses (k, 4, 4) lifted and tilted so that the taxels are nearest to their feet."""
    plane = np.column_stack([np.ones(len(MIDDLES)), MIDDLES[:, :2]])
    _, feet, points = _feet(body, poses)
    height = np.einsum("ksi,ki->ks", feet - points, poses[:, :3, 2])
    lift, slope_x, slope_y = np.linalg.pinv(plane) @ height.T
    x, y, z = (poses[:, :3, k] for k in range(3))
    up = z - slope_x[:, None] * x - slope_y[:, None] * y
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return posed(poses[:, :3, 3] + lift[:, None] * z, up, x)


def posed(origins: Array, normals: Array, headings: Array) -> Array:
    """Poses (k, 4, 4) at origins, z the unit normals, x along headings (k, 3 each)."""
    return se3.transform(se3.orthonormal_basis(normals, onto(headings, normals)), origins)


def _feet(body: Body, poses: Array) -> tuple[Closest, Array, Array]:
    """Closest points (k, 10, 3) of the taxels (k, 10, 3) of modules at poses (k, 4, 4)."""
    points = MIDDLES @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    hit = body.closest(points.reshape(-1, 3))
    return hit, hit.point.reshape(points.shape), points


def overlapping(pose: Array, others: Array) -> NDArray[np.bool_]:
    """Which of the modules at `others` (k, 4, 4) overlap that at `pose`, seen along both normals.

    Triangles overlap where no side of the one or the other separates them (separating axes).
    Modules that face away from each other do not count.
    """
    near = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1) < 2.0 * OUTLINE
    near &= others[:, :3, 2] @ pose[:3, 2] > 0.0
    found = np.zeros(len(others), dtype=bool)
    rows = np.flatnonzero(near)
    if len(rows):
        one = np.broadcast_to(pose, others[rows].shape)
        found[rows] = apart(one, others[rows])[0] < 0.0
    return found


def apart(one: Array, two: Array) -> tuple[Array, Array, Array]:
    """How far apart (k,), m, triangles at poses (k, 4, 4) are, over the side that parts them most.

    Seen along both normals; negative where they overlap. Also the unit way (k, 3) from the first to
    the second, and the corner (k, 3), m, that comes nearest.
    """
    z = one[:, :3, 2] + two[:, :3, 2]
    normals = z / np.linalg.norm(z, axis=1, keepdims=True)
    frames = np.swapaxes(se3.orthonormal_basis(normals), 1, 2)[:, :2]
    origin = one[:, None, :3, 3]
    a, b = (np.einsum("kci,kji->kcj", corners(p) - origin, frames) for p in (one, two))
    gap, way, corner = _beyond(a, b)
    back, back_way, back_corner = _beyond(b, a)
    other = back > gap
    way, corner = np.where(other, -back_way.T, way.T).T, np.where(other, back_corner.T, corner.T).T
    return (
        np.maximum(gap, back),
        np.einsum("kj,kji->ki", way, frames),
        np.einsum("kj,kji->ki", corner, frames) + origin[:, 0],
    )


def _beyond(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """How far triangles b (k, 3, 2) are beyond the side of a that they are most beyond, with that
    side's normal (k, 2), and b's corner (k, 2) nearest to it; both counter-clockwise."""
    side = np.roll(a, -1, axis=1) - a
    outward = np.stack([side[..., 1], -side[..., 0]], axis=2)
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    height = np.einsum("kscj,ksj->ksc", b[:, None] - a[:, :, None], outward)
    best, row = np.argmax(height.min(axis=2), axis=1), np.arange(len(a))
    corner = np.argmin(height[row, best], axis=1)
    return height[row, best, corner], outward[row, best], b[row, corner]
