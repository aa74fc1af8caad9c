"""Distances of capsules, and the spheres that cover them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, ranges

SPHERE_PITCH = 0.5
"""Largest distance of the spheres that cover a capsule, relative to its radius: they then need
radii larger by 3 % only, sqrt(1 + 1/16)."""


def box_distance(ends: Array, box: Array) -> Array:
    """Distances (...), m, from a box (2, 3) to the boxes about segments (..., 2, 3) or points
    (..., 1, 3); a segment is at least as far.
    """
    first, last = ends[..., 0, :], ends[..., -1, :]
    low, high = np.minimum(first, last), np.maximum(first, last)
    x, y, z = np.moveaxis(np.maximum(np.maximum(box[0] - high, low - box[1]), 0.0), -1, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def covering_spheres(length: Array, radii: Array) -> tuple[NDArray[np.intp], Array]:
    """Number (l,) and radius (l,), m, of spheres that cover capsules of lengths and radii (l,)."""
    count = np.ceil(length / (SPHERE_PITCH * radii)).astype(np.intp) + 1
    return count, np.hypot(radii, 0.5 * length / np.maximum(count - 1, 1))


def sphere_samples(count: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """For `count` (k,) spheres on each of k axes, in order: the axis (p,) of each sphere, its
    number (p,) there, and its relative position (p, 1).
    """
    owner = np.repeat(np.arange(len(count)), count)
    number = ranges(np.zeros_like(count), count)
    return owner, number, (number / np.maximum(count - 1, 1)[owner])[:, None]


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (...) of segments a b (..., 3) from one segment c d (3,).

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
