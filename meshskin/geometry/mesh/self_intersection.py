"""Self-intersections of a mesh: edges that pass through faces, found by embree's rays.

Embree computes in single precision, on the mesh scaled to about one; what it finds is checked in
double precision. trimesh finds none by itself; CGAL and libigl's own need exact arithmetic in C++.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index
from .rays import ray_scene

EDGE_MARGIN = 1e-3
"""part of an edge at either end, and of a face along its border, where a contact does not count as
an intersection: neighbouring faces touch there"""
MIN_DEPTH = 1e-6
"""least distance of both ends of an edge from the plane of the face, relative to the extent: about
ten times the rounding of single precision, in which files and embree hold the vertices"""
MAX_HITS = 4
"""most faces that a ray along an edge passes before the edge is taken to be clear"""
CHUNK = 50_000
"""edges traced at once: bounds the memory"""


def edge_face_intersections(
    vertices: Array, faces: Index, closed: bool = False
) -> tuple[Index, Index, Array]:
    """Edges that pass through faces: a face of each edge (k,), the other face (k,), where (k, 3).

    `closed`: every edge is known to have two faces, wound alike, which saves a search.
    """
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    extent = float(np.max(np.ptp(vertices, axis=0)))
    scaled = (vertices - centre) / extent
    edges, owner = _edges_of_closed(faces) if closed else _edges(faces, len(vertices))
    scene = ray_scene(scaled, faces)
    found = [(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros((0, 3)))]
    for start in range(0, len(edges), CHUNK):
        some = slice(start, start + CHUNK)
        for row, face, where in _intersections(scene, scaled, faces, edges[some]):
            found.append((owner[start + row], face, where * extent + centre))
    one, two, where = (np.concatenate([f[k] for f in found]) for k in range(3))
    return one, two, where


def _intersections(
    scene: Any, vertices: Array, faces: Index, edges: Index
) -> Iterator[tuple[Index, Index, Array]]:
    """Which of `edges` (e, 2) pass through faces: rows (k,), faces (k,), and where (k, 3)."""
    a, b = vertices[edges[:, 0]], vertices[edges[:, 1]]
    direction = b - a
    length = np.sqrt(np.einsum("ij,ij->i", direction, direction))
    direction /= np.maximum(length, 1e-300)[:, None]
    at, end = EDGE_MARGIN * length, (1.0 - EDGE_MARGIN) * length
    rows = np.flatnonzero(length > 10.0 * MIN_DEPTH)
    for _ in range(MAX_HITS):
        if not len(rows):
            return
        start = (a[rows] + at[rows, None] * direction[rows]).astype(np.float32)
        remaining = (end[rows] - at[rows]).astype(np.float32)
        hits = scene.run(start, direction[rows].astype(np.float32), dists=remaining, output=1)
        hit = np.flatnonzero(hits["primID"] >= 0)
        rows, face = rows[hit], hits["primID"][hit].astype(np.intp)
        corners = faces[face]
        adjacent = np.any(corners[:, :, None] == edges[rows][:, None, :], axis=(1, 2))
        real = ~adjacent
        near = np.flatnonzero(real)
        crossed, where = _inside_both(vertices, corners[near], a[rows[near]], b[rows[near]])
        real[near] = crossed
        yield rows[real], face[real], where[crossed]
        at[rows] += hits["tfar"][hit] + EDGE_MARGIN * length[rows]
        rows = rows[~real & (at[rows] < end[rows])]


def _edges_of_closed(faces: Index) -> tuple[Index, Index]:
    """Each edge (e, 2) once, and a face of it (e,), of a closed mesh with consistent winding."""
    tail, head = faces, np.roll(faces, -1, axis=1)
    upwards = tail < head
    return np.stack([tail[upwards], head[upwards]], axis=1), np.nonzero(upwards)[0]


def _edges(faces: Index, count: int) -> tuple[Index, Index]:
    """Each edge (e, 2) once, and a face of it (e,)."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, first = np.unique(ends[:, 0] * count + ends[:, 1], return_index=True)
    return ends[first], first // 3


def _inside_both(
    vertices: Array, faces: Index, a: Array, b: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Whether segments a, b (k, 3) cross the interior of faces (k, 3), and where (k, 3)."""
    o, p, q = (vertices[faces[:, k]] for k in range(3))
    e, f = p - o, q - o
    normal = np.cross(e, f)
    area2 = np.einsum("ij,ij->i", normal, normal)
    unit = normal / np.sqrt(np.maximum(area2, 1e-300))[:, None]
    above, below = np.einsum("ij,ij->i", a - o, unit), np.einsum("ij,ij->i", b - o, unit)
    crossing = (above * below < 0.0) & (np.minimum(np.abs(above), np.abs(below)) > MIN_DEPTH)
    t = np.where(crossing, above / np.where(crossing, above - below, 1.0), 0.0)
    where = a + t[:, None] * (b - a)
    r = where - o
    safe = np.maximum(area2, 1e-300)
    u = np.einsum("ij,ij->i", np.cross(r, f), normal) / safe
    v = np.einsum("ij,ij->i", np.cross(e, r), normal) / safe
    inside = (u > EDGE_MARGIN) & (v > EDGE_MARGIN) & (u + v < 1.0 - EDGE_MARGIN)
    return crossing & inside & (area2 > 0.0), where
