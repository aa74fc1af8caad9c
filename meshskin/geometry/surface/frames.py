"""Frames on a mesh: normals at its vertices, and tangents beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.se3 import orthonormal_basis
from .fans import Fans

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def vertex_normals(vertices: Array, faces: Index) -> Array:
    """Outward unit normals (n, 3) at the vertices, each face weighted by its area."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    flat = faces.ravel()
    total = np.stack(
        [np.bincount(flat, np.repeat(cross[:, k], 3), len(vertices)) for k in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


def fan_frames(points: Array, fans: Fans) -> Array:
    """Frames (j, 3, 3) of the fans, rows t1, t2, normal; t1 is along creases where some are."""
    normals = vertex_normals(points, fans.corner)
    frame = np.ascontiguousarray(np.swapaxes(orthonormal_basis(normals), 1, 2))
    face, k = np.nonzero(fans.sharp)
    tail, head = fans.corner[face, (k + 1) % 3], fans.corner[face, (k + 2) % 3]
    way = points[head] - points[tail]
    way /= np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
    along = np.zeros_like(points)
    np.add.at(along, np.concatenate([tail, head]), np.concatenate([way, way]))
    normal = frame[:, 2]
    along -= np.einsum("ji,ji->j", along, normal)[:, None] * normal
    length = np.linalg.norm(along, axis=1)
    rows = np.flatnonzero(length > 0.1)
    frame[rows, 0] = along[rows] / length[rows, None]
    frame[rows, 1] = np.cross(normal[rows], frame[rows, 0])
    return frame
