"""Distances of capsules, and the balls that stand for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ranges
from ..core.se3 import Array

FINE = 0.5
"""Distance of the balls that stand for a capsule, in its radii."""


def apart(ends: Array, box: Array) -> Array:
    """Distances (...), m, of the boxes about segments (..., 2, 3), which are no nearer, or of
    points (..., 1, 3), from a box (2, 3).
    """
    first, last = ends[..., 0, :], ends[..., -1, :]
    low, high = np.minimum(first, last), np.maximum(first, last)
    x, y, z = np.moveaxis(np.maximum(np.maximum(box[0] - high, low - box[1]), 0.0), -1, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def covering(length: Array, radii: Array) -> tuple[NDArray[np.intp], Array]:
    """How many balls (l,) cover capsules of the given lengths and radii (l,), m, and how large they
    are (l,), m.
    """
    count = np.ceil(length / (FINE * radii)).astype(np.intp) + 1
    return count, np.hypot(radii, 0.5 * length / np.maximum(count - 1, 1))


def spread(count: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Of which of (k,) axes each ball (p,) is, `count` (k,) on each, the how manieth there, and at
    which part (p, 1).
    """
    owner = np.repeat(np.arange(len(count)), count)
    place = ranges(np.zeros_like(count), count)
    return owner, place, (place / np.maximum(count - 1, 1)[owner])[:, None]


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (...) of segments a b (..., 3) from the one segment c d (3,).

    Source: Ericson, "Real-Time Collision Detection" (2005), section 5.1.9.
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = np.sum(u * u, -1), float(v @ v), u @ v
    uw, vw = np.sum(u * w, -1), w @ v
    det = uu * vv - uv * uv
    s = np.clip(
        np.where(det > 1e-12 * vv, (uv * vw - uw * vv) / np.where(det > 0, det, 1), 0), 0, 1
    )
    t = np.clip((uv * s + vw) / vv, 0, 1)
    s = np.clip(np.where(uu > 0, (t * uv - uw) / np.where(uu > 0, uu, 1), 0), 0, 1)
    t = np.clip((uv * s + vw) / vv, 0, 1)
    return np.asarray(np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1))
