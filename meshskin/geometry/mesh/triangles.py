"""Arrays of triangles: normals, closest points, subdivision, spatial order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arguments import check_vectors, repr_short
from ...core.arrays import Array, Index
from ...core.errors import MeshError


@dataclass(frozen=True)
class Triangles:
    """The content of a mesh file, or of a mesh in memory, before any repair."""

    vertices: Array
    """(n, 3) m"""
    faces: Index
    """(m, 3)"""
    names: dict[str, Index] = field(default_factory=dict)
    """the faces (k,) of each named part: objects, groups and materials of an OBJ; nodes, meshes and
    materials of a GLB; geometries and materials of a Collada file; solids of an ASCII STL that has
    several"""

    @classmethod
    def part(cls, vertices: Array, faces: Index, names: Iterable[str]) -> Triangles:
        """A part of a file, of which all faces have the `names`."""
        rows = np.arange(len(faces))
        named = dict.fromkeys(names, rows)
        return cls(np.array(vertices, dtype=float), np.array(faces, dtype=np.intp), named)

    @classmethod
    def of_mesh(cls, mesh: Any, scale: float) -> Triangles:
        """The triangles of an object with `vertices` (n, 3), in `scale` m, and `faces` (m, 3).

        Raises MeshError.
        """
        if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
            raise MeshError("a mesh needs vertices and faces", value=repr_short(mesh))
        vertices = check_vectors("vertices of a mesh", mesh.vertices, error=MeshError)
        faces = check_vectors("faces of a mesh", mesh.faces, error=MeshError)
        if not len(faces):
            raise MeshError("the mesh has no faces")
        wrong = faces[~np.isin(faces, np.arange(len(vertices)))]
        if len(wrong):
            limit = f"integers from 0 to {len(vertices) - 1}"
            raise MeshError("index of a vertex in a face", value=f"{wrong[0]:g}", limit=limit)
        return cls(scale * vertices, faces.astype(np.intp))

    @classmethod
    def joined(cls, parts: Sequence[Triangles]) -> Triangles:
        """The triangles of all parts; the faces of one name are joined, too."""
        vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.intp)]
        names: dict[str, list[Index]] = {}
        corner = first = 0
        for part in parts:
            vertices.append(part.vertices)
            faces.append(part.faces + corner)
            for name, rows in part.names.items():
                names.setdefault(name, []).append(rows + first)
            corner, first = corner + len(part.vertices), first + len(part.faces)
        named = {name: np.concatenate(rows) for name, rows in names.items()}
        return cls(np.concatenate(vertices), np.concatenate(faces), named)


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
    e, f, g = (np.sum(x * y, axis=-1) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    x, y = np.sum(ap * ab, axis=-1), np.sum(ap * ac, axis=-1)
    area2 = np.maximum(e * g - f * f, 1e-300)
    uv = np.stack([(g * x - f * y) / area2, (e * y - f * x) / area2], axis=-1)
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
