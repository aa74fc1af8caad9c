"""The smooth surface of a mesh: closest points by Newton's method on patches, hopping over edges.

Each face carries a quintic patch (blend.py); neighbouring patches meet exactly, at creases too. A
query starts at the nearest of a set of samples of the mesh, then walks: a Newton step on the patch,
and where the step leaves the face, on through the edge into the next face. Where creases, borders
or other sheets leave the end in doubt, it walks again from every face that may be nearer.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MeshError
from . import blend, fans, heights, jets, patch, walk
from .closest import Closest
from .proximity import Proximity, thin_walled

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SAMPLES = 20_000
"""samples, at least, of a mesh with creases, whose faces may be long"""
FEW, NEAR, WIDE = 8, 24, 48
"""nearest samples whose faces are looked at for a start, where each face has one and where long
faces have many, and where a walk's end is in doubt"""
SLACK = 1.3
"""a patch's height over its face, over that at its nodes"""
ON_EDGE = 1e-9
"""barycentric weight below which a foot lies on an edge"""


class Surface:
    """Smooth surface over a triangle mesh (an object with `.vertices` (n, 3) m, `.faces` (m, 3)).

    Faces are counter-clockwise seen from outside. Vertices are in the body frame.
    """

    def __init__(
        self, mesh: Any, seams: ArrayLike | None = None, degree: int = heights.DEGREE
    ) -> None:
        """`seams` (k, 2): pairs of vertices over whose edges the curvature jumps, where known.

        `degree` (2 to 4): the highest of the height fields at the vertices.
        """
        self.vertices: Array = np.array(mesh.vertices, dtype=float)
        self.faces: Index = np.array(mesh.faces, dtype=np.intp)
        self.neighbours, self._slot = walk.neighbours(self.faces)
        self._seams = None if seams is None else np.asarray(seams, dtype=np.intp)
        self._degree = degree

    @cached_property
    def fans(self) -> fans.Fans:
        """The vertices split at creases."""
        return fans.split(self.vertices, self.faces, (self.neighbours, self._slot), self._seams)

    @cached_property
    def _shape(self) -> tuple[jets.Jets, blend.Creases]:
        fitted = jets.fit(self.vertices, self.fans, self._degree)
        return blend.settle(fitted, self.fans, self.neighbours, self._slot)

    @property
    def jets(self) -> jets.Jets:
        """Height fields at the fans."""
        return self._shape[0]

    @cached_property
    def patches(self) -> Array:
        """Patch coefficients (m, 21, 3), m, in the order of patch.POWERS."""
        fitted, creases = self._shape
        return blend.blend(fitted, self.fans, creases)

    @cached_property
    def smooth(self) -> bool:
        """Whether there is no crease, border, thin wall, or vertex that keeps its flat faces."""
        if self.fans.creased or np.any(self.jets.degree == 0):
            return False
        return not thin_walled(self.vertices, self.faces)

    @cached_property
    def scale(self) -> float:
        """Largest extent of the mesh in m: proximity searches divide by it."""
        return float(np.max(np.ptp(self.vertices, axis=0)))

    @cached_property
    def _proximity(self) -> Proximity:
        return Proximity(self.vertices, self.faces, least=0 if self.smooth else SAMPLES)

    def closest(self, points: ArrayLike, face: ArrayLike | None = None) -> Closest:
        """Closest points of the smooth surface to `points` (n, 3), body frame, m.

        `face` (n,) may name the faces to start from (warm start). Raises MeshError where a point
        is not finite.
        """
        p = _finite(points)
        if self.smooth:
            start = self._proximity.near(p) if face is None else np.array(face, dtype=np.intp)
            foot, uv, hops = self._walk(p, start)
            far = np.flatnonzero(hops >= walk.FAR)
            if len(far):
                start = self._proximity.exact(p[far])
                self._try(p, foot, uv, far, start, np.full((len(far), 2), 1.0 / 3.0))
            return self.at(foot, uv, p)
        if face is None:
            near = self._proximity.nearby(p, NEAR if self._proximity.cut else FEW)
            row, first = np.arange(len(p)), np.argmin(near[1], axis=1)
            foot, uv, hops = self._walk(p, near[0][row, first], start=near[2][row, first])
            self._search(p, foot, uv, row, near)
            most = np.min(near[1] + self._height[near[0]], axis=1)
            stuck = np.flatnonzero(self._gap(p, foot, uv) > 1.0001 * most)  # at a crease's end
            if len(stuck):
                again, k = np.repeat(stuck, near[0].shape[1]), near[0][stuck].ravel()
                self._try(p, foot, uv, again, k, np.full((len(k), 2), 1.0 / 3.0))
        else:
            foot, uv, hops = self._walk(p, np.array(face, dtype=np.intp))
        doubtful = np.flatnonzero(hops >= walk.FAR)
        if len(doubtful):
            self._search(p, foot, uv, doubtful, self._proximity.nearby(p[doubtful], WIDE))
        hit = self.at(foot, uv, p)
        outward = self._outward(hit.face, hit.uv, hit.normal)
        side = np.einsum("ij,ij->i", p - hit.point, outward)
        if face is None:
            flat = self._flat_side(p, hit, near)
            side = np.where(flat != 0.0, flat, side)
        return replace(hit, distance=np.copysign(hit.distance, side))

    def _search(
        self,
        points: Array,
        foot: Index,
        uv: Array,
        rows: Index,
        near: tuple[Index, Array, Array],
    ) -> None:
        """Walk again, in place, from every face whose patch may be nearer than what was found.

        `near`: flat faces near the points `rows` (k,), as of Proximity.nearby.
        """
        order = np.argsort(near[0], axis=1)
        faces = np.take_along_axis(near[0], order, axis=1)
        least = np.take_along_axis(near[1], order, axis=1) - self._height[faces]
        found = self._gap(points[rows], foot[rows], uv[rows])
        wanted = (least < 0.9999 * found[:, None]) & (faces != foot[rows, None])
        wanted[:, 1:] &= faces[:, 1:] != faces[:, :-1]
        row, k = np.nonzero(wanted)
        if len(row):
            self._try(points, foot, uv, rows[row], faces[row, k], near[2][row, order[row, k]])

    def _try(
        self, points: Array, foot: Index, uv: Array, rows: Index, face: Index, start: Array
    ) -> None:
        """Walk from `face`, `start` for the points `rows` (k,), which may repeat; keep the best."""
        again, again_uv, _ = self._walk(points[rows], face, start=start)
        gap = self._gap(points[rows], again, again_uv)
        best = np.lexsort((gap, rows))
        best = best[np.unique(rows[best], return_index=True)[1]]
        here = rows[best]
        better = gap[best] < self._gap(points[here], foot[here], uv[here])
        foot[here[better]], uv[here[better]] = again[best[better]], again_uv[best[better]]

    @cached_property
    def _height(self) -> Array:
        """Bounds (m,) of the distances in m between the patches and the flat faces."""
        out = np.empty(len(self.faces))
        for start in range(0, len(out), blend.CHUNK):
            rows = slice(start, start + blend.CHUNK)
            nodes = blend.BASIS @ self.patches[rows]
            flat = blend.WEIGHTS @ self.vertices[self.faces[rows]]
            out[rows] = SLACK * np.linalg.norm(nodes - flat, axis=2).max(axis=1)
        return out

    def at(self, face: ArrayLike, uv: ArrayLike, points: ArrayLike | None = None) -> Closest:
        """The surface at `face` (n,), `uv` (n, 2); distances are those of `points` (n, 3), m."""
        face, uv = np.asarray(face, dtype=np.intp), np.asarray(uv, dtype=float)
        s, su, sv, *second = patch.evaluate(self.patches[face], uv[:, 0], uv[:, 1])
        normal, curvature, direction = patch.shape((su, sv), (second[0], second[1], second[2]))
        thin = np.flatnonzero(~normal.any(axis=1))
        if len(thin):  # a face without area takes its normal from its corners
            total = self.jets.frame[self.fans.corner[face[thin]], 2].sum(axis=1)
            normal[thin] = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
            direction[thin] = jets.tangent_frames(normal[thin])[:, 0]
        offset = np.zeros_like(s) if points is None else np.asarray(points, dtype=float) - s
        height = np.einsum("ij,ij->i", offset, normal)
        distance = np.copysign(np.sqrt(np.einsum("ij,ij->i", offset, offset)), height)
        return Closest(s, distance, normal, curvature, direction, face, uv)

    def trace(self, origins: Array, directions: Array, face: Index) -> tuple[Index, Array]:
        """Where rays (n, 3) meet the surface near the faces `face` (n,): faces (n,), uv (n, 2)."""
        e1, e2 = np.swapaxes(jets.tangent_frames(directions)[:, :2], 0, 1)
        target = np.stack([origins, e1, e2], axis=1)
        return self._walk(target, face, walk.ray_step)[:2]

    def _walk(
        self, target: Array, face: Index, step: Any = walk.closest_step, start: Array | None = None
    ) -> tuple[Index, Array, Index]:
        return walk.walk(self.patches, (self.neighbours, self._slot), target, face, step, start)

    def _outward(self, face: Index, uv: Array, normal: Array) -> Array:
        """Directions (n, 3) that tell outside from inside at creases and corners too.

        There the normal of one face does not tell; the sum over the faces that meet, weighted by
        their angles, does: Baerentzen and Aanaes, IEEE Trans. Vis. Comp. Graphics 11 (2005).
        """
        off = np.column_stack([1.0 - uv.sum(axis=1), uv]) < ON_EDGE
        normal = normal.copy()
        edge = np.flatnonzero(off.sum(axis=1) == 1)
        beyond = self.neighbours[face[edge], np.argmax(off[edge], axis=1)]
        flat = self._flat_normals
        normal[edge] = flat[face[edge]] + np.where(beyond[:, None] >= 0, flat[beyond], 0.0)
        corner = np.flatnonzero(off.sum(axis=1) == 2)
        vertex = self.faces[face[corner], np.argmin(off[corner], axis=1)]
        normal[corner] = self._corner_normals[vertex]
        return normal

    def _flat_side(self, points: Array, hit: Closest, near: tuple[Index, Array, Array]) -> Array:
        """On which side (n,), by its sign, of the flat mesh points are; 0 where that tells nothing.

        It tells where a point is farther from the flat face than the patches are: the patches of
        a coarse thin body may pass through each other, its faces do not.
        """
        row, first = np.arange(len(points)), np.argmin(near[1], axis=1)
        face, gap, uv = (part[row, first] for part in near)
        weight = np.column_stack([1.0 - uv.sum(axis=1), uv])
        foot = np.einsum("nk,nkc->nc", weight, self.vertices[self.faces[face]])
        outward = self._outward(face, uv, self._flat_normals[face])
        side = np.einsum("ij,ij->i", points - foot, outward)
        clear = gap > np.maximum(self._height[face], self._height[hit.face])
        return np.where(clear, side, 0.0)

    @cached_property
    def _flat_normals(self) -> Array:
        return fans.face_normals(self.vertices, self.faces)

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
        """Distances (n,) in m from points to the surface at `face`, `uv`."""
        s = np.einsum("nk,nkc->nc", patch.monomials(uv[:, 0], uv[:, 1]), self.patches[face])
        return np.asarray(np.sqrt(np.sum((s - points) ** 2, axis=1)))


def _finite(points: ArrayLike) -> Array:
    p = np.array(points, dtype=float).reshape(-1, 3)
    bad = ~np.isfinite(p).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise MeshError("a query point is not finite", value=p[row].tolist(), remedy=f"row {row}")
    return p
