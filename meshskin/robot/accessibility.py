"""Straight paths through the air on which an indenter leaves a contact, or comes to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..geometry.body import Body
from ..geometry.mesh.rays import spread_directions

DIRECTIONS = 256
"""Directions that are tried, on a spiral over the sphere. Every direction is within 10 degrees of
one of them: the angle between the axis and the rim of an opening, seen from three diameters."""
SLACK = 0.05
"""Part of the indenter's radius by which it may overlap the body on its path, as it starts in
contact; also its least step, relative to its radius."""


def enclosed(body: Body, points: Array, normals: Array, radius: float) -> NDArray[np.bool_]:
    """Whether (k,) no straight path leads an indenter of `radius`, m, out of the body.

    points (k, 3): contact points, m; normals (k, 3): outward. The normal is tried first. Where it
    meets the body, other directions are tried, from half the free length along the normal and from
    the contact itself. The indenter is a sphere here, as in the motion through the air: its support
    is tested at the contact only.
    """
    centres = points + radius * normals
    ahead = free_lengths(body, centres, normals, radius)
    held = np.flatnonzero(np.isfinite(ahead))
    for part in (0.5, 0.0):
        for direction in spread_directions(DIRECTIONS):
            start = centres[held] + part * ahead[held, None] * normals[held]
            rows = np.flatnonzero(free_rays(body, start, direction))  # much faster than the sphere
            length = free_lengths(body, start[rows], np.tile(direction, (len(rows), 1)), radius)
            held = np.delete(held, rows[np.isinf(length)])
    out = np.zeros(len(points), dtype=bool)
    out[held] = True
    return out


def free_rays(body: Body, origins: Array, directions: Array) -> NDArray[np.bool_]:
    """Whether (n,) rays from `origins` (n, 3), m, along unit vectors `directions` (n, 3), or one
    (3,), meet nothing of the body (embree, single precision).
    """
    centre, scale, scene = body.embree_scene
    start = ((origins - centre) / scale).astype(np.float32)
    along = np.broadcast_to(directions, start.shape).astype(np.float32)
    return np.asarray(scene.run(start, along)) < 0


def free_lengths(body: Body, start: Array, directions: Array, radius: float) -> Array:
    """How far (k,), m, a sphere of `radius`, m, moves from centres (k, 3) along unit vectors (k, 3)
    before it meets the body; inf where it never does.

    Source: Hart, "Sphere tracing", Visual Computer 12 (1996).
    """
    least = SLACK * radius
    longest = float(np.linalg.norm(np.ptp(body.mesh.bounds, axis=0))) + 2.0 * radius
    length, going = np.zeros(len(start)), np.arange(len(start))
    while len(going):
        at = start[going] + length[going, None] * directions[going]
        gap = np.abs(body.surface.nearest(at).distance) - radius + least
        going, gap = going[gap >= 0.0], gap[gap >= 0.0]
        length[going] += np.maximum(gap, least)
        length[going[length[going] > longest]] = np.inf
        going = going[np.isfinite(length[going])]
    return length
