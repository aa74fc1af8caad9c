"""Folds: where a mesh passes through itself, no normal tells inside from outside.

Of the faces that meet at the nearest point of a solid's edge, all face a point outside, and none a
point inside. Where some do and others do not, the mesh is folded there (or the nearest point is a
saddle's corner), and how often the mesh winds about the point tells. A face that looks the wrong
way and is nearest by itself is not noticed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .mend import turns

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ON_EDGE = 1e-9
"""barycentric weight below which a foot lies on an edge"""
GRAZING = 1e-6
"""sine of the angle over a face's plane, up to which a face neither faces a point nor turns away"""


class Folds:
    """The faces around edges and corners of a mesh (vertices (n, 3) m, faces (m, 3))."""

    def __init__(self, vertices: Array, faces: Index, normals: Array) -> None:
        self.corners = vertices[faces]
        self.faces, self.normals = faces, normals
        self.order = np.argsort(faces.ravel(), kind="stable")
        self.first = np.searchsorted(faces.ravel()[self.order], np.arange(len(vertices) + 1))
        ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, count = np.unique(ends[:, 0] * len(vertices) + ends[:, 1], return_counts=True)
        self.closed = bool(np.all(count % 2 == 0))
        """whether no edge is a border: only then does the winding tell"""
        middle = self.corners.reshape(-1, 3).mean(axis=0)
        a, b, c = np.swapaxes(self.corners - middle, 0, 1)
        self.outward = float(np.copysign(1.0, np.einsum("mc,mc->", a, np.cross(b, c))))

    def doubtful(self, face: Index, weight: Array, way: Array) -> Index:
        """The rows of those whose feet are on folds.

        `face` (n,) and `weight` (n, 3), barycentric: the feet, `way` (n, 3): from there, m.
        """
        if not self.closed:
            return np.zeros(0, dtype=np.intp)
        on = weight > ON_EDGE
        rows = np.flatnonzero(on.sum(axis=1) < 3)
        start = np.argmax(on[rows], axis=1)
        end = 2 - np.argmax(on[rows][:, ::-1], axis=1)
        tail, head = self.faces[face[rows], start], self.faces[face[rows], end]
        size = self.first[tail + 1] - self.first[tail]
        place = np.repeat(self.first[tail] - np.cumsum(size) + size, size) + np.arange(size.sum())
        owner, row = self.order[place] // 3, np.repeat(np.arange(len(rows)), size)
        meets = np.any(self.faces[owner] == head[row, None], axis=1)  # at a corner all do
        owner, row = owner[meets], row[meets]
        unit = way[rows] / np.maximum(np.linalg.norm(way[rows], axis=1), 1e-300)[:, None]
        sine = np.einsum("ij,ij->i", self.normals[owner], unit[row])
        facing = np.bincount(row[sine > GRAZING], minlength=len(rows))
        turned = np.bincount(row[sine < -GRAZING], minlength=len(rows))
        return np.asarray(rows[(facing > 0) & (turned > 0)])

    def side(self, points: Array) -> Array:
        """+1 or -1 (n,): where points (n, 3), m, are outside or inside by the mesh's winding."""
        inside = np.array([abs(turns(self.corners, p)) > 0.5 for p in points], dtype=bool)
        return np.where(inside, -self.outward, self.outward)
