"""Sparse symmetric positive definite systems, for the starts and for checking a solution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from meshskin.se3 import Array

Integers = NDArray[np.integer]

Operator = Callable[[Array], Array]


def solve(
    matrix: sparse.csr_array, right: Array, preconditioner: Operator, tolerance: float
) -> Array:
    """x (n, k) with `matrix` x = `right` (n, k); `matrix` symmetric positive definite.

    Conjugate gradients, until the error has fallen to `tolerance` in the norm of the matrix, as the
    preconditioner sees it; where they do not get there, a factorisation.
    """
    x, converged = conjugate_gradients(matrix, right, preconditioner, tolerance)
    return x if converged else np.asarray(factorise(matrix).solve(right))


def factorise(matrix: sparse.csr_array, order: str = "MMD_AT_PLUS_A") -> splu:
    """SuperLU of a symmetric positive definite matrix: minimum degree `order`, no pivoting."""
    options = {"SymmetricMode": True}
    return splu(
        sparse.csc_matrix(matrix),
        permc_spec=order,
        diag_pivot_thresh=0.0,
        options=options,
    )


def block_matrix(blocks: Array, rows: Integers, columns: Integers, n: int) -> sparse.csr_array:
    """Matrix (k n, k n) of `blocks` (m, k, k) at block `rows` and `columns`; repeats add up."""
    size = blocks.shape[1] * n
    order = np.argsort(rows, kind="stable")
    start = np.searchsorted(rows[order], np.arange(n + 1))
    matrix = sparse.bsr_array((blocks[order], columns[order], start), shape=(size, size)).tocsr()
    matrix.sum_duplicates()
    return matrix


def conjugate_gradients(
    matrix: sparse.csr_array,
    right: Array,
    preconditioner: Operator,
    tolerance: float,
    limit: int = 100,
) -> tuple[Array, bool]:
    """x (n, k), and whether every column's error fell to `tolerance`.

    Source: Saad, "Iterative Methods for Sparse Linear Systems", algorithm 9.1.
    """
    x, r = np.zeros_like(right), right.copy()
    z = preconditioner(r)
    d, rz = z, np.sum(r * z, axis=0)
    goal = tolerance**2 * rz
    for _ in range(limit):
        if np.all(rz <= goal):
            return x, True
        product = matrix @ d
        step = rz / _positive(np.sum(d * product, axis=0))
        x, r = x + step * d, r - step * product
        z = preconditioner(r)
        rz, before = np.sum(r * z, axis=0), rz
        d = z + rz / _positive(before) * d
    return x, False


def energy(multiply: Operator, diagonal: Array, right: Array, limit: int = 200) -> float:
    """b^T A^-1 b for the symmetric A with this `diagonal` and b = `right` (n,), to about a digit.

    `multiply`: x -> A x. Conjugate gradients add up b^T A^-1 b in positive terms (Hestenes and
    Stiefel, 1952); the sum is good once the last terms add nothing. Infinite where A turns out not
    to be positive definite.
    """
    inverse = 1.0 / _positive(diagonal)
    r = right.copy()
    z = inverse * r
    d, rz, total, terms = z, float(r @ z), 0.0, list[float]()
    for _ in range(limit):
        if rz == 0.0:
            break
        product = multiply(d)
        curvature = float(d @ product)
        if curvature <= 0.0:
            return np.inf
        step = rz / curvature
        terms.append(step * rz)
        total += terms[-1]
        if len(terms) >= 10 and sum(terms[-5:]) < 0.02 * total:
            break
        r = r - step * product
        z = inverse * r
        rz, before = float(r @ z), rz
        d = z + rz / before * d
    return total


def _positive(values: Array) -> Array:
    return np.where(values > 0.0, values, 1.0)
