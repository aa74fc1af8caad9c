"""Where a mesh passes through itself: edges that pierce faces, found by embree rays.

Embree works in single precision on the mesh in a scale near one; what it finds is decided again in
double precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

END = 1e-3
"""part of an edge at either end that may touch without piercing"""
DEPTH = 1e-6
"""how far an edge must reach beyond a face at both ends, relative to the mesh's extent"""
ROUNDS = 4
"""faces looked through along an edge"""


def piercings(vertices: Array, faces: Index, closed: bool = False) -> tuple[Index, Index, Array]:
    """Edges that pierce faces: one face of each edge (k,), the pierced (k,), and where (k, 3).

    `closed`: every edge is known to be run both ways, once each, which saves finding its twin.
    """
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    extent = float(np.max(np.ptp(vertices, axis=0)))
    places = (vertices - centre) / extent
    edges, owner = _one_way(faces) if closed else _edges(faces, len(vertices))
    a, b = places[edges[:, 0]], places[edges[:, 1]]
    way = b - a
    length = np.linalg.norm(way, axis=1)
    way /= np.maximum(length, 1e-300)[:, None]
    scene = ray_scene(places, faces)
    at = END * length
    rows = np.flatnonzero(length > 10.0 * DEPTH)
    found: list[tuple[Index, Index, Array]] = []
    for _ in range(ROUNDS):
        if not len(rows):
            break
        start = (a[rows] + at[rows, None] * way[rows]).astype(np.float32)
        left = ((1.0 - END) * length[rows] - at[rows]).astype(np.float32)
        hits = scene.run(start, way[rows].astype(np.float32), dists=left, output=1)
        face = np.asarray(hits["primID"] if isinstance(hits, dict) else hits, dtype=np.intp)
        struck = face >= 0
        rows, face = rows[struck], face[struck]
        go = np.asarray(hits["tfar"], dtype=float)[struck]
        real, where = _pierced(places, faces[face], a[rows], b[rows])
        real &= ~np.any(faces[face][:, :, None] == edges[rows][:, None, :], axis=(1, 2))
        found.append((owner[rows[real]], face[real], where[real] * extent + centre))
        at[rows] += go + END * length[rows]
        onward = ~real & (at[rows] < (1.0 - END) * length[rows])
        rows = rows[onward]
    if not found:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros((0, 3))
    one, two, where = (np.concatenate([f[k] for f in found]) for k in range(3))
    return one, two, where


def ray_scene(vertices: Array, faces: Index) -> Any:
    """Embree's scene of a mesh, whose vertices should be near one in size."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32)[faces])
    return scene


def _one_way(faces: Index) -> tuple[Index, Index]:
    """As `_edges`, of faces wound alike without a border: the edges as they run upwards."""
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    first = np.flatnonzero(tail < head)
    return np.stack([tail[first], head[first]], axis=1), first // 3


def _edges(faces: Index, count: int) -> tuple[Index, Index]:
    """Each edge (e, 2) once, and a face of it (e,)."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, first = np.unique(ends[:, 0] * count + ends[:, 1], return_index=True)
    return ends[first], first // 3


def _pierced(vertices: Array, faces: Index, a: Array, b: Array) -> tuple[NDArray[np.bool_], Array]:
    """Whether the segments a, b (k, 3) cross the insides of faces (k, 3), and where (k, 3)."""
    o, p, q = (vertices[faces[:, k]] for k in range(3))
    e, f = p - o, q - o
    normal = np.cross(e, f)
    area2 = np.einsum("ij,ij->i", normal, normal)
    unit = normal / np.sqrt(np.maximum(area2, 1e-300))[:, None]
    above, below = np.einsum("ij,ij->i", a - o, unit), np.einsum("ij,ij->i", b - o, unit)
    crossing = (above * below < 0.0) & (np.minimum(np.abs(above), np.abs(below)) > DEPTH)
    t = np.where(crossing, above / np.where(crossing, above - below, 1.0), 0.0)
    where = a + t[:, None] * (b - a)
    r = where - o
    safe = np.maximum(area2, 1e-300)
    u = np.einsum("ij,ij->i", np.cross(r, f), normal) / safe
    v = np.einsum("ij,ij->i", np.cross(e, r), normal) / safe
    inside = (u > END) & (v > END) & (u + v < 1.0 - END)
    return crossing & inside & (area2 > 0.0), where
