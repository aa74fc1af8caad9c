"""The smooth fans of a mesh: every vertex split into the parts that creases cut its faces into.

A fan is a vertex with those of its faces that are connected through edges that are not creases. The
mesh of the fans has one node a fan; no way over its edges crosses a crease.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.topology import connected_components, edge_keys

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CREASE_ANGLE = np.radians(40.0)
"""turn from which an edge is a crease: of the two faces' normals, or of what the bend between them
would come to over the longer of them, if it went on"""
MIN_CREASE_ANGLE = np.radians(0.1)
"""turn that rounded vertices explain"""


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
    """(j,) whether the fan lies on a crease or on a border"""
    angle: Array
    """(m,) largest angle in rad between a face and the next ones that are not over a crease"""
    creased: bool
    """whether the mesh has creases, known seams apart, or borders"""


def find_creases(
    vertices: Array, faces: Index, across: tuple[Index, Index]
) -> tuple[NDArray[np.bool_], Array]:
    """Whether the edge opposite each corner is a crease, and the turn there in rad (m, 3) each.

    `across`: faces over the edges, and there the corner off the edge. An edge is a crease where the
    faces turn sharply, and where a face that reaches far from it meets one that reaches far less:
    a mesher takes short steps where the surface bends, so the curvature jumps there.
    """
    beyond, slot = across
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt(np.einsum("mc,mc->m", normal, normal))
    normal /= np.maximum(area, 1e-300)[:, None]
    reach = np.empty(faces.shape)  # heights over the edges: twice the area over the side
    for k in range(3):
        side = corners[:, (k + 1) % 3] - corners[:, (k + 2) % 3]
        reach[:, k] = area / np.maximum(np.sqrt(np.einsum("mc,mc->m", side, side)), 1e-300)
    out, turns = np.empty(faces.shape, dtype=bool), np.zeros(faces.shape)
    for k in range(3):
        there = reach[beyond[:, k], slot[:, k]]
        longer, shorter = np.maximum(reach[:, k], there), np.minimum(reach[:, k], there)
        bend = np.einsum("mc,mc->m", normal, normal[beyond[:, k]])
        turn = np.arccos(np.clip(bend, -1.0, 1.0))
        turns[:, k] = np.where(beyond[:, k] >= 0, turn, 0.0)
        out[:, k] = (
            (turn * longer > CREASE_ANGLE * shorter)
            & (beyond[:, k] >= 0)
            & (turn > MIN_CREASE_ANGLE)
        )
    return out, turns


def split_fans(
    vertices: Array, faces: Index, across: tuple[Index, Index], seams: Index | None = None
) -> Fans:
    """The fans of a mesh; `across`: faces over the edges, and there the corner off the edge.

    `seams` (k, 2): pairs of vertices whose edge counts as a crease though the normals agree, such
    as where a cylinder runs into a sphere.
    """
    n, (beyond, slot) = len(vertices), across
    sharp, turns = find_creases(vertices, faces, across)
    creased = bool(sharp.any() or np.any(beyond < 0))
    if seams is not None and len(seams):
        tail, head = np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)
        first, second = np.asarray(seams, dtype=np.intp).T
        seamed = np.isin(edge_keys(tail, head, n), edge_keys(first, second, n))
        sharp |= seamed & (beyond >= 0)
    turn = np.where(sharp, 0.0, turns).max(axis=1)
    cut = sharp | (beyond < 0)
    at = np.zeros(n, dtype=bool)
    for k in range(3):
        at[faces[cut[:, k]][:, [(k + 1) % 3, (k + 2) % 3]]] = True
    if not at.any():
        return Fans(np.arange(n), faces, sharp, at, turn, creased)
    vertex, corner = _number(faces, cut, beyond, slot, at)
    return Fans(vertex, corner, sharp, at[vertex], turn, creased)


def _number(
    faces: Index, cut: NDArray[np.bool_], beyond: Index, slot: Index, at: NDArray[np.bool_]
) -> tuple[Index, Index]:
    """Vertices (j,) of the fans and the fans (m, 3) of the corners; `at`: vertices to split."""
    here = np.flatnonzero(at[faces].ravel())  # corners 3 f + k at such vertices
    place = np.full(faces.size, -1)
    place[here] = np.arange(len(here))
    links: list[tuple[Index, Index]] = []
    for k in range(3):
        rows = np.flatnonzero(~cut[:, k])
        there, s = beyond[rows, k], slot[rows, k]
        for mine, theirs in ((1, 2), (2, 1)):  # the edge runs the other way over there
            one = place[3 * rows + (k + mine) % 3]
            two = place[3 * there + (s + theirs) % 3]
            both = (one >= 0) & (two >= 0)
            links.append((one[both], two[both]))
    i = np.concatenate([a for a, _ in links])
    j = np.concatenate([b for _, b in links])
    label = connected_components(i, j, len(here))
    owner = np.empty(label.max(initial=-1) + 1, dtype=np.intp)
    owner[label] = faces.ravel()[here]
    whole = np.flatnonzero(~at)
    number = np.empty(len(at), dtype=np.intp)
    number[whole] = np.arange(len(whole))
    corner = number[faces].ravel()
    corner[here] = len(whole) + label
    return np.concatenate([whole, owner]), corner.reshape(faces.shape)
