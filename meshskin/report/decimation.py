"""A mesh with fewer faces for pictures: fine near the skin, coarse away from it, without cracks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import Array, means_by_group, median_spacing
from ..geometry.surface.fans import vertex_normals
from .plane import finite_rows

Faces = NDArray[np.int64]


def decimate(
    vertices: ArrayLike, faces: ArrayLike, focus: ArrayLike, limit: int = 5000
) -> tuple[Array, Faces]:
    """A mesh of at most about `limit` faces that keeps its shape near the points `focus`.

    vertices (v, 3), faces (f, 3), focus (n, 3) in one unit. Far vertices are merged by cells of a
    grid (Rossignac and Borrel's vertex clustering), which grows until the faces are few enough;
    near ones are unchanged, unless the skin covers too much of the body. The result is for
    pictures only, not for measuring distances.
    """
    v, f = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    if len(f) <= limit:
        return v, f
    near = _near(v, f, np.asarray(focus, dtype=float).reshape(-1, 3), limit // 2)
    extent = float(np.max(np.ptp(v, axis=0)))
    for cells in (48, 40, 32, 26, 20, 16, 12, 8, 6, 4):
        merged = _cluster(v, f, near, extent / cells)
        if len(merged[1]) <= limit:
            break
    return merged


def _near(v: Array, f: Faces, focus: Array, faces: int) -> NDArray[np.bool_]:
    """The vertices (v,) nearest to the focus, with about `faces` faces between them.

    None if so many faces would only cover separate patches around the points of the focus.
    """
    from scipy.spatial import cKDTree

    focus = finite_rows(focus)
    if not len(focus):
        return np.zeros(len(v), dtype=bool)
    distance = cKDTree(focus).query(v)[0]
    radius = np.sort(distance[f].max(axis=1))[faces]
    if radius < 2 * median_spacing(focus):
        return np.zeros(len(v), dtype=bool)
    return np.asarray(distance <= radius)


def _cluster(v: Array, f: Faces, near: NDArray[np.bool_], cell: float) -> tuple[Array, Faces]:
    """Merge the vertices of each cell, except near ones; return vertices and remaining faces."""
    grid = np.floor((v - v.min(axis=0)) / cell).astype(np.int64)
    key = (grid[:, 0] << 40) + (grid[:, 1] << 20) + grid[:, 2]
    key[near] = -1 - np.flatnonzero(near)  # a cell of its own
    _, label = np.unique(key, return_inverse=True)
    centre, normal = means_by_group(v, label), means_by_group(vertex_normals(v, f), label)
    g = label[f]
    g = g[(g[:, 0] != g[:, 1]) & (g[:, 1] != g[:, 2]) & (g[:, 2] != g[:, 0])]
    # two faces on the same vertices are a fold; both are removed, so that the surface stays closed
    _, first, times = np.unique(np.sort(g, axis=1), axis=0, return_index=True, return_counts=True)
    g = g[first[times % 2 == 1]]
    a, b, c = (centre[g[:, k]] for k in range(3))
    inside_out = np.einsum("fi,fi->f", np.cross(b - a, c - a), normal[g].sum(axis=1)) < 0
    g[inside_out] = g[inside_out][:, ::-1]
    return centre, g
