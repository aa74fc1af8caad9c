"""Creases of a mesh, and the fans of faces between them at each vertex.

A fan is a vertex with those of its faces that are connected through edges that are not creases. In
the mesh of the fans, with one node a fan, no path over edges crosses a crease.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index, sums_by_group
from ...core.se3 import orthonormal_basis
from ..mesh.topology import connected_components, edge_keys

CREASE_ANGLE = np.radians(40.0)
"""angle between the normals of two faces from which their edge is a crease: a regular polygon of up
to 8 edges has corners, one of 10 edges is a circle. Where one face is higher over the edge than the
other, the angle counts by the ratio of the heights"""
MIN_CREASE_ANGLE = np.radians(0.1)
"""angle up to which no edge is a crease, whatever the heights: rounded vertices explain it"""


@dataclass(frozen=True)
class Fans:
    """The fans of a mesh of m faces."""

    vertex: Index
    """(j,) the vertex of each fan"""
    corner: Index
    """(m, 3) the fan at each corner of each face"""
    sharp: NDArray[np.bool_]
    """(m, 3) whether the edge opposite each corner is a crease"""
    on_crease: NDArray[np.bool_]
    """(j,) whether the vertex lies on a crease or on a border"""
    angle: Array
    """(m,) largest angle in rad between a face and its neighbours, those across creases excepted"""
    creased: bool
    """whether the mesh has borders, or creases other than known seams"""


def find_creases(
    vertices: Array, faces: Index, across: tuple[Index, Index]
) -> tuple[NDArray[np.bool_], Array]:
    """Whether the edge opposite each corner is a crease, and its dihedral angle in rad (m, 3) each.

    `across`: as of topology.neighbours. An edge is a crease where the angle is large, and where a
    face much higher over it than the other meets that at some angle: meshers take short steps where
    the surface bends, so the curvature jumps there.
    """
    beyond, slot = across
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt(np.einsum("mc,mc->m", normal, normal))
    normal /= np.maximum(area, 1e-300)[:, None]
    height = np.empty(faces.shape)  # over the edges: twice the area over the side
    for k in range(3):
        side = corners[:, (k + 1) % 3] - corners[:, (k + 2) % 3]
        height[:, k] = area / np.maximum(np.sqrt(np.einsum("mc,mc->m", side, side)), 1e-300)
    out, angles = np.empty(faces.shape, dtype=bool), np.zeros(faces.shape)
    for k in range(3):
        there = height[beyond[:, k], slot[:, k]]
        longer, shorter = np.maximum(height[:, k], there), np.minimum(height[:, k], there)
        bend = np.einsum("mc,mc->m", normal, normal[beyond[:, k]])
        angle = np.arccos(np.clip(bend, -1.0, 1.0))
        angles[:, k] = np.where(beyond[:, k] >= 0, angle, 0.0)
        out[:, k] = (
            (angle * longer > CREASE_ANGLE * shorter)
            & (beyond[:, k] >= 0)
            & (angle > MIN_CREASE_ANGLE)
        )
    return out, angles


def split_fans(
    vertices: Array, faces: Index, across: tuple[Index, Index], seams: Index | None
) -> Fans:
    """The fans of a mesh; `across`: as of topology.neighbours.

    `seams` (k, 2): pairs of vertices whose edge counts as a crease though the normals agree, such
    as where a cylinder joins a sphere.
    """
    n, (beyond, slot) = len(vertices), across
    sharp, angles = find_creases(vertices, faces, across)
    creased = bool(sharp.any() or np.any(beyond < 0))
    if seams is not None and len(seams):
        tail, head = np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)
        first, second = np.asarray(seams, dtype=np.intp).T
        seamed = np.isin(edge_keys(tail, head, n), edge_keys(first, second, n))
        sharp |= seamed & (beyond >= 0)
    angle = np.where(sharp, 0.0, angles).max(axis=1)
    cut = sharp | (beyond < 0)
    at = np.zeros(n, dtype=bool)
    for k in range(3):
        at[faces[cut[:, k]][:, [(k + 1) % 3, (k + 2) % 3]]] = True
    if not at.any():
        return Fans(np.arange(n), faces, sharp, at, angle, creased)
    vertex, corner = _number(faces, cut, beyond, slot, at)
    return Fans(vertex, corner, sharp, at[vertex], angle, creased)


def _number(
    faces: Index, cut: NDArray[np.bool_], beyond: Index, slot: Index, at: NDArray[np.bool_]
) -> tuple[Index, Index]:
    """Vertices (j,) of the fans, fans (m, 3) of the corners; `at` (n,): vertices to split."""
    here = np.flatnonzero(at[faces].ravel())  # corners at such vertices
    place = np.full(faces.size, -1)
    place[here] = np.arange(len(here))
    links: list[tuple[Index, Index]] = []
    for k in range(3):
        rows = np.flatnonzero(~cut[:, k])
        there, s = beyond[rows, k], slot[rows, k]
        for mine, theirs in ((1, 2), (2, 1)):  # the half-edge there has the opposite direction
            one = place[3 * rows + (k + mine) % 3]
            two = place[3 * there + (s + theirs) % 3]
            both = (one >= 0) & (two >= 0)
            links.append((one[both], two[both]))
    i = np.concatenate([a for a, _ in links])
    j = np.concatenate([b for _, b in links])
    label = connected_components(i, j, len(here))
    owner = np.empty(label.max(initial=-1) + 1, dtype=np.intp)
    owner[label] = faces.ravel()[here]
    intact = np.flatnonzero(~at)
    number = np.empty(len(at), dtype=np.intp)
    number[intact] = np.arange(len(intact))
    corner = number[faces].ravel()
    corner[here] = len(intact) + label
    return np.concatenate([intact, owner]), corner.reshape(faces.shape)


def vertex_normals(vertices: Array, faces: Index) -> Array:
    """Outward unit normals (n, 3) at the vertices, each face weighted by its area."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    total = sums_by_group(np.repeat(cross, 3, axis=0), faces.ravel(), len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


def fan_frames(points: Array, fans: Fans) -> Array:
    """Frames (j, 3, 3) of the fans, rows t1, t2, normal; t1 is along creases where some are."""
    normals = vertex_normals(points, fans.corner)
    frame = np.ascontiguousarray(np.swapaxes(orthonormal_basis(normals), 1, 2))
    face, k = np.nonzero(fans.sharp)
    tail, head = fans.corner[face, (k + 1) % 3], fans.corner[face, (k + 2) % 3]
    along_edge = points[head] - points[tail]
    along_edge /= np.maximum(np.linalg.norm(along_edge, axis=1), 1e-300)[:, None]
    along = np.zeros_like(points)
    np.add.at(along, np.concatenate([tail, head]), np.concatenate([along_edge, along_edge]))
    normal = frame[:, 2]
    along -= np.einsum("ji,ji->j", along, normal)[:, None] * normal
    length = np.linalg.norm(along, axis=1)
    rows = np.flatnonzero(length > 0.1)
    frame[rows, 0] = along[rows] / length[rows, None]
    frame[rows, 1] = np.cross(normal[rows], frame[rows, 0])
    return frame
