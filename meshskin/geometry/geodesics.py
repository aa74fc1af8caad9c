"""Geodesics of a surface, and the parallel transport of tangents along them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.se3 import perpendicular, shortest_rotation
from .body import Body
from .surface.closest_point import Closest

ALONG_NORMAL = 1e-6
"""Part of a vector's length below which its tangential part is rounding error: a vector that comes
from single-precision data is known to 1e-7."""
OPPOSITE = -0.999
"""Cosine between normals below which 1 + cosine loses three digits or more: the general rotation is
used there."""
BEND = 0.05
"""Largest angle, rad, by which the normal turns in one step of `march`: the length is then off by
less than BEND^2 / 3, 0.1 %."""


def march(
    body: Body, at: Closest, heading: Array, carried: Array, length: float
) -> tuple[Closest, Array]:
    """Follow geodesics for a length (m) from n points along unit tangents `heading` (n, 3).

    Returns the end points, and the tangents `carried` (n, 3) transported there. Steps are straight,
    each followed by the closest point: the relative error of the length is (curvature * step)^2/3.
    """
    steps = int(np.clip(np.ceil(length * np.max(np.abs(at.curvature), initial=0.0) / BEND), 2, 10))
    for _ in range(steps):
        after = body.surface.nearest(at.point + length / steps * heading, face=at.face)
        heading, carried = (transport(v, at.normal, after.normal) for v in (heading, carried))
        at = after
    return at, carried


def geodesic(
    body: Body, start: Array, direction: Array, step: float
) -> Iterator[tuple[Closest, Array]]:
    """Points of geodesics from `start` (..., 3) in directions (..., 3), `step` m apart, for ever.

    Yields the surface points and the unit tangents (..., 3) ahead, the starts first. Geodesics that
    are followed together take little more time than one.
    """
    at, ahead = body.surface.nearest(np.atleast_2d(start)), direction
    while True:
        ahead = onto(ahead, at.normal.reshape(ahead.shape))
        yield at, ahead
        at = body.surface.nearest(at.point + step * ahead, face=at.face)


def transport(vectors: Array, before: Array, after: Array) -> Array:
    """Unit tangents (n, 3) by the shortest rotations from normals `before` to `after` (n, 3)."""
    cosine = np.sum(before * after, axis=1)
    opposite = cosine < OPPOSITE
    along = np.sum(vectors * after, axis=1) / np.where(opposite, 1.0, 1.0 + cosine)
    moved = vectors - along[:, None] * (before + after)
    if opposite.any():
        rotation = shortest_rotation(before[opposite], after[opposite])
        moved[opposite] = np.einsum("nij,nj->ni", rotation, vectors[opposite])
    return onto(moved, after)


def any_tangents(normals: Array) -> Array:
    """A unit tangent (..., 3) at each of unit normals (..., 3): the projection of the coordinate
    axis that is least aligned with the normal."""
    return onto(np.cross(normals, perpendicular(normals)), normals)


def transport_along(normals: Array, first: Array | None = None) -> Array:
    """A tangent transported along the unit normals (k, 3) of a path: unit tangents (k, 3).

    `first` is the tangent at the start, by default that of `any_tangents`. Each step projects onto
    the next tangent plane, which is parallel transport up to the square of the angle between the
    normals.
    """
    out = np.empty_like(normals)
    tangent = any_tangents(normals[0]) if first is None else first
    for k, normal in enumerate(normals):
        tangent = onto(tangent, normal)
        out[k] = tangent
    return out


def onto(vectors: Array, normals: Array) -> Array:
    """Unit tangents (..., 3): the projections of vectors onto the planes of unit normals (..., 3).

    A vector along its normal becomes any tangent.
    """
    flat = vectors - np.sum(vectors * normals, axis=-1, keepdims=True) * normals
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    lost = length < ALONG_NORMAL * np.linalg.norm(vectors, axis=-1, keepdims=True)
    if lost.any():
        flat, length = np.where(lost, -perpendicular(normals), flat), np.where(lost, 1.0, length)
    return np.asarray(flat / length)


def rotate_about(normals: Array, tangents: Array, angle: ArrayLike) -> Array:
    """Tangents (..., 3) rotated about their unit normals (..., 3) by `angle` (...), rad."""
    cosine, sine = np.asarray(np.cos(angle))[..., None], np.asarray(np.sin(angle))[..., None]
    return np.asarray(cosine * tangents + sine * np.cross(normals, tangents))
