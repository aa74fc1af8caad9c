"""Marginal covariances: the diagonal blocks of an inverse, without the rest of it.

The information matrix is factored by fronts (multifrontal Cholesky); then the inverse is built from
the last front to the first, each needing only its parent's. That costs about as much as the
factorisation, where solving column by column costs n times a solve.

Source: Takahashi, Fagan, Chen, "Formation of a sparse bus impedance matrix" (1973); Liu, "The
multifrontal method for sparse matrix solution", SIAM Review 34 (1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from meshskin.estimation.posegraph import memory
from meshskin.estimation.posegraph.linear import Integers
from meshskin.estimation.posegraph.ordering import elimination_order
from meshskin.se3 import Array

BLOCK = 6
SINGULAR = 1e-13
"""A pivot below this share of its diagonal entry is zero up to rounding."""
PRIOR = 1e-10
"""Information added where the matrix is singular, as a share of the diagonal."""
UNSEEN = 1e-2
"""A variance above this share of the prior's comes from the prior: nothing was seen."""
WASTE = 0.3
"""Share of zeros that a front may hold for the sake of fewer, larger fronts."""


class SingularError(ArithmeticError):
    """The matrix is singular up to rounding."""


@dataclass(frozen=True)
class Front:
    """Consecutive poses of the elimination order, and the later poses that they touch."""

    poses: Integers
    """Sorted; the first `pivots` are eliminated here."""
    pivots: int
    parent: int
    """The front that takes up the rest; -1 for a root."""


def marginals(information: sparse.csr_array) -> Array:
    """Covariances (n, 6, 6) of the poses whose joint `information` is (6 n, 6 n), symmetric.

    Degrees of freedom that it does not determine get an infinite variance and no covariance.
    """
    try:
        return diagonal_of_inverse(information)
    except SingularError:
        diagonal = information.diagonal()
        typical = np.tile(diagonal.reshape(-1, BLOCK).max(axis=0), len(diagonal) // BLOCK)
        prior = PRIOR * np.where(typical > 0, typical, 1.0)
        blocks = diagonal_of_inverse((information + sparse.diags_array(prior)).tocsr())
    variance = np.diagonal(blocks, axis1=1, axis2=2)
    unseen = variance * prior.reshape(-1, BLOCK) > UNSEEN
    blocks[unseen[:, :, None] | unseen[:, None, :]] = 0.0
    pose, freedom = np.nonzero(unseen)
    blocks[pose, freedom, freedom] = np.inf
    return blocks


def diagonal_of_inverse(matrix: sparse.csr_array) -> Array:
    """Diagonal blocks (n, 6, 6) of the inverse of `matrix` (6 n, 6 n), positive definite.

    Raises SingularError where it is not.
    """
    n = matrix.shape[0] // BLOCK
    order = elimination_order(matrix, BLOCK)
    scalar = (BLOCK * order[:, None] + np.arange(BLOCK)).ravel()
    blocks = sparse.bsr_array(matrix[scalar][:, scalar], blocksize=(BLOCK, BLOCK))
    blocks.sort_indices()
    fronts = _fronts(blocks.indptr, blocks.indices)
    found = np.empty((n, BLOCK, BLOCK))
    with memory.kept():
        found[order] = _invert(fronts, _eliminate(fronts, blocks), n)
    return found


def _fronts(start: Integers, columns: Integers) -> list[Front]:
    """Elimination tree of a symmetric pattern (rows in order), its chains merged into fronts."""
    n = len(start) - 1
    below: list[Integers] = []  # poses after k that the elimination of k touches
    children: list[list[int]] = [[] for _ in range(n)]
    for k in range(n):
        row = columns[start[k] : start[k + 1]]
        touched = [row[np.searchsorted(row, k + 1) :]]
        touched += [below[child][1:] for child in children[k]]
        rest = np.unique(np.concatenate(touched)) if len(touched) > 1 else touched[0]
        below.append(rest)
        if len(rest):
            children[rest[0]].append(k)
    first, firsts, useful = 0, [0], 0
    for k in range(1, n):
        useful += len(below[k - 1]) + 1
        width, height = k - first + 1, k - first + 1 + len(below[k])
        whole = width * height - width * (width - 1) // 2
        chained = len(below[k - 1]) and below[k - 1][0] == k
        if not (chained and whole - useful - len(below[k]) - 1 <= WASTE * whole):
            first, useful = k, 0
            firsts.append(k)
    lasts = np.array([*firsts[1:], n]) - 1
    front_of = np.repeat(np.arange(len(firsts)), lasts - np.array(firsts) + 1)
    return [
        Front(
            poses=np.concatenate([np.arange(a, b + 1), below[b]]),
            pivots=b - a + 1,
            parent=int(front_of[below[b][0]]) if len(below[b]) else -1,
        )
        for a, b in zip(firsts, lasts.tolist(), strict=True)
    ]


def _eliminate(fronts: list[Front], blocks: sparse.bsr_array) -> list[tuple[Array, Array]]:
    """Of each front, bottom up: the inverse of its pivot block, and F21 times it."""
    updates: list[list[tuple[Integers, Array]]] = [[] for _ in fronts]
    done = []
    for k, front in enumerate(fronts):
        size, width = len(front.poses), BLOCK * front.pivots
        dense = np.zeros((BLOCK * size, BLOCK * size))
        _put_blocks(dense.reshape(size, BLOCK, size, BLOCK), front, blocks)
        for poses, update in updates[k]:
            at = _scalars(np.searchsorted(front.poses, poses))
            dense[at[:, None], at] += update
        updates[k] = []
        scale = np.diagonal(blocks.data[_diagonal(blocks, front)], axis1=1, axis2=2).ravel()
        factor, fault = lapack.dpotrf(dense[:width, :width], lower=1, clean=1)
        if fault or (np.diagonal(factor) ** 2 <= SINGULAR * scale).any():
            raise SingularError
        root = lapack.dtrtri(factor, lower=1)[0]  # L11^-1
        side = dense[width:, :width] @ root.T  # L21
        if front.parent >= 0:
            rest = dense[width:, width:] - side @ side.T
            updates[front.parent].append((front.poses[front.pivots :], rest))
        done.append((root.T @ root, side @ root))
    return done


def _invert(fronts: list[Front], done: list[tuple[Array, Array]], n: int) -> Array:
    """Diagonal blocks (n, 6, 6) of the inverse, top down."""
    found = np.empty((n, BLOCK, BLOCK))
    inverses: list[Array] = [np.empty((0, 0))] * len(fronts)
    waiting = np.bincount([f.parent for f in fronts if f.parent >= 0], minlength=len(fronts))
    for k in range(len(fronts) - 1, -1, -1):
        front, (pivot, side) = fronts[k], done[k]
        width = BLOCK * front.pivots
        whole = np.empty((BLOCK * len(front.poses),) * 2)
        if front.parent >= 0:
            parent = fronts[front.parent].poses
            at = _scalars(np.searchsorted(parent, front.poses[front.pivots :]))
            rest = inverses[front.parent][at[:, None], at]
            cross = -rest @ side
            whole[width:, width:], whole[width:, :width] = rest, cross
            whole[:width, width:], whole[:width, :width] = cross.T, pivot - side.T @ cross
            waiting[front.parent] -= 1
            if not waiting[front.parent]:
                inverses[front.parent] = np.empty((0, 0))
        else:
            whole[:] = pivot
        if waiting[k]:
            inverses[k] = whole
        own = whole[:width, :width].reshape(front.pivots, BLOCK, front.pivots, BLOCK)
        each = np.arange(front.pivots)
        found[front.poses[: front.pivots]] = own[each, :, each, :]
    return found


def _put_blocks(dense: Array, front: Front, blocks: sparse.bsr_array) -> None:
    """The matrix's own entries, in the pivots' columns, into a front (size, 6, size, 6)."""
    first = front.poses[0]
    span = slice(blocks.indptr[first], blocks.indptr[first + front.pivots])
    column = np.repeat(
        np.arange(front.pivots), np.diff(blocks.indptr[first : first + front.pivots + 1])
    )
    row = blocks.indices[span]
    keep = row >= first + column
    at = np.searchsorted(front.poses, row[keep])
    # Row k of a symmetric matrix holds the transposed blocks of its column k.
    dense[at, :, column[keep], :] = np.swapaxes(blocks.data[span][keep], 1, 2)


def _diagonal(blocks: sparse.bsr_array, front: Front) -> Integers:
    """Where the diagonal blocks of a front's pivots are."""
    first = int(front.poses[0])
    rows = range(first, first + front.pivots)
    starts, indices = blocks.indptr, blocks.indices
    return np.array(
        [starts[r] + np.searchsorted(indices[starts[r] : starts[r + 1]], r) for r in rows]
    )


def _scalars(poses: Integers) -> Integers:
    return np.asarray((BLOCK * poses[:, None] + np.arange(BLOCK)).ravel())
