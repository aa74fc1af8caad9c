"""Folds: where a mesh passes through itself, no normal tells inside from outside.

Of the faces that meet at the nearest point of a solid's edge, all face a point outside, and none a
point inside. Where some do and others do not, the mesh is folded there, unless the faces that meet
look about the same way: then the nearest point is a saddle's corner, such as the rim of a coarse
cylinder has, and the normals tell. At a fold, how often the mesh winds about the point tells. Where
parts of a mesh run into each other, sheets lie within it that have inside on both sides: every face
knows how often the mesh winds about the points before it, and where sheets cross, it is counted for
the point itself.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ranges
from .topology import corners_by_vertex, face_components
from .winding_number import Winding

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ON_EDGE = 1e-9
"""barycentric weight below which a foot lies on an edge"""
ALIKE = 0.65
"""cosine of the angle from their middle up to which the normals of faces that meet show no fold: a
little over half a right angle, as at the rim of a cylinder"""
GRAZING = 1e-6
"""sine of the angle over a face's plane, up to which a face neither faces a point nor turns away"""
BEFORE = 1e-7
"""how far before a face the turns about it are counted, in parts of the mesh's extent"""


class Folds:
    """The faces around edges and corners of a mesh (vertices (n, 3) m, faces (m, 3)).

    `crossed` (k,): the faces at which the mesh passes through itself, or has edges of more than two
    faces; `across` (m, 3): the faces across the edges, or -1.
    """

    def __init__(
        self, vertices: Array, faces: Index, normals: Array, crossed: Index, across: Index
    ) -> None:
        self.corners = vertices[faces]
        self.faces, self.normals = faces, normals
        self.crossed, self.across = crossed, across
        self.order, self.first = corners_by_vertex(faces, len(vertices))
        ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, count = np.unique(ends[:, 0] * len(vertices) + ends[:, 1], return_counts=True)
        self.closed = bool(np.all(count % 2 == 0))
        """whether no edge is a border"""
        self._vertices = vertices

    def doubtful(self, face: Index, weight: Array, way: Array) -> Index:
        """The rows of those whose feet are on folds.

        `face` (n,) and `weight` (n, 3), barycentric: the feet, `way` (n, 3): from there, m.
        """
        if not (self.closed or len(self.crossed)):
            return np.zeros(0, dtype=np.intp)
        on = weight > ON_EDGE
        rows = np.flatnonzero(on.sum(axis=1) < 3)
        start = np.argmax(on[rows], axis=1)
        end = 2 - np.argmax(on[rows][:, ::-1], axis=1)
        tail, head = self.faces[face[rows], start], self.faces[face[rows], end]
        size = self.first[tail + 1] - self.first[tail]
        place = ranges(self.first[tail], size)
        owner, row = self.order[place] // 3, np.repeat(np.arange(len(rows)), size)
        meets = np.any(self.faces[owner] == head[row, None], axis=1)  # at a corner all do
        owner, row = owner[meets], row[meets]
        unit = way[rows] / np.maximum(np.linalg.norm(way[rows], axis=1), 1e-300)[:, None]
        sine = np.einsum("ij,ij->i", self.normals[owner], unit[row])
        facing = np.bincount(row[sine > GRAZING], minlength=len(rows))
        turned = np.bincount(row[sine < -GRAZING], minlength=len(rows))
        some = np.flatnonzero(((facing > 0) & (turned > 0))[row])
        normal, row = self.normals[owner[some]], row[some]
        means = np.zeros((2, len(rows), 3))  # of those that face the point, and of the others
        np.add.at(means, ((sine[some] < 0.0).astype(int), row), normal)
        means /= np.maximum(np.linalg.norm(means, axis=2, keepdims=True), 1e-300)
        middle = means.sum(axis=0)[row]
        away = np.einsum("ij,ij->i", normal, middle) < ALIKE * np.linalg.norm(middle, axis=1)
        return np.asarray(rows[np.unique(row[away])])

    @cached_property
    def _winding(self) -> Winding:
        return Winding(self._vertices, self.faces)

    @property
    def _before(self) -> Array:
        extent = float(np.max(np.ptp(self._vertices, axis=0)))
        return BEFORE * extent * self._winding.outward * self.normals

    def side(self, points: Array) -> Array:
        """+1 or -1 (n,): where points (n, 3), m, are outside or inside by the mesh's winding."""
        return self._winding.outward * np.where(self._winding.about(points) > 0, -1.0, 1.0)

    def settle(
        self, side: Array, points: Array, face: Index, uv: Array, far: NDArray[np.bool_]
    ) -> Array:
        """The sides (n,) of points (n, 3), m, from those of their feet's own faces.

        `face` (n,) and `uv` (n, 2): the feet; `far` (n,): whether a point is farther from the flat
        face than the smooth surface is. A point at a sheet within the mesh is inside, whichever
        side of the sheet it is on.
        """
        behind = side * self._winding.outward < 0.0
        turns = self.level[face] + behind
        rows = np.flatnonzero(self.mixed[face] & far)
        turns[rows] = self._winding.about(points[rows])
        rows = np.flatnonzero(self.mixed[face] & ~far)
        weight = np.column_stack([1.0 - uv[rows].sum(axis=1), uv[rows]])
        foot = np.einsum("nk,nkc->nc", weight, self.corners[face[rows]])
        turns[rows] = self._winding.about(foot + self._before[face[rows]]) + behind[rows]
        return self._winding.outward * np.where(turns > 0, -1.0, 1.0)

    @cached_property
    def level(self) -> NDArray[np.int64]:
        """The turns (m,) about the points before each face; where it is mixed, about its middle.

        In a mesh with borders it is that of most of the area that is connected with a face and not
        crossed: what closes the borders may run through it.
        """
        found = self._winding.about(self.corners.mean(axis=1) + self._before)
        if self._winding.closed:
            return found
        cut = np.zeros(len(self.faces), dtype=bool)
        cut[self.crossed] = True
        across = np.where(cut[:, None] | cut[self.across], -1, self.across)
        part = face_components(across)
        for k in np.unique(part[~cut]):
            rows = np.flatnonzero(part == k)
            levels, place = np.unique(found[rows], return_inverse=True)
            found[rows] = levels[np.argmax(np.bincount(place.ravel(), self._areas[rows]))]
        return found

    @cached_property
    def mixed(self) -> NDArray[np.bool_]:
        """Which faces (m,) are crossed, or have a corner where faces of several levels meet."""
        at = np.zeros(len(self.first) - 1, dtype=bool)
        at[self.faces[self.crossed]] = True
        low = np.full(len(at), np.iinfo(np.int64).max)
        high = np.full(len(at), np.iinfo(np.int64).min)
        for k in range(3):
            np.minimum.at(low, self.faces[:, k], self.level)
            np.maximum.at(high, self.faces[:, k], self.level)
        at |= low < high
        return np.asarray(at[self.faces].any(axis=1))

    @property
    def _areas(self) -> Array:
        a, b, c = np.swapaxes(self.corners, 0, 1)
        return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))
