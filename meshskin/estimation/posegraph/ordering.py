"""Elimination orders of little fill for a sparse symmetric matrix."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Integers = NDArray[np.integer]
"""Whole numbers of any width."""
Long = NDArray[np.int64]
"""Those that C reads as they are."""

METIS = "libcoinmetis.so.2"
"""METIS 4, as CasADi's wheel for Linux names it."""


def elimination_order(pattern: sparse.csr_array) -> Integers:
    """Nodes of a symmetric `pattern` (n, n) without diagonal, in an order of little fill.

    Nested dissection by the METIS that CasADi brings, where it does; else minimum degree.
    """
    dissected = _dissect(pattern)
    return _minimum_degree(pattern) if dissected is None else dissected


def _minimum_degree(pattern: sparse.csr_array) -> Integers:
    """As SuperLU finds it, on its way to a factorisation."""
    n = pattern.shape[0]
    dominant = sparse.csc_matrix(2.0 * n * sparse.eye_array(n) - (pattern != 0))
    options = {"SymmetricMode": True}
    factor = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)


def _dissect(pattern: sparse.csr_array) -> Integers | None:
    """Nested dissection; None without METIS."""
    metis, n = _metis(), pattern.shape[0]
    if metis is None or not pattern.nnz:
        return None
    arrays = [np.ascontiguousarray(a, dtype=np.int32) for a in (pattern.indptr, pattern.indices)]
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
