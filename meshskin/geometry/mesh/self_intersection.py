"""Where a mesh passes through itself: edges that pierce faces, found by embree rays.

Embree works in single precision on the mesh in a scale near one; what it finds is decided again in
double precision.
"""

from __future__ import annotations

from collections.abc import Iterator
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
CHUNK = 50_000
"""edges looked along at once: what is known of them stays in the cache"""


def piercings(vertices: Array, faces: Index, closed: bool = False) -> tuple[Index, Index, Array]:
    """Edges that pierce faces: one face of each edge (k,), the pierced (k,), and where (k, 3).

    `closed`: every edge is known to be run both ways, once each, which saves finding its twin.
    """
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    extent = float(np.max(np.ptp(vertices, axis=0)))
    places = (vertices - centre) / extent
    edges, owner = _one_way(faces) if closed else _edges(faces, len(vertices))
    scene = ray_scene(places, faces)
    found = [(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros((0, 3)))]
    for start in range(0, len(edges), CHUNK):
        some = slice(start, start + CHUNK)
        for row, face, where in _along(scene, places, faces, edges[some]):
            found.append((owner[start + row], face, where * extent + centre))
    one, two, where = (np.concatenate([f[k] for f in found]) for k in range(3))
    return one, two, where


def _along(
    scene: Any, vertices: Array, faces: Index, edges: Index
) -> Iterator[tuple[Index, Index, Array]]:
    """The edges (k,) of `edges` (e, 2) that pierce faces (k,), and where (k, 3)."""
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    way = b - a
    length = np.sqrt(np.einsum("ij,ij->i", way, way))
    way /= np.maximum(length, 1e-300)[:, None]
    at, end = END * length, (1.0 - END) * length
    rows = np.flatnonzero(length > 10.0 * DEPTH)
    for _ in range(ROUNDS):
        if not len(rows):
            return
        start = (a[rows] + at[rows, None] * way[rows]).astype(np.float32)
        left = (end[rows] - at[rows]).astype(np.float32)
        hits = scene.run(start, way[rows].astype(np.float32), dists=left, output=1)
        struck = np.flatnonzero(hits["primID"] >= 0)
        rows, face = rows[struck], hits["primID"][struck].astype(np.intp)
        corners = faces[face]
        beside = np.any(corners[:, :, None] == edges[rows][:, None, :], axis=(1, 2))
        real = ~beside
        apart = np.flatnonzero(real)
        crossed, where = _pierced(vertices, corners[apart], a[rows[apart]], b[rows[apart]])
        real[apart] = crossed
        yield rows[real], face[real], where[crossed]
        at[rows] += hits["tfar"][struck] + END * length[rows]
        rows = rows[~real & (at[rows] < end[rows])]


def ray_scene(vertices: Array, faces: Index) -> Any:
    """Embree's scene of a mesh, whose vertices should be near one in size."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    return scene


def _one_way(faces: Index) -> tuple[Index, Index]:
    """As `_edges`, of faces wound alike without a border: the edges as they run upwards."""
    tail, head = faces, np.roll(faces, -1, axis=1)
    upwards = tail < head
    return np.stack([tail[upwards], head[upwards]], axis=1), np.nonzero(upwards)[0]


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
