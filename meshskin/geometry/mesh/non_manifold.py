"""Edges of more than two faces, where sheets of a mesh touch: parted, by giving each sheet vertices
of its own.

Around such an edge the faces are taken in the order of their angles. Where they look alternately
along it and against it, each can be paired with the next one over the solid, or with the next one
over the open: no pair crosses another. The pairing that leaves no such edge is taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .repair import MeshEdit
from .topology import connected_components, edge_keys, edge_pairs

Array = NDArray[np.float64]
Index = NDArray[np.intp]

APART = 1e-3
"""angle, rad, between faces about an edge, from which their order is sure"""


def part(draft: MeshEdit) -> Index:
    """Part the edges of more than two faces, all of them or, where that fails, none.

    Gives the numbers of the faces at the parted edges.
    """
    edges = [*_several(draft.faces)]
    none = np.zeros(0, dtype=np.intp)
    pairs = [_pairs(draft, *edge) for edge in edges]
    if not edges or not all(pairs):
        return none
    over = np.zeros(len(edges), dtype=np.intp)  # the solid
    for _ in range(2):
        faces, origin = _split(draft, edges, [p[k] for p, k in zip(pairs, over, strict=True)])
        left = {(origin[a], origin[b]) for a, b, _ in _several(faces)}
        still = np.array([(a, b) in left or (b, a) in left for a, b, _ in edges])
        if not still.any():
            where = draft.vertices[np.array([(a, b) for a, b, _ in edges])].mean(axis=1)
            words = f"{len(edges)} edges of more than two faces parted: sheets touch there"
            draft.note(words, where)
            draft.vertices, draft.faces = draft.vertices[origin], faces
            return draft.number[np.unique(np.concatenate([rows for *_, rows in edges]) // 3)]
        over[still] = 1 - over[still]
    return none


def _several(faces: Index) -> Iterator[tuple[int, int, Index]]:
    """Edges of more than two faces: their vertices, and the corners 3 f + k that they start at."""
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    other = np.diff(low[order], prepend=-1) | np.diff(high[order], prepend=-1)
    start = np.flatnonzero(other)
    size = np.diff(start, append=len(order))
    for first, count in zip(start[size > 2], size[size > 2], strict=True):
        rows = order[first : first + count]
        yield int(low[rows[0]]), int(high[rows[0]]), rows


def _pairs(draft: MeshEdit, a: int, b: int, rows: Index) -> list[Index]:
    """The corners (k, 2) paired over the solid, and over the open; none where that is not sure."""
    faces = draft.faces
    along = draft.vertices[b] - draft.vertices[a]
    along = along / np.linalg.norm(along)
    off = draft.vertices[faces[rows // 3, (rows % 3 + 2) % 3]] - draft.vertices[a]
    off -= np.outer(off @ along, along)
    angle = np.arctan2(off @ np.cross(along, off[0]), off @ off[0])
    order = np.argsort(angle)
    angle, rows = angle[order], rows[order]
    gap = np.diff(angle, append=angle[0] + 2.0 * np.pi)
    forward = faces[rows // 3, rows % 3] == a  # the solid is behind it, as angles go
    if gap.min() < APART or np.any(forward == np.roll(forward, 1)):
        return []
    rows = np.roll(rows, -int(np.argmin(forward)))  # the first has the solid ahead
    return [rows.reshape(-1, 2), np.roll(rows, -1).reshape(-1, 2)]


def _split(
    draft: MeshEdit, edges: list[tuple[int, int, Index]], pairs: list[Index]
) -> tuple[Index, Index]:
    """Faces with a vertex for every fan at the edges' ends, and which vertex each one was."""
    faces = draft.faces
    ends = np.unique([e[:2] for e in edges])
    rows = np.flatnonzero(np.isin(faces, ends).any(axis=1))
    near = faces[rows]
    tail, head = near.ravel(), near[:, [1, 2, 0]].ravel()
    first, second = edge_pairs(edge_keys(tail, head, len(draft.vertices)))
    place = np.full(len(faces), -1)
    place[rows] = np.arange(len(rows))
    paired = np.concatenate(pairs)
    paired = 3 * place[paired // 3] + paired % 3
    one = np.concatenate([first, paired[:, 0]])
    two = np.concatenate([second, paired[:, 1]])
    i, j = np.concatenate([one, _next(one)]), np.concatenate([_next(two), two])
    same = near.ravel()[i] == near.ravel()[j]  # not where both run the same way
    i, j = i[same], j[same]
    fan = connected_components(i, j, near.size)
    at = np.isin(near.ravel(), ends)
    fans, lead = np.unique(fan[at], return_index=True)
    owner = near.ravel()[at][lead]
    again = np.ones(len(fans), dtype=bool)
    again[np.unique(owner, return_index=True)[1]] = False  # the first fan keeps the vertex
    number = np.where(again, len(draft.vertices) + np.cumsum(again) - 1, owner)
    new = near.ravel().copy()
    new[at] = number[np.searchsorted(fans, fan[at])]
    out = faces.copy()
    out[rows] = new.reshape(near.shape)
    return out, np.concatenate([np.arange(len(draft.vertices)), owner[again]])


def _next(corner: Index) -> Index:
    """The corner after each corner 3 f + k of a face."""
    return 3 * (corner // 3) + (corner + 1) % 3
