"""Inside or outside of a mesh that passes through itself, or whose normals disagree at an edge.

Where the nearest point of a closed mesh lies on an edge or at a vertex, the faces that meet there
all face a point outside, and none faces a point inside. Where only some do, either the normals of
those faces differ little from their mean (a saddle vertex, as on the rim of a coarse cylinder), and
the normals decide, or the mesh is folded back on itself, and the winding number at the point does.

Where parts of a mesh intersect, faces lie within it that have inside on both sides: the winding
number is computed once in front of each face, and near intersections at the query point itself.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index, ranges, rows_by_key
from .topology import corners_by_vertex, face_components
from .winding_number import WindingNumber

ON_EDGE = 1e-9
"""barycentric weight below which a point of a face lies on its edge: well above the rounding of the
weights, 1e-16 over the sine of the face's smallest angle"""
SADDLE_COSINE = 0.65
"""least cosine of the angle between the normal of a face and the mean of those that meet it, at a
saddle: cos 45 deg (the rim of a cylinder, cap and side) less 8 %"""
GRAZING_SINE = 1e-6
"""sine of a point's elevation over a face up to which it is taken to lie in the face's plane, where
rounding would decide the sign"""
STANDOFF = 1e-7
"""distance in front of a face at which its winding number is computed, relative to the extent of
the mesh: far above rounding, far below the thickness of a body"""
MOST = 0.5
"""part of the area whose front closed borders put inside, beyond which they are left open: normals
were turned outward, so that most fronts are outside. It was 0.97 and 0.63 on links of 122 and 25
panels of which 0.49 and 0.97 are visible; at most 0.38 on 40 other links"""
SAMPLED = 4000
"""number of faces about which that part is measured: to 0.01"""
MEMBERS, CLEAR = 400, 0.9
"""number of faces of a component about which its level is sought, and the part of their area from
which they tell it"""
UNKNOWN = np.iinfo(np.int64).min
"""no winding number"""


class InsideOutside:
    """Signs of points by the faces around their nearest edge or vertex, and by winding numbers.

    The mesh has vertices (n, 3), m, faces (m, 3) with unit normals (m, 3), and neighbours `across`
    (m, 3), -1 for none. `crossed` (k,): faces at which the mesh passes through itself, or that have
    an edge of more than two faces.
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
        self._fronts: dict[WindingNumber, NDArray[np.int64]] = {}  # UNKNOWN: not yet computed

    def ambiguous(self, face: Index, weight: Array, offset: Array) -> Index:
        """The rows (k,) of nearest points at which the mesh is folded back on itself.

        `face` (n,) and `weight` (n, 3), barycentric: the nearest points of the flat mesh; `offset`
        (n, 3), m: from them to the query points.
        """
        if not (self.closed or len(self.crossed)):
            return np.zeros(0, dtype=np.intp)
        on = weight > ON_EDGE
        rows = np.flatnonzero(on.sum(axis=1) < 3)
        start = np.argmax(on[rows], axis=1)
        end = 2 - np.argmax(on[rows][:, ::-1], axis=1)
        tail, head = self.faces[face[rows], start], self.faces[face[rows], end]
        size = self.first[tail + 1] - self.first[tail]
        owner = self.order[ranges(self.first[tail], size)] // 3
        row = np.repeat(np.arange(len(rows)), size)
        meets = np.any(self.faces[owner] == head[row, None], axis=1)  # at a vertex all do
        owner, row = owner[meets], row[meets]
        unit = offset[rows] / np.maximum(np.linalg.norm(offset[rows], axis=1), 1e-300)[:, None]
        sine = np.einsum("ij,ij->i", self.normals[owner], unit[row])
        front = np.bincount(row[sine > GRAZING_SINE], minlength=len(rows))
        back = np.bincount(row[sine < -GRAZING_SINE], minlength=len(rows))
        mixed = np.flatnonzero(((front > 0) & (back > 0))[row])
        normal, row = self.normals[owner[mixed]], row[mixed]
        means = np.zeros((2, len(rows), 3))  # of the faces in front of the point, and of the others
        np.add.at(means, ((sine[mixed] < 0.0).astype(int), row), normal)
        means /= np.maximum(np.linalg.norm(means, axis=2, keepdims=True), 1e-300)
        mean = means.sum(axis=0)[row]
        cosine = np.einsum("ij,ij->i", normal, mean)
        folded = cosine < SADDLE_COSINE * np.linalg.norm(mean, axis=1)
        return np.asarray(rows[np.unique(row[folded])])

    @cached_property
    def _winding(self) -> WindingNumber:
        """The winding number; borders of several parts are left open where closing them puts most
        fronts inside."""
        closed = WindingNumber(self._vertices, self.faces)
        if closed.closed or not face_components(self.across).any():
            return closed
        some = np.arange(0, len(self.faces), -(-len(self.faces) // SAMPLED))
        inside = self._in_front(closed, some) > 0
        if float(self._areas[some] @ inside) <= MOST * float(self._areas[some].sum()):
            return closed
        return self._bare

    @cached_property
    def _bare(self) -> WindingNumber:
        """The winding number without the closures of the borders."""
        return WindingNumber(self._vertices, self.faces, close=False)

    @cached_property
    def _areas(self) -> Array:
        """Twice the areas of the faces (m,), m^2."""
        a, b, c = np.swapaxes(self.corners, 0, 1)
        return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))

    @cached_property
    def _standoff(self) -> Array:
        """Offsets (m, 3), m, along the normals of the faces to points close to them."""
        return STANDOFF * float(np.max(np.ptp(self._vertices, axis=0))) * self.normals

    def _in_front(self, winding: WindingNumber, rows: Index) -> NDArray[np.int64]:
        """Winding numbers (k,) in front of the middles of faces (k,), each computed once."""
        known = self._fronts.setdefault(winding, np.full(len(self.faces), UNKNOWN))
        new = rows[known[rows] == UNKNOWN]
        points = self.corners[new].mean(axis=1) + winding.outward * self._standoff[new]
        known[new] = winding.at(points)
        return known[rows]

    def side(self, points: Array) -> Array:
        """+1 or -1 (n,): points (n, 3), m, outside or inside by their winding numbers."""
        return self._winding.outward * np.where(self._winding.at(points) > 0, -1.0, 1.0)

    def resolve(
        self, side: Array, points: Array, face: Index, uv: Array, far: NDArray[np.bool_]
    ) -> Array:
        """Sides (n,) of points (n, 3), m, from the sides of their nearest faces that they are on.

        `face` (n,) and `uv` (n, 2): the nearest points; `far` (n,): whether a point is farther from
        the flat face than the smooth surface is. A point at a face within the mesh is inside,
        whichever side of the face it is on.
        """
        behind = side * self._winding.outward < 0.0
        winding = self.level[face] + behind
        rows = np.flatnonzero(self.mixed[face] & far)
        winding[rows] = self._winding.at(points[rows])
        rows = np.flatnonzero(self.mixed[face] & ~far)
        winding[rows] = self._in_front_at(face[rows], uv[rows]) + behind[rows]
        return self._winding.outward * np.where(winding > 0, -1.0, 1.0)

    def _in_front_at(self, face: Index, uv: Array) -> NDArray[np.int64]:
        """Winding numbers (n,) in front of the points `uv` (n, 2) of the flat faces (n,)."""
        weight = np.column_stack([1.0 - uv.sum(axis=1), uv])
        foot = np.einsum("nk,nkc->nc", weight, self.corners[face])
        return self._winding.at(foot + self._winding.outward * self._standoff[face])

    def buried(self, face: Index, uv: Array) -> NDArray[np.bool_]:
        """Whether (n,) a part of the mesh covers the points `uv` (n, 2) of the faces (n,).

        Their fronts are within it: of a mesh with borders those of the whole faces, and only where
        the mesh covers them without the closures of its borders, too.
        """
        found = self._winding.outward * self.level[face] > 0
        if self._winding.closed:
            rows = np.flatnonzero(self.mixed[face])
            found[rows] = self._winding.outward * self._in_front_at(face[rows], uv[rows]) > 0
        elif found.any():
            found[found] = self._in_front(self._bare, face[found]) > 0
        return np.asarray(found)

    @cached_property
    def covers(self) -> bool:
        """Whether a part of the mesh may cover a face of another one."""
        return bool(np.any(self._winding.outward * self.level > 0) or len(self.crossed))

    @cached_property
    def level(self) -> NDArray[np.int64]:
        """Winding numbers (m,) in front of the faces; of a mixed face, in front of its middle.

        In a mesh with borders it is that of most of the area connected with a face through faces
        that are not crossed: the closure of a border may intersect the mesh.
        """
        if self._winding.closed:
            return self._in_front(self._winding, np.arange(len(self.faces)))
        cut = np.zeros(len(self.faces), dtype=bool)
        cut[self.crossed] = True
        found = np.empty(len(self.faces), dtype=np.int64)
        found[cut] = self._in_front(self._winding, np.flatnonzero(cut))
        across = np.where(cut[:, None] | cut[self.across], -1, self.across)
        for rows in rows_by_key(np.where(cut, -1, face_components(across))):
            if not cut[rows[0]]:
                found[rows] = self._common(rows)
        return found

    def _common(self, rows: Index) -> np.int64:
        """The winding number in front of most of the area of the faces `rows` (k,)."""
        for some in (rows[:: -(-len(rows) // MEMBERS)], rows):
            levels, place = np.unique(self._in_front(self._winding, some), return_inverse=True)
            shares = np.bincount(place.ravel(), self._areas[some])
            if shares.max() >= CLEAR * shares.sum():
                break
        return np.int64(levels[np.argmax(shares)])

    @cached_property
    def mixed(self) -> NDArray[np.bool_]:
        """Which faces (m,) are crossed, or have a vertex where faces of several levels meet."""
        at = np.zeros(len(self.first) - 1, dtype=bool)
        at[self.faces[self.crossed]] = True
        low = np.full(len(at), np.iinfo(np.int64).max)
        high = np.full(len(at), np.iinfo(np.int64).min)
        for k in range(3):
            np.minimum.at(low, self.faces[:, k], self.level)
            np.maximum.at(high, self.faces[:, k], self.level)
        at |= low < high
        return np.asarray(at[self.faces].any(axis=1))
