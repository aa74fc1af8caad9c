"""Symbolic multifrontal factorization: fronts of a sparse symmetric matrix, from its pattern.

A front is a dense matrix over some nodes: its pivots, which are eliminated together, and the later
nodes that they are coupled to. Fronts form a tree, the assembly tree; the Schur complement of a
front (its update matrix) is added to its parent.

Source: Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34 (1992).

Elimination orders of little fill: nested dissection by METIS 5 (Karypis and Kumar, SIAM Journal on
Scientific Computing 20, 1998) through the package pymetis, which has wheels for Linux on x86-64 and
for macOS; elsewhere the multiple minimum degree of SuperLU, which SciPy contains. Weighed and not
taken: sksparse-minimal (CHOLMOD without METIS), scikit-sparse, nxmetis and mgmetis (no wheels), and
the METIS 4 that CasADi's wheel for Linux contains (no Python interface). Floating-point operations
of a factorization relative to METIS 4: METIS 5 0.85 and minimum degree 0.71 on sphere2500, 0.99 and
1.23 on torus3D, 0.97 and 1.6 on a skin of 2,000 taxels, 0.92 and 2.0 on one of 10,000.
"""

from __future__ import annotations

from dataclasses import dataclass

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

MAX_ZERO_SHARE = 0.3
"""Largest share of explicit zeros in the pivot columns of a front: successive columns are merged
(amalgamated) up to it, because few large dense matrices are faster than many small ones. Chosen:
from 0 to 0.4 a factorization of sphere2500 or torus3D takes within 15 % of the shortest time."""


@dataclass(frozen=True, eq=False)
class SymbolicFactorization:
    """Fronts in postorder of the assembly tree; a position is a place in the elimination order."""

    order: Int64Array
    """(nodes,) node at each position."""
    position: Int64Array
    """(nodes,) position of each node."""
    front: Int64Array
    """(nodes,) front that eliminates the node at each position."""
    start: Int64Array
    """(fronts + 1,) the positions of front f are rows[start[f] : start[f + 1]]."""
    rows: Int64Array
    """Sorted positions of each front; the first are its pivots, which are consecutive."""
    parent_row: Int64Array
    """For each of `rows` except pivots: its row in the parent front."""
    pivots: Int64Array
    """(fronts,) number of pivots."""
    parent: Int64Array
    """(fronts,) front that the update matrix is added to; -1 for a root."""
    depth: Int64Array
    """(fronts,) number of ancestors."""
    subtree: Int64Array
    """(fronts,) number of fronts in the subtree, which ends at the front itself."""
    panel: Int64Array
    """(fronts + 1,) number of blocks in the pivot columns of all fronts before."""
    stacks: tuple[int, int]
    """Largest number of blocks of waiting update matrices, of fronts at even and at odd depth."""

    @property
    def largest(self) -> tuple[int, int]:
        """Blocks in the pivot columns of the largest front, and rows of the highest front."""
        heights = np.diff(self.start)
        return int((self.pivots * heights).max(initial=0)), int(heights.max(initial=0))


def symbolic_factorization(nodes: int, rows: IntArray, columns: IntArray) -> SymbolicFactorization:
    """Fronts of the symmetric matrix with blocks at `rows` and `columns`, in either triangle."""
    off = rows != columns
    i, j = np.concatenate([rows[off], columns[off]]), np.concatenate([columns[off], rows[off]])
    pattern = sparse.csr_array((np.ones(len(i)), (i, j)), shape=(nodes, nodes))
    order = np.asarray(elimination_order(pattern), dtype=np.int64)
    below = _column_structure(pattern, order)
    postorder = _postorder(np.array([b[0] if len(b) else -1 for b in below], dtype=np.int64))
    old = np.argsort(postorder)
    order = order[old]
    below = [postorder[below[k]] for k in old.tolist()]  # on one path to the root: still sorted
    first_pivots = _amalgamate(below)
    last_pivots = np.append(first_pivots[1:], nodes) - 1
    pivots = last_pivots - first_pivots + 1
    front = np.repeat(np.arange(len(first_pivots)), pivots)
    updated = [below[last] for last in last_pivots.tolist()]
    parts = [
        np.concatenate([np.arange(first, last + 1), rest])
        for first, last, rest in zip(first_pivots, last_pivots, updated, strict=True)
    ]
    parent = np.array([front[u[0]] if len(u) else -1 for u in updated], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum([len(p) for p in parts], dtype=np.int64)])
    parent_row = np.zeros(start[-1], dtype=np.int64)
    depth, subtree = np.zeros_like(parent), np.ones_like(parent)
    for f, above in enumerate(parent.tolist()):
        if above >= 0:
            rest = slice(start[f] + pivots[f], start[f + 1])
            parent_row[rest] = np.searchsorted(parts[above], updated[f])
            subtree[above] += subtree[f]
    for f in range(len(parent) - 1, -1, -1):
        if parent[f] >= 0:
            depth[f] = depth[parent[f]] + 1
    heights = np.diff(start)
    return SymbolicFactorization(
        order=order,
        position=np.argsort(order),
        front=front,
        start=start,
        rows=np.concatenate(parts),
        parent_row=parent_row,
        pivots=pivots,
        parent=parent,
        depth=depth,
        subtree=subtree,
        panel=np.concatenate([[0], np.cumsum(pivots * heights)]),
        stacks=_stack_sizes((heights - pivots) ** 2, parent, depth),
    )


def _column_structure(pattern: sparse.csr_array, order: Int64Array) -> list[Int64Array]:
    """Sorted positions of the nonzeros below the diagonal in each column of the factor."""
    permuted = pattern[order][:, order].tocsr()
    permuted.sort_indices()
    neighbours, ends = permuted.indices.astype(np.int64), permuted.indptr.tolist()
    below: list[Int64Array] = []
    children: list[list[int]] = [[] for _ in order]
    for k in range(len(order)):
        row = neighbours[ends[k] : ends[k + 1]]
        rest = row[np.searchsorted(row, k) :]
        if children[k]:
            merged = np.concatenate([rest, *(below[child][1:] for child in children[k])])
            merged.sort()
            last = np.ones(len(merged), dtype=bool)
            np.not_equal(merged[:-1], merged[1:], out=last[:-1])
            rest = merged[last]
        below.append(rest)
        if len(rest):
            children[rest[0]].append(k)
    return below


def _postorder(parent: Int64Array) -> Int64Array:
    """Position in postorder of each node of a forest; parents have higher numbers."""
    size = np.ones_like(parent)
    for k, above in enumerate(parent.tolist()):
        if above >= 0:
            size[above] += size[k]
    free, position, top = np.empty_like(parent), np.empty_like(parent), len(parent)
    for k in range(len(parent) - 1, -1, -1):
        above, end = parent[k], top
        if above < 0:
            top -= size[k]
        else:
            end = free[above]
            free[above] -= size[k]
        free[k] = position[k] = end - 1
    return position


def _amalgamate(below: list[Int64Array]) -> Int64Array:
    """First pivot of each front: chains of the elimination tree up to `MAX_ZERO_SHARE`."""
    first, firsts, nonzeros = 0, [0], 0
    for k in range(1, len(below)):
        nonzeros += len(below[k - 1]) + 1
        width, height = k - first + 1, k - first + 1 + len(below[k])
        entries = width * height - width * (width - 1) // 2
        is_parent = len(below[k - 1]) and below[k - 1][0] == k
        zeros = entries - nonzeros - len(below[k]) - 1
        if not (is_parent and zeros <= MAX_ZERO_SHARE * entries):
            first, nonzeros = k, 0
            firsts.append(k)
    return np.array(firsts[: len(below)], dtype=np.int64)


def _stack_sizes(updates: Int64Array, parent: Int64Array, depth: Int64Array) -> tuple[int, int]:
    """Largest fill of the stacks of even and odd depth; `updates`: blocks that a front leaves."""
    waiting, most, children = [0, 0], [0, 0], np.zeros(len(updates), dtype=np.int64)
    for f, (above, odd) in enumerate(zip(parent.tolist(), (depth % 2).tolist(), strict=True)):
        waiting[1 - odd] -= int(children[f])
        waiting[odd] += int(updates[f])
        most[odd] = max(most[odd], waiting[odd])
        if above >= 0:
            children[above] += updates[f]
    return most[0], most[1]


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
