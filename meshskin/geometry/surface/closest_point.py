"""Closest points of a surface: what a query returns, and the reference search.

The search used where there is a C compiler is compiled_search.py; trimesh's and libigl's searches
find points of flat faces only, at 2.3 ms and 5 to 10 us each, and embree has no such query. Without
a compiler, the R-tree (rtree) that trimesh keeps of a mesh gives the faces that may be nearest, and
Newton's method the closest points on their patches (newton.py). Its tolerances are absolute:
trimesh is given millimetres about the middle of the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...core.arrays import Array, Index
from ...core.value import Value
from ..mesh.triangles import closest_on_triangles
from . import newton, patch

if TYPE_CHECKING:
    from .surface import Surface


MM = 1e3
"""millimetres in a metre"""
CHUNK = 256
"""queries looked up in the R-tree at once: bounds the memory where each has many faces near"""


@dataclass(frozen=True, eq=False)
class Closest(Value):
    """Points of a surface answering n queries, in the body frame, SI units."""

    point: Array
    """(n, 3) closest points of the surface, in m"""
    distance: Array
    """(n,) signed distance in m, negative inside (for rays: the distance along the ray)"""
    normal: Array
    """(n, 3) outward unit normals"""
    curvature: Array
    """(n, 2) principal curvatures in 1/m, positive where convex, larger first"""
    direction: Array
    """(n, 3) unit tangents along the first principal curvature; any tangent where both are equal"""
    face: Index
    """(n,) faces of the mesh; -1 where a ray missed (its other entries are NaN)"""
    uv: Array
    """(n, 2) barycentric weights of the face's second and third vertex"""

    def take(self, rows: Any) -> Closest:
        """The answers of some rows: a slice, a mask or indices."""
        return Closest(*(getattr(self, f.name)[rows] for f in fields(self)))

    def split(self, counts: Sequence[int]) -> list[Closest]:
        """The answers in consecutive parts of `counts` rows."""
        ends = np.cumsum(counts)
        return [self.take(slice(a, b)) for a, b in zip((0, *ends[:-1]), ends, strict=True)]

    @classmethod
    def concatenate(cls, parts: Sequence[Closest]) -> Closest:
        """The answers of several, one after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


class FlatPoints(NamedTuple):
    """Closest points of the flat faces to n points."""

    face: Index
    """(n,)"""
    uv: Array
    """(n, 2) barycentric weights of the face's second and third vertex"""
    distance: Array
    """(n,) distances in m, not negative"""


class PatchPoints(NamedTuple):
    """Closest points of the patches to n points."""

    face: Index
    """(n,)"""
    uv: Array
    """(n, 2) barycentric weights of the face's second and third vertex"""
    derivatives: tuple[Array, ...]
    """S, Su, Sv, Suu, Suv, Svv, each (n, 3), of the patches there"""
    flat: FlatPoints | None
    """closest points of the flat faces; None on a smooth surface, and with a start of the search"""


class ReferenceFlat:
    """Closest points of the faces (m, 3) of a mesh of vertices (n, 3), m, by trimesh's R-tree."""

    def __init__(self, vertices: Array, faces: Index) -> None:
        import trimesh
        from scipy.spatial import KDTree

        self._middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        mesh = trimesh.Trimesh(MM * (vertices - self._middle), faces, process=False)
        self._boxes = mesh.triangles_tree
        self._vertices = KDTree(mesh.vertices[mesh.referenced_vertices])
        self._corners = vertices[faces]

    def closest(self, p: Array) -> FlatPoints:
        """The closest points to p (n, 3), m."""
        row, face, uv, distance = self.nearby(p, 0.0)
        best = newton.least_of_rows(row, distance)
        return FlatPoints(face[best], uv[best], distance[best])

    def nearby(self, p: Array, margin: float) -> tuple[Index, Index, Array, Array]:
        """All faces (k,) that may be nearest to the points `row` (k,) of p, and others.

        May be: no more than `margin` (m) farther than the nearest. Gives row, face, the closest
        points' uv (k, 2) and distances (k,), m.
        """
        parts = []
        for start in range(0, max(len(p), 1), CHUNK):
            q = MM * (p[start : start + CHUNK] - self._middle)
            reach = (1.0 + 1e-9) * self._vertices.query(q)[0][:, None] + MM * margin
            found, count = self._boxes.intersection_v(q - reach, q + reach)
            parts.append((found, np.repeat(start + np.arange(len(q)), count.astype(np.intp))))
        face, row = (np.concatenate(part).astype(np.intp) for part in zip(*parts, strict=True))
        a, b, c = np.swapaxes(self._corners[face], 0, 1)
        distance2, uv = closest_on_triangles(p[row], a, b - a, c - a)
        return row, face, uv, np.sqrt(distance2)


class ReferenceSearch:
    """Closest points of the patches of a surface, without a compiler.

    The closest point lies on a face whose flat distance, less the patch's height over the face, is
    no more than the least sum of both: from the flat closest point of each such face Newton's
    method finds the minimum on its patch, and the least of them is the closest point.
    """

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._flat = ReferenceFlat(surface.vertices, surface.faces)

    def closest(self, p: Array, face: Index | None) -> PatchPoints:
        """The closest points to p (n, 3), m; `face` (n,), where a search could start, is unused."""
        offsets = self._surface.offsets
        row, near, uv, distance = self._flat.nearby(p, 2.0 * float(offsets.max()))
        flat = None
        if face is None and not self._surface.smooth:
            best = newton.least_of_rows(row, distance)
            flat = FlatPoints(near[best], uv[best], distance[best])
        bound = np.full(len(p), np.inf)
        np.minimum.at(bound, row, distance + offsets[near])
        possible = distance - offsets[near] <= (1.0 + 1e-12) * bound[row]
        row, near, uv = row[possible], near[possible], uv[possible]
        found, uv = newton.descend(self._surface, near, p[row], newton.point_distance, uv)
        derivatives = self.derivatives(found, uv)
        best = newton.least_of_rows(row, np.linalg.norm(derivatives[0] - p[row], axis=1))
        return PatchPoints(found[best], uv[best], tuple(d[best] for d in derivatives), flat)

    def derivatives(self, face: Index, uv: Array) -> tuple[Array, ...]:
        """S, Su, Sv, Suu, Suv, Svv, each (n, 3), of the patches `face` (n,) at uv (n, 2)."""
        return patch.evaluate(self._surface.patches[face], uv[:, 0], uv[:, 1])
