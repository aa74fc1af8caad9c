"""Elimination orders of little fill for the blocks of a sparse symmetric matrix."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

import casadi as ca
import numpy as np
from scipy import sparse

from meshskin.estimation.posegraph.linear import Integers, factorise

METIS = "libcoinmetis.so.2"


def elimination_order(matrix: sparse.csr_array, block: int) -> Integers:
    """Block rows of `matrix`, blocks of `block` rows, in an order of little fill, postordered.

    Nested dissection by the METIS that CasADi brings, where it does; else minimum degree.
    """
    n, entries = matrix.shape[0] // block, matrix.tocoo()
    pairs = np.unique(entries.row // block * np.int64(n) + entries.col // block)
    rows, columns = pairs // n, pairs % n
    weights = np.where(rows == columns, 2.0 * n, -1.0)  # dominant: only the pattern counts
    pattern = sparse.csc_array((weights, (rows, columns)), shape=(n, n))
    dissected = _dissect(rows[rows != columns], columns[rows != columns], n)
    if dissected is None:
        return np.argsort(factorise(pattern).perm_c)
    postorder = factorise(pattern[dissected][:, dissected], order="NATURAL").perm_c
    return dissected[np.argsort(postorder)]


def _dissect(rows: Integers, columns: Integers, n: int) -> Integers | None:
    """Nested dissection of a graph given by its sorted pairs, both ways; None without METIS."""
    metis = _metis()
    if metis is None or not len(rows):
        return None
    start, neighbours = np.searchsorted(rows, np.arange(n + 1)), columns
    arrays = [np.ascontiguousarray(a, dtype=np.int32) for a in (start, neighbours)]
    order, places = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.int32)
    options, count, first = (ctypes.c_int * 8)(0), ctypes.c_int(n), ctypes.c_int(0)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (*arrays, order, places)]
    graph, found = pointers[:2], pointers[2:]
    metis.METIS_NodeND(ctypes.byref(count), *graph, ctypes.byref(first), options, *found)
    return order.astype(np.int64)


@functools.cache
def _metis() -> ctypes.CDLL | None:
    """METIS 4 of CasADi's wheel: later ones have other arguments and are left alone."""
    path = Path(ca.__file__).parent / METIS
    if not path.exists():
        return None
    library = ctypes.CDLL(str(path))
    version_4 = hasattr(library, "METIS_NodeND") and not hasattr(library, "METIS_SetDefaultOptions")
    return library if version_4 else None
