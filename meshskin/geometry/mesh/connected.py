"""The connected parts of a graph: of faces over edges, of edges over vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]


def parts(one: Index, two: Index, count: int) -> Index:
    """The part (count,) of each of `count` nodes, numbered from 0; links (k,) run both ways."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(one), dtype=np.int8), (one, two)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.intp)
