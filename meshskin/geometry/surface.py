"""The smooth surface of a mesh: closest points by Newton's method on patches, hopping over edges.

Each face carries a quintic patch (jets.py, patch.py); neighbouring patches meet exactly. A query
starts at the nearest of a set of samples of the mesh, then walks: a Newton step on the patch, and
where the step leaves the face, on through the edge into the next face.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MeshError
from . import jets, patch, walk
from .closest import Closest
from .proximity import Proximity

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ON_EDGE = 1e-9
"""barycentric weight below which a foot lies on an edge"""


class Surface:
    """Smooth surface over a triangle mesh (an object with `.vertices` (n, 3) m, `.faces` (m, 3)).

    Faces are counter-clockwise seen from outside. Vertices are in the body frame.
    """

    def __init__(self, mesh: Any) -> None:
        self.vertices: Array = np.array(mesh.vertices, dtype=float)
        self.faces: Index = np.array(mesh.faces, dtype=np.intp)
        self.neighbours, self._slot = walk.neighbours(self.faces)

    @cached_property
    def jets(self) -> jets.Jets:
        """Height fields at the vertices."""
        fitted = jets.fit(self.vertices, self.faces, self.neighbours)
        return jets.flatten_bulges(fitted, self.faces)

    @cached_property
    def patches(self) -> Array:
        """Patch coefficients (m, 21, 3), m, in the order of patch.POWERS."""
        return jets.blend(self.jets, self.faces)

    @cached_property
    def smooth(self) -> bool:
        """Whether no vertex keeps its flat faces."""
        return bool(np.all(self.jets.degree > 0))

    @cached_property
    def scale(self) -> float:
        """Largest extent of the mesh in m: proximity searches divide by it."""
        return float(np.max(np.ptp(self.vertices, axis=0)))

    @cached_property
    def _proximity(self) -> Proximity:
        return Proximity(self.vertices, self.faces)

    def closest(self, points: ArrayLike, face: ArrayLike | None = None) -> Closest:
        """Closest points of the smooth surface to `points` (n, 3), body frame, m.

        `face` (n,) may name the faces to start from (warm start). Raises MeshError where a point
        is not finite.
        """
        p = _finite(points)
        start = self._start(p) if face is None else np.array(face, dtype=np.intp)
        foot, uv, hops = self._walk(p, start, walk.closest_step)
        far = np.flatnonzero(hops >= walk.FAR)
        if len(far):
            start = self._proximity.exact(p[far])
            again, again_uv, _ = self._walk(p[far], start, walk.closest_step)
            before = self._gap(p[far], foot[far], uv[far])
            better = self._gap(p[far], again, again_uv) < before
            foot[far[better]], uv[far[better]] = again[better], again_uv[better]
        hit = self.at(foot, uv, p)
        return hit if self.smooth else replace(hit, distance=self._signed(hit, p))

    def at(self, face: ArrayLike, uv: ArrayLike, points: ArrayLike | None = None) -> Closest:
        """The surface at `face` (n,), `uv` (n, 2); distances are those of `points` (n, 3), m."""
        face, uv = np.asarray(face, dtype=np.intp), np.asarray(uv, dtype=float)
        s, su, sv, *second = patch.evaluate(self.patches[face], uv[:, 0], uv[:, 1])
        normal, curvature = patch.shape((su, sv), (second[0], second[1], second[2]))
        thin = np.flatnonzero(~normal.any(axis=1))
        if len(thin):  # a face without area takes its normal from its corners
            total = self.jets.frame[self.faces[face[thin]], 2].sum(axis=1)
            normal[thin] = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
        offset = np.zeros_like(s) if points is None else np.asarray(points, dtype=float) - s
        height = np.einsum("ij,ij->i", offset, normal)
        distance = np.copysign(np.sqrt(np.einsum("ij,ij->i", offset, offset)), height)
        return Closest(s, distance, normal, curvature, face, uv)

    def trace(self, origins: Array, directions: Array, face: Index) -> tuple[Index, Array]:
        """Where rays (n, 3) meet the surface near the faces `face` (n,): faces (n,), uv (n, 2)."""
        e1, e2 = np.swapaxes(jets.tangent_frames(directions)[:, :2], 0, 1)
        target = np.stack([origins, e1, e2], axis=1)
        return self._walk(target, face, walk.ray_step)[:2]

    def _start(self, points: Array) -> Index:
        if self.smooth:
            return self._proximity.near(points)
        return self._proximity.exact(points, candidates=12)  # sheets lie close, edges end walks

    def _walk(self, target: Array, face: Index, step: Any) -> tuple[Index, Array, Index]:
        return walk.walk(self.patches, (self.neighbours, self._slot), target, face, step)

    def _signed(self, hit: Closest, points: Array) -> Array:
        """The distances (n,), with signs that hold at creases and corners too.

        There the normal of one face does not tell; the sum over the faces that meet, weighted by
        their angles, does: Baerentzen and Aanaes, IEEE Trans. Vis. Comp. Graphics 11 (2005).
        """
        weight = np.column_stack([1.0 - hit.uv.sum(axis=1), hit.uv])
        off = weight < ON_EDGE
        normal = hit.normal.copy()
        edge = np.flatnonzero(off.sum(axis=1) == 1)
        opposite = np.argmax(off[edge], axis=1)
        beyond = self.neighbours[hit.face[edge], opposite]
        flat = self._flat_normals
        there = np.where(beyond[:, None] >= 0, flat[beyond], 0.0)
        normal[edge] = flat[hit.face[edge]] + there
        corner = np.flatnonzero(off.sum(axis=1) == 2)
        normal[corner] = self._corner_normals[
            self.faces[hit.face[corner], np.argmin(off[corner], axis=1)]
        ]
        height = np.einsum("ij,ij->i", points - hit.point, normal)
        return np.copysign(hit.distance, height)

    @cached_property
    def _flat_normals(self) -> Array:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        return np.asarray(cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None])

    @cached_property
    def _corner_normals(self) -> Array:
        """Sums (n, 3) of the faces' normals at each vertex, weighted by their angles there."""
        corners = self.vertices[self.faces]
        total = np.zeros_like(self.vertices)
        for k in range(3):
            one = corners[:, walk.AFTER[k]] - corners[:, k]
            two = corners[:, walk.BEFORE[k]] - corners[:, k]
            sine = np.linalg.norm(np.cross(one, two), axis=1)
            angle = np.arctan2(sine, np.einsum("ij,ij->i", one, two))
            np.add.at(total, self.faces[:, k], angle[:, None] * self._flat_normals)
        return total

    def _gap(self, points: Array, face: Index, uv: Array) -> Array:
        s = np.einsum("nk,nkc->nc", patch.monomials(uv[:, 0], uv[:, 1]), self.patches[face])
        return np.asarray(np.sum((s - points) ** 2, axis=1))


def _finite(points: ArrayLike) -> Array:
    p = np.array(points, dtype=float).reshape(-1, 3)
    bad = ~np.isfinite(p).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise MeshError("a query point is not finite", value=p[row].tolist(), remedy=f"row {row}")
    return p
