"""Edges of more than two faces, where parts of a mesh touch: the parts get vertices of their own.

The faces around such an edge are sorted by angle. Where their half-edges alternate in direction,
each face pairs with the next one across the solid, or with the next one across the empty space, and
no pair crosses another. The pairing that leaves no such edge is taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...core.arrays import Index
from .repair import MeshEdit
from .topology import connected_components, edge_keys, edge_pairs

MIN_ANGLE = 1e-3
"""least angle, rad, between faces around an edge whose order is trusted: 1 um at 1 mm from the
edge, the rounding of a file in single precision for a body of 10 m"""


def split_edges(edit: MeshEdit) -> Index:
    """Split all edges of more than two faces or, where one cannot be, none.

    Returns the numbers of the faces at the split edges.
    """
    edges = [*_non_manifold(edit.faces)]
    none = np.zeros(0, dtype=np.intp)
    pairs = [_pairs(edit, *edge) for edge in edges]
    if not edges or not all(pairs):
        return none
    over = np.zeros(len(edges), dtype=np.intp)  # across the solid
    for _ in range(2):
        faces, origin = _split(edit, edges, [p[k] for p, k in zip(pairs, over, strict=True)])
        remaining = {(origin[a], origin[b]) for a, b, _ in _non_manifold(faces)}
        still = np.array([(a, b) in remaining or (b, a) in remaining for a, b, _ in edges])
        if not still.any():
            where = edit.vertices[np.array([(a, b) for a, b, _ in edges])].mean(axis=1)
            words = f"{len(edges)} edges of more than two faces split: parts touch there"
            edit.note(words, where)
            edit.vertices, edit.faces = edit.vertices[origin], faces
            return edit.number[np.unique(np.concatenate([rows for *_, rows in edges]) // 3)]
        over[still] = 1 - over[still]
    return none


def _non_manifold(faces: Index) -> Iterator[tuple[int, int, Index]]:
    """Edges of more than two faces: their vertices, and the corners of their half-edges."""
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    other = np.diff(low[order], prepend=-1) | np.diff(high[order], prepend=-1)
    start = np.flatnonzero(other)
    size = np.diff(start, append=len(order))
    for first, count in zip(start[size > 2], size[size > 2], strict=True):
        rows = order[first : first + count]
        yield int(low[rows[0]]), int(high[rows[0]]), rows


def _pairs(edit: MeshEdit, a: int, b: int, rows: Index) -> list[Index]:
    """Corners (k, 2) paired across the solid, and across empty space; none where not determined."""
    faces = edit.faces
    along = edit.vertices[b] - edit.vertices[a]
    along = along / np.linalg.norm(along)
    off = edit.vertices[faces[rows // 3, (rows % 3 + 2) % 3]] - edit.vertices[a]
    off -= np.outer(off @ along, along)
    angle = np.arctan2(off @ np.cross(along, off[0]), off @ off[0])
    order = np.argsort(angle)
    angle, rows = angle[order], rows[order]
    gap = np.diff(angle, append=angle[0] + 2.0 * np.pi)
    forward = faces[rows // 3, rows % 3] == a  # the solid is before it, by angle
    if gap.min() < MIN_ANGLE or np.any(forward == np.roll(forward, 1)):
        return []
    rows = np.roll(rows, -int(np.argmin(forward)))  # the first has the solid after it
    return [rows.reshape(-1, 2), np.roll(rows, -1).reshape(-1, 2)]


def _split(
    edit: MeshEdit, edges: list[tuple[int, int, Index]], pairs: list[Index]
) -> tuple[Index, Index]:
    """Faces with a vertex for each fan at the ends of the edges, and which one each was before."""
    faces = edit.faces
    ends = np.unique([e[:2] for e in edges])
    rows = np.flatnonzero(np.isin(faces, ends).any(axis=1))
    near = faces[rows]
    tail, head = near.ravel(), near[:, [1, 2, 0]].ravel()
    first, second = edge_pairs(edge_keys(tail, head, len(edit.vertices)))
    place = np.full(len(faces), -1)
    place[rows] = np.arange(len(rows))
    paired = np.concatenate(pairs)
    paired = 3 * place[paired // 3] + paired % 3
    one = np.concatenate([first, paired[:, 0]])
    two = np.concatenate([second, paired[:, 1]])
    i, j = np.concatenate([one, _next(one)]), np.concatenate([_next(two), two])
    same = near.ravel()[i] == near.ravel()[j]  # not where both have one direction
    i, j = i[same], j[same]
    fan = connected_components(i, j, near.size)
    at = np.isin(near.ravel(), ends)
    fans, lead = np.unique(fan[at], return_index=True)
    owner = near.ravel()[at][lead]
    again = np.ones(len(fans), dtype=bool)
    again[np.unique(owner, return_index=True)[1]] = False  # the first fan keeps the vertex
    number = np.where(again, len(edit.vertices) + np.cumsum(again) - 1, owner)
    new = near.ravel().copy()
    new[at] = number[np.searchsorted(fans, fan[at])]
    out = faces.copy()
    out[rows] = new.reshape(near.shape)
    return out, np.concatenate([np.arange(len(edit.vertices)), owner[again]])


def _next(corner: Index) -> Index:
    """The corner after each corner, in its face."""
    return 3 * (corner // 3) + (corner + 1) % 3
