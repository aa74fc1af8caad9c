"""Elimination orders of little fill for sparse symmetric matrices.

Nested dissection by METIS 5 (Karypis and Kumar, SIAM Journal on Scientific Computing 20, 1998)
through the package pymetis, which has wheels for Linux on x86-64 and for macOS; elsewhere the
multiple minimum degree of SuperLU, which SciPy contains. Weighed and not taken: sksparse-minimal
(CHOLMOD without METIS), scikit-sparse, nxmetis and mgmetis (no wheels), and the METIS 4 that
CasADi's wheel for Linux contains (no Python interface).

Floating-point operations of a factorization relative to METIS 4: METIS 5 0.85 and minimum degree
0.71 on sphere2500, 0.99 and 1.23 on torus3D, 0.97 and 1.6 on a skin of 2,000 taxels, 0.92 and 2.0
on one of 10,000.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

try:
    import pymetis
except ImportError:  # no wheel for this platform
    pymetis = None  # type: ignore[assignment]

IntArray = NDArray[np.integer]
"""Integers of any width."""
Int64Array = NDArray[np.int64]
"""Integers of the width that the C code reads."""
METIS_SEED = 3
"""Seed of METIS, which is randomized: other seeds change the operations by 10 %; of a few, this one
is best on the graphs above."""


def elimination_order(pattern: sparse.csr_array) -> IntArray:
    """Nodes of a symmetric `pattern` (n, n) without diagonal, in an order of little fill."""
    if pymetis is None or not pattern.nnz:
        return minimum_degree(pattern)
    graph = pymetis.CSRAdjacency(pattern.indptr, pattern.indices)
    order = pymetis.nested_dissection(graph, options=pymetis.Options(seed=METIS_SEED))[0]
    return np.asarray(order, dtype=np.int64)


def minimum_degree(pattern: sparse.csr_array) -> IntArray:
    """Multiple minimum degree (Liu, 1985) of a symmetric `pattern` (n, n) without diagonal."""
    n = pattern.shape[0]
    dominant = sparse.csc_matrix(2.0 * n * sparse.eye_array(n) - (pattern != 0))
    options = {"SymmetricMode": True}
    factor = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)
