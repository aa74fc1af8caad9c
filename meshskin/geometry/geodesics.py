"""Ways over a surface: straight ahead along geodesics, and tangents carried along them."""

from __future__ import annotations

import numpy as np

from ..core.se3 import Array
from .body import Body
from .surface.closest_point import Closest


def march(
    body: Body, at: Closest, heading: Array, carried: Array, length: float
) -> tuple[Closest, Array]:
    """Walk a length (m) from n points along geodesics with unit headings (n, 3).

    Gives the ends, and the tangents `carried` (n, 3) transported there. Steps are straight, each
    followed by the closest point: off by (kappa ds)^2 / 3 of the length.
    """
    steps = int(np.clip(np.ceil(length * np.max(np.abs(at.curvature), initial=0.0) / 0.05), 2, 10))
    for _ in range(steps):
        after = body.closest(at.point + length / steps * heading, face=at.face)
        heading = _transport(heading, at.normal, after.normal)
        carried = _transport(carried, at.normal, after.normal)
        at = after
    return at, carried


def _transport(vectors: Array, before: Array, after: Array) -> Array:
    """Tangents (n, 3) turned by the smallest rotation that takes normals `before` to `after`."""
    along = np.sum(vectors * after, axis=1) / (1.0 + np.sum(before * after, axis=1))
    return onto(vectors - along[:, None] * (before + after), after)


def onto(vectors: Array, normals: Array) -> Array:
    """Unit tangents (n, 3): the vectors' parts across the normals."""
    flat = vectors - np.sum(vectors * normals, axis=1, keepdims=True) * normals
    return flat / np.linalg.norm(flat, axis=1, keepdims=True)


def transported(normals: Array, first: Array | None = None) -> Array:
    """Unit tangents (k, 3) carried along the normals (k, 3) without turning about them."""
    out = np.empty_like(normals)
    way = np.eye(3)[np.argmin(np.abs(normals[0]))] if first is None else first
    for k, n in enumerate(normals):
        way = way - n * (n @ way)
        way = way / np.linalg.norm(way)
        out[k] = way
    return out


def turned(tangents: Array, normals: Array, angle: Array) -> Array:
    """Tangents (..., 3) turned about the normals by `angle` (...), rad."""
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return np.asarray(cosine * tangents + sine * np.cross(normals, tangents))
