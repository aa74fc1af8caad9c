"""The smooth surface of a mesh: closest points, normals and curvatures on patches.

Each face has a quintic patch (blend.py); neighbouring patches meet exactly, at creases too. Closest
points are found in C (compiled_search.py), or without a compiler by trimesh's R-tree and NumPy
(closest_point.py).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_vectors
from ...core.arrays import Array, Index
from ...core.errors import MeshError
from ...core.se3 import orthonormal_basis
from ..mesh.inside_outside import ON_EDGE, InsideOutside
from ..mesh.topology import NEXT, PREVIOUS, face_components, neighbours
from ..mesh.triangles import face_normals
from . import blend, compiled_search, fans, heights, jets, newton, patch
from .closest_point import Closest, FlatPoints, ReferenceFlat, ReferenceSearch
from .compiled_search import CompiledFlat, CompiledSearch

OFFSET_MARGIN = 1.3
"""bound of the height of a patch over its face, relative to the largest height at its nodes"""
EDGE_COSINE = np.cos(np.deg2rad(20.0))
"""cosine of the turn of the surface's normal from which a crease is an edge: facets of a sphere
turn by 1.5 to 2.9 degrees with 5,120 faces, by 7 to 11 with 320; edges of solids by 30 or more"""
EDGE_SAMPLES = (0.1, 0.5, 0.9)
"""relative positions along an edge at which its normals are compared"""


class Surface:
    """Smooth surface of a triangle mesh (an object with `.vertices` (n, 3) m, `.faces` (m, 3)).

    Faces are counter-clockwise seen from outside. Vertices are in the body frame.
    """

    def __init__(
        self,
        mesh: Any,
        seams: ArrayLike | None = None,
        degree: int = heights.DEGREE,
        crossed: ArrayLike | None = None,
    ) -> None:
        """`seams` (k, 2): pairs of vertices across whose edges the curvature is known to jump.

        `degree` (2 to 4): highest degree of the height fields at the vertices. `crossed` (k,):
        faces known to intersect others, or to have edges of more than two faces.
        """
        self.vertices: Array = np.array(mesh.vertices, dtype=float)
        self.faces: Index = np.array(mesh.faces, dtype=np.intp)
        self.neighbours, self.slot = neighbours(self.faces)
        self._seams = None if seams is None else np.asarray(seams, dtype=np.intp)
        self._crossed = np.asarray([] if crossed is None else crossed, dtype=np.intp)
        self._degree = degree

    @cached_property
    def fans(self) -> fans.Fans:
        """The fans of the vertices between creases."""
        return fans.split_fans(self.vertices, self.faces, (self.neighbours, self.slot), self._seams)

    @cached_property
    def _shape(self) -> tuple[jets.Jets, blend.Creases]:
        fitted = jets.fit_jets(self.vertices, self.fans, self._degree)
        return blend.regularize(fitted, self.fans, self.neighbours, self.slot)

    @property
    def jets(self) -> jets.Jets:
        """Height fields at the fans."""
        return self._shape[0]

    @cached_property
    def _blend(self) -> tuple[Array, Array]:
        fitted, creases = self._shape
        return blend.blend_patches(fitted, self.fans, creases, self.vertices[self.faces])

    @property
    def patches(self) -> Array:
        """Patch coefficients (m, 21, 3), m, in the order of patch.POWERS."""
        return self._blend[0]

    @cached_property
    def offsets(self) -> Array:
        """Bounds (m,) of the distances in m between the patches and the flat faces."""
        return OFFSET_MARGIN * self._blend[1]

    @cached_property
    def smooth(self) -> bool:
        """Whether there are no creases, borders, thin walls, and vertices that keep flat faces."""
        if self.fans.creased or len(self._crossed) or np.any(self.jets.degree == 0):
            return False
        return not thin_walled(self.vertices, self.faces)

    @cached_property
    def edges(self) -> Array:
        """Ends (k, 2, 3), m, of the edges and borders: there the normal of the smooth surface
        jumps, or ends; a jump of the curvature alone is not an edge.
        """
        if self.smooth:
            return np.zeros((0, 2, 3))
        beyond, slot = self.neighbours.ravel(), self.slot.ravel()
        face, corner = np.divmod(np.arange(beyond.size), 3)
        kept = np.flatnonzero(beyond < face)  # borders, and every inner edge from one side
        face, corner, beyond, slot = (x[kept] for x in (face, corner, beyond, slot))
        jump, inner = beyond < 0, np.flatnonzero(beyond >= 0)
        for part in EDGE_SAMPLES:
            here = self.at(face[inner], _along(corner[inner], part)).normal
            there = self.at(beyond[inner], _along(slot[inner], 1.0 - part)).normal
            jump[inner] |= np.sum(here * there, axis=1) < EDGE_COSINE
        face, corner = face[jump], corner[jump]
        ends = [self.vertices[self.faces[face, (corner + k) % 3]] for k in (1, 2)]
        return np.stack(ends, axis=1)

    @cached_property
    def pieces(self) -> Index:
        """The connected piece of the mesh, from 0, to which each face belongs (m,)."""
        return face_components(self.neighbours)

    @cached_property
    def covered(self) -> bool:
        """Whether a part of the mesh may cover another one."""
        parted = bool(len(self._crossed) or self.pieces.any())
        return parted and self._inside_outside.covers

    def buried(self, at: Closest) -> NDArray[np.bool_]:
        """Whether (n,) another part of the mesh covers the surface at some points."""
        if not self.covered:
            return np.zeros(len(at.face), dtype=bool)
        return self._inside_outside.buried(at.face, at.uv)

    @cached_property
    def closed(self) -> bool:
        """Whether the mesh has no border."""
        return bool((self.neighbours >= 0).all())

    @cached_property
    def bounds(self) -> Array:
        """Least and largest coordinates (2, 3), m, of the vertices."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def scale(self) -> float:
        """Largest extent of the mesh in m."""
        return float(np.max(np.ptp(self.vertices, axis=0)))

    @cached_property
    def _search(self) -> ReferenceSearch | CompiledSearch:
        built = compiled_search.library()
        return ReferenceSearch(self) if built is None else CompiledSearch(self, built)

    def __getstate__(self) -> dict[str, Any]:
        """All but the search, whose addresses are valid in this process alone."""
        return {name: value for name, value in self.__dict__.items() if name != "_search"}

    def closest(self, points: ArrayLike, face: ArrayLike | None = None) -> Closest:
        """Closest points of the smooth surface to `points` (n, 3), body frame, m.

        The search may start from the faces `face` (n,) (warm start). Raises MeshError where a point
        is not finite or a face does not exist.
        """
        p = _finite(points)
        hit, flat = self._nearest(p, face)
        if self.smooth:
            return hit
        return replace(hit, distance=np.copysign(hit.distance, self._side(p, hit, flat)))

    def nearest(self, points: ArrayLike, face: ArrayLike | None = None) -> Closest:
        """The closest points as of `closest`, without its test of inside and outside.

        The sign of the distance is that of the normal at the closest point. It takes a third of
        the time for single points of a surface with creases.
        """
        return self._nearest(_finite(points), face)[0]

    def _nearest(self, p: Array, face: ArrayLike | None) -> tuple[Closest, FlatPoints | None]:
        start = None if face is None else self._known(face, len(p))
        found, uv, derivatives, flat = self._search.closest(p, start)
        return self._answer(found, uv, derivatives, p), flat

    def _known(self, face: ArrayLike, count: int) -> Index:
        """Faces (count,). Raises MeshError for another number, or one that does not exist."""
        known = np.asarray(face)
        if known.shape not in ((), (count,)) or (known.dtype.kind not in "iu" and known.size):
            raise MeshError(
                "faces must be integers, one for each point",
                value=f"shape {known.shape} of {known.dtype}",
                limit=f"({count},)",
            )
        known = np.broadcast_to(known.astype(np.intp), count)
        beside = np.flatnonzero((known < 0) | (known >= len(self.faces)))
        if len(beside):
            raise MeshError(
                "no such face of the mesh",
                value=int(known[beside[0]]),
                limit=f"0 to {len(self.faces) - 1}",
                remedy=f"row {beside[0]}: -1 is the face of a ray that missed",
            )
        return known

    def at(self, face: ArrayLike, uv: ArrayLike, points: ArrayLike | None = None) -> Closest:
        """The surface at `face` (n,), `uv` (n, 2); distances are those of `points` (n, 3), m."""
        uv = np.asarray(uv, dtype=float)
        face = self._known(face, len(uv))
        query = None if points is None else np.asarray(points, dtype=float)
        return self._answer(face, uv, self._search.derivatives(face, uv), query)

    def _answer(
        self, face: Index, uv: Array, derivatives: tuple[Array, ...], points: Array | None
    ) -> Closest:
        s, su, sv, *second = derivatives
        normal, curvature, direction = patch.shape((su, sv), (second[0], second[1], second[2]))
        thin = np.flatnonzero(~normal.any(axis=1))
        if len(thin):  # faces without area take the mean normal of their corners
            total = self.jets.frame[self.fans.corner[face[thin]], 2].sum(axis=1)
            normal[thin] = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
            direction[thin] = orthonormal_basis(normal[thin])[:, :, 0]
        offset = np.zeros_like(s) if points is None else points - s
        height = np.einsum("ij,ij->i", offset, normal)
        distance = np.copysign(np.sqrt(np.einsum("ij,ij->i", offset, offset)), height)
        return Closest(s, distance, normal, curvature, direction, face, uv)

    def trace(self, origins: Array, directions: Array, face: Index) -> tuple[Index, Array]:
        """Points nearest to rays (n, 3), by descent from `face` (n,): faces (n,), uv (n, 2)."""
        e1, e2, _ = np.moveaxis(orthonormal_basis(directions), 2, 0)
        target = np.stack([origins, e1, e2], axis=1)
        return newton.descend(self, face, target, newton.ray_distance)

    def _outward(self, face: Index, uv: Array, normal: Array) -> Array:
        """Pseudonormals (n, 3): their sides decide between outside and inside at creases too.

        There the sum of the normals of the faces that meet, weighted by their angles, replaces the
        normal of one face: Baerentzen and Aanaes, IEEE Trans. Vis. Comp. Graphics 11 (2005).
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

    def _side(self, points: Array, hit: Closest, flat: FlatPoints | None) -> Array:
        """Sides (n,), by their signs, of the surface that points are on.

        Where a point is farther from the flat mesh than the patches are, the flat mesh decides: the
        patches of a coarse thin body may intersect, its faces do not.
        """
        side = np.zeros(len(points))
        if flat is not None:
            height = np.maximum(self.offsets[flat.face], self.offsets[hit.face])
            rows = np.flatnonzero(flat.distance > height)
            face, uv = flat.face[rows], flat.uv[rows]
            weight = np.column_stack([1.0 - uv.sum(axis=1), uv])
            foot = np.einsum("nk,nkc->nc", weight, self.vertices[self.faces[face]])
            outward = self._outward(face, uv, self._flat_normals[face])
            offset = points[rows] - foot
            side[rows] = np.einsum("ij,ij->i", offset, outward)
            doubtful = rows[self._inside_outside.ambiguous(face, weight, offset)]
            if len(doubtful):  # the first query builds a tree over the mesh
                side[doubtful] = self._inside_outside.side(points[doubtful])
        rows = np.flatnonzero(side == 0.0)
        outward = self._outward(hit.face[rows], hit.uv[rows], hit.normal[rows])
        side[rows] = np.einsum("ij,ij->i", points[rows] - hit.point[rows], outward)
        if not len(self._crossed):
            return side
        if flat is None:
            far = np.abs(hit.distance) > self.offsets[hit.face]
            return self._inside_outside.resolve(side, points, hit.face, hit.uv, far)
        far = np.ones(len(points), dtype=bool)
        far[rows] = False  # decided by the patch
        at, uv = np.where(far, flat.face, hit.face), np.where(far[:, None], flat.uv, hit.uv)
        return self._inside_outside.resolve(side, points, at, uv, far)

    @cached_property
    def _inside_outside(self) -> InsideOutside:
        normals = self._flat_normals
        return InsideOutside(self.vertices, self.faces, normals, self._crossed, self.neighbours)

    @cached_property
    def _flat_normals(self) -> Array:
        return face_normals(self.vertices, self.faces)

    @cached_property
    def _corner_normals(self) -> Array:
        """Sums (n, 3) of the faces' normals at each vertex, weighted by their angles there."""
        corners = self.vertices[self.faces]
        total = np.zeros_like(self.vertices)
        for k in range(3):
            one = corners[:, NEXT[k]] - corners[:, k]
            two = corners[:, PREVIOUS[k]] - corners[:, k]
            sine = np.linalg.norm(np.cross(one, two), axis=1)
            angle = np.arctan2(sine, np.einsum("ij,ij->i", one, two))
            np.add.at(total, self.faces[:, k], angle[:, None] * self._flat_normals)
        return total


def _finite(points: ArrayLike) -> Array:
    p = np.ascontiguousarray(check_vectors("query points", points, error=MeshError))
    bad = ~np.isfinite(p).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise MeshError("a query point is not finite", value=p[row].tolist(), remedy=f"row {row}")
    return p


def _along(corner: Index, part: float) -> Array:
    """Barycentric coordinates (k, 2) at a relative position on the sides opposite corners (k,)."""
    weight, row = np.zeros((len(corner), 3)), np.arange(len(corner))
    weight[row, (corner + 1) % 3], weight[row, (corner + 2) % 3] = 1.0 - part, part
    return weight[:, 1:]


class Facets:
    """Flat faces of a triangle mesh (an object with `.vertices` (n, 3) m, `.faces` (m, 3))."""

    def __init__(self, mesh: Any) -> None:
        flat = np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.intp)
        self._corners, self._normals = flat[0][flat[1]], face_normals(*flat)
        built = compiled_search.library()
        self._search = ReferenceFlat(*flat) if built is None else CompiledFlat(*flat, built)

    def closest(self, points: Array) -> tuple[Array, Array]:
        """The closest points (n, 3), m, to points (n, 3), m, and the normals (n, 3) there, zero on
        faces without area."""
        found = self._search.closest(points)
        a, b, c = (self._corners[found.face, k] for k in range(3))
        nearest = a + found.uv[:, :1] * (b - a) + found.uv[:, 1:] * (c - a)
        return nearest, self._normals[found.face]


def thin_walled(vertices: Array, faces: Index) -> bool:
    """Whether faces whose normals are opposed are within about three face sizes of each other."""
    from scipy.spatial import KDTree

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal, middle = np.cross(b - a, c - a), (a + b + c) / 3.0
    sample = slice(None, None, max(1, len(faces) // 20_000))
    middle -= middle[0]
    tree = KDTree(middle, compact_nodes=False, balanced_tree=False)  # fast to build
    near = tree.query(middle[sample], k=min(24, len(faces)))[1]
    facing = np.einsum("nc,nkc->nk", normal[sample], normal[near.reshape(len(near), -1)])
    return bool(np.any(facing < 0.0))
