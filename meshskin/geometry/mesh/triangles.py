"""Geometry of arrays of triangles: normals, closest points, subdivision, spatial order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index


def face_normals(vertices: Array, faces: Index) -> Array:
    """Unit normals (m, 3) of faces (m, 3); zero where a face has no area."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.sqrt(np.einsum("mc,mc->m", normal, normal)), 1e-300)[:, None]
    return normal


def closest_on_triangles(p: Array, a: Array, ab: Array, ac: Array) -> tuple[Array, Array]:
    """Squared distances of points p from triangles a, a + ab, a + ac (all (..., 3)).

    Second, the barycentric weights (..., 2) of a + ab and a + ac at the closest points.
    trimesh.triangles.closest_point gives no weights, and its tolerances are absolute.
    """
    ap = p - a
    uv = _barycentric(ap, ab, ac)
    flat = ap - uv[..., :1] * ab - uv[..., 1:] * ac
    within = (uv.min(axis=-1) >= 0) & (uv.sum(axis=-1) <= 1)
    best = np.where(within, np.sum(flat**2, axis=-1), np.inf)
    origin, east, north = np.zeros(2), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    sides = (
        (ap, ab, origin, east),
        (ap, ac, origin, north),
        (ap - ab, ac - ab, east, north - east),
    )
    for start, edge, first, along in sides:
        length2 = np.maximum(np.sum(edge * edge, axis=-1), 1e-300)
        t = np.clip(np.sum(start * edge, axis=-1) / length2, 0.0, 1.0)[..., None]
        gap2 = np.sum((start - t * edge) ** 2, axis=-1)
        nearer = gap2 < best
        best = np.where(nearer, gap2, best)
        uv = np.where(nearer[..., None], first + t * along, uv)
    return best, uv


def _barycentric(offset: Array, ab: Array, ac: Array) -> Array:
    """Weights (..., 2) of ab and ac in the projection of offsets on their planes."""
    e, f, g = (np.sum(x * y, axis=-1) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    x, y = np.sum(offset * ab, axis=-1), np.sum(offset * ac, axis=-1)
    area2 = np.maximum(e * g - f * f, 1e-300)
    return np.stack([(g * x - f * y) / area2, (e * y - f * x) / area2], axis=-1)


def subdivision_centroids(count: int) -> Array:
    """Barycentric centroids (count^2, 3) of a triangle's count^2 equal sub-triangles."""
    up = [(3 * i + 1, 3 * j + 1) for i in range(count) for j in range(count - i)]
    down = [(3 * i + 2, 3 * j + 2) for i in range(count - 1) for j in range(count - 1 - i)]
    uv = np.array(up + down) / (3.0 * count)
    return np.column_stack([1.0 - uv.sum(axis=1), uv])


def morton_order(points: Array) -> NDArray[np.int64]:
    """Indices (n,) that sort points (n, 3) along Morton's curve: neighbours stay close together."""
    low, high = points.min(axis=0), points.max(axis=0)
    cell = ((points - low) * (1023.0 / max(float((high - low).max()), 1e-300))).astype(np.int64)
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        cell = (cell | cell << shift) & mask
    return np.argsort(cell[:, 0] | cell[:, 1] << 1 | cell[:, 2] << 2)
