"""The edges of a mesh, by the half-edges that run along them, from a tail to a head.

A face has three half-edges, an edge as many as it has faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]


def edge_of(tail: Index, head: Index, count: int) -> Index:
    """The edge of each half-edge between `count` vertices: a number, the same for both ways."""
    return np.asarray(np.minimum(tail, head) * count + np.maximum(tail, head))


def twins(edge: Index) -> tuple[Index, Index]:
    """The rows (k,) and (k,), the lower first, of half-edges that alone share their edge.

    edge (h,): of each half-edge, as `edge_of`. In the order of the edges.
    """
    order = np.argsort(edge)
    alike = np.diff(edge[order], prepend=-1, append=-1) == 0
    first = np.flatnonzero(alike[1:-1] & ~alike[:-2] & ~alike[2:])
    one, two = order[first], order[first + 1]
    return np.minimum(one, two), np.maximum(one, two)
