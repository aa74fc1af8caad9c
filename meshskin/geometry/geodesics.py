"""Ways over a surface: straight ahead along geodesics, and tangents carried along them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .body import Body
from .closest import Closest

Array = NDArray[np.float64]


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
