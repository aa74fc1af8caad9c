"""Connectivity of triangle meshes: edges, neighbouring faces, connected components.

Corner 3 f + k is corner k of face f; the half-edge of a corner runs from it to the next corner of
its face. An edge has as many half-edges as it has faces.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Index

NEXT, PREVIOUS = np.array([1, 2, 0]), np.array([2, 0, 1])
"""corners of a face after and before each corner"""


def edge_keys(tail: Index, head: Index, count: int) -> Index:
    """A number (h,) of the edge of each half-edge between `count` vertices, either way."""
    return np.asarray(np.minimum(tail, head) * count + np.maximum(tail, head))


def edge_pairs(keys: Index) -> tuple[Index, Index]:
    """Rows (k,) and (k,), the lower first, of the half-edges of edges that have exactly two.

    keys (h,): of the half-edges, as of `edge_keys`. Pairs are sorted by key.
    """
    order = np.argsort(keys)
    equal = np.diff(keys[order], prepend=-1, append=-1) == 0
    first = np.flatnonzero(equal[1:-1] & ~equal[:-2] & ~equal[2:])
    one, two = order[first], order[first + 1]
    return np.minimum(one, two), np.maximum(one, two)


def neighbours(faces: Index) -> tuple[Index, Index]:
    """Faces (m, 3) across the edge opposite each corner, and the corner off that edge there.

    -1 at a border, at an edge of more than two faces, and where the two faces' windings differ.
    """
    tail = faces[:, NEXT].ravel()  # the edge opposite corner k runs from k + 1 to k + 2
    head = faces[:, PREVIOUS].ravel()
    one, two = edge_pairs(edge_keys(tail, head, int(faces.max(initial=-1)) + 1))
    opposed = tail[one] != tail[two]
    one, two = one[opposed], two[opposed]
    other = np.full(faces.size, -1)
    other[one], other[two] = two, one
    across = other.reshape(faces.shape)
    return np.where(across >= 0, across // 3, -1), across % 3


def corners_by_vertex(faces: Index, count: int) -> tuple[Index, Index]:
    """The corners (3 m,) sorted by vertex, and where those of each of `count` vertices begin.

    The second is (count + 1,).
    """
    order = np.argsort(faces.ravel(), kind="stable")
    return order, np.searchsorted(faces.ravel()[order], np.arange(count + 1))


def connected_components(one: Index, two: Index, count: int) -> Index:
    """The component (count,) of each of `count` nodes, from 0; links one-two (k,) undirected."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components as components

    links = coo_array((np.ones(len(one), dtype=np.int8), (one, two)), shape=(count, count))
    return np.asarray(components(links, directed=False)[1], dtype=np.intp)


def face_components(across: Index) -> Index:
    """The connected component (m,) of each face; `across` (m, 3): its neighbours, or -1."""
    face, k = np.nonzero(across >= 0)
    return connected_components(face, across[face, k], len(across))
