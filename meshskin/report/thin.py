"""Fewer faces for a picture: fine near the skin, coarse away from it, without cracks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..se3 import Array


def thin(
    vertices: ArrayLike, faces: ArrayLike, focus: ArrayLike, limit: int = 5000
) -> tuple[Array, NDArray[np.int64]]:
    """A mesh of at most about `limit` faces that keeps its shape near the points `focus`.

    vertices (v, 3), faces (f, 3), focus (n, 3) in one unit. Far vertices are merged by cells of a
    grid (Rossignac and Borrel's vertex clustering), which grows until the faces are few enough;
    near ones stay as they are. For pictures only: distances must not be measured on the result.
    """
    v, f = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    if len(f) <= limit:
        return v, f
    distance = _distance(v, np.asarray(focus, dtype=float).reshape(-1, 3))
    near = distance <= _near_radius(distance, f, limit)
    extent = float(np.max(np.ptp(v, axis=0)))
    for cells in (48, 40, 32, 26, 20, 16, 12, 8, 6, 4):
        merged = _cluster(v, f, near, extent / cells)
        if len(merged[1]) <= limit:
            break
    return merged


def _distance(v: Array, focus: Array) -> Array:
    from scipy.spatial import cKDTree

    focus = focus[np.isfinite(focus).all(axis=1)]
    if not len(focus):
        return np.full(len(v), np.inf)
    return np.asarray(cKDTree(focus).query(v)[0])


def _near_radius(distance: Array, f: NDArray[np.int64], limit: int) -> float:
    """The radius about the focus within which half of the allowed faces lie."""
    reach = np.sort(distance[f].max(axis=1))
    return float(reach[min(limit // 2, len(reach)) - 1])


def _cluster(
    v: Array, f: NDArray[np.int64], near: NDArray[np.bool_], cell: float
) -> tuple[Array, NDArray[np.int64]]:
    grid = np.floor((v - v.min(axis=0)) / cell).astype(np.int64)
    key = (grid[:, 0] << 40) + (grid[:, 1] << 20) + grid[:, 2]
    key[near] = -1 - np.flatnonzero(near)  # its own cell
    _, label = np.unique(key, return_inverse=True)
    count = np.bincount(label)
    centre = np.stack([np.bincount(label, v[:, k]) / count for k in range(3)], axis=1)
    g = label[f]
    whole = (g[:, 0] != g[:, 1]) & (g[:, 1] != g[:, 2]) & (g[:, 2] != g[:, 0])
    return centre, np.unique(g[whole], axis=0)
