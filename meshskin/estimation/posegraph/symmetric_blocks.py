"""Sparse symmetric matrices of small square blocks, one block per pair of nodes, and their
factorization by SuperLU, where there is no C compiler.

A symmetric matrix is factorized without row exchanges (A = L D L^T up to the storage), so that the
pivots have the signs of its inertia, as those of a Cholesky factorization have. Diagonal blocks of
the inverse are solved for column by column: that takes n solves, slower than cholesky.c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from ...core.arrays import Array, sums_by_group
from .symbolic_factorization import IntArray

UPPER = np.triu_indices(6)
"""Entries of the upper triangle of a block of a pose, by rows, as in g2o files."""
COLUMNS = 120
"""Right-hand sides that are solved together: 14 MB for 2,500 poses."""


@dataclass(frozen=True)
class SymmetricBlocks:
    """A symmetric matrix; each off-diagonal block is given once, in either triangle."""

    rows: IntArray
    """(k,) node of each block's rows; blocks of the same nodes add up."""
    columns: IntArray
    """(k,) node of each block's columns."""
    values: Array
    """(k, size, size); of diagonal blocks a factorization reads the lower triangle."""

    @classmethod
    def from_lower_triangle(cls, lower: sparse.csr_array, size: int) -> SymmetricBlocks:
        """Blocks (size, size) of the symmetric matrix with the scalar lower triangle `lower`."""
        blocks = sparse.bsr_array(lower, blocksize=(size, size))
        rows = np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
        return cls(rows, blocks.indices, blocks.data)

    def add_diagonal(self, values: Array) -> SymmetricBlocks:
        """The sum with the block-diagonal matrix of `values` (nodes, size, size)."""
        nodes = np.arange(len(values))
        return SymmetricBlocks(
            np.concatenate([self.rows, nodes]),
            np.concatenate([self.columns, nodes]),
            np.concatenate([self.values, values]),
        )

    def diagonal(self, nodes: int) -> Array:
        """Entries (nodes, size) on the diagonal."""
        own = self.rows == self.columns
        entries = np.diagonal(self.values[own], axis1=1, axis2=2)
        return sums_by_group(entries, self.rows[own], nodes)

    def __matmul__(self, x: Array) -> Array:
        """The product with x (nodes, size, k); diagonal blocks must be complete."""
        off = self.rows != self.columns
        transposed = np.swapaxes(self.values[off], 1, 2)
        products = np.concatenate([self.values @ x[self.columns], transposed @ x[self.rows[off]]])
        return sums_by_group(products, np.concatenate([self.rows, self.columns[off]]), len(x))


class SingularMatrixError(ArithmeticError):
    """The matrix is not positive definite, up to rounding; `node` has the first such pivot."""

    def __init__(self, node: int) -> None:
        super().__init__(f"not positive definite at node {node}")
        self.node = node


class SuperLUFactors:
    """The factors of `matrix`, its nodes in the elimination `order`.

    Raises SingularMatrixError where a pivot is at most `min_pivot` times its diagonal entry.
    """

    def __init__(self, matrix: SymmetricBlocks, order: IntArray, min_pivot: float) -> None:
        self.size, self.nodes = matrix.values.shape[1], len(order)
        self._rows = (self.size * order[:, None] + np.arange(self.size)).ravel()
        scalar = _scalar_matrix(matrix, self.nodes)[self._rows][:, self._rows].tocsc()
        scale = scalar.diagonal()
        if not np.isfinite(scalar.data).all():
            raise SingularMatrixError(int(order[0]))
        try:
            self._factors = _factorize(scalar)
        except RuntimeError:  # exactly singular: a shift by its rounding shows where
            scale = np.full(len(scale), np.abs(scale).max(initial=1e-300))
            shifted = scalar + sparse.diags_array(1e-16 * scale)
            self._factors, min_pivot = _factorize(sparse.csc_array(shifted)), 1e-13
        pivots = self._factors.U.diagonal()
        unmoved = self._factors.perm_r == np.arange(len(pivots))  # no exchange: no zero pivot
        positive = unmoved & (pivots > min_pivot * scale)
        if not positive.all():
            raise SingularMatrixError(int(order[np.argmin(positive) // self.size]))
        self.log_determinant = float(np.log(pivots).sum())

    def solve(self, right: Array) -> Array:
        """x (nodes, size, k) with the matrix times x = `right` (nodes, size, k)."""
        flat = right.reshape(len(self._rows), -1)
        out = np.empty_like(flat)
        out[self._rows] = self._factors.solve(flat[self._rows])
        return out.reshape(right.shape)

    def diagonal_of_inverse(self) -> Array:
        """Diagonal blocks (nodes, size, size) of the inverse."""
        found = np.empty((self.nodes, self.size, self.size))
        for first in range(0, self.nodes, COLUMNS // self.size):
            chosen = np.arange(first, min(first + COLUMNS // self.size, self.nodes))
            unit = np.zeros((self.nodes, self.size, len(chosen), self.size))
            unit[chosen, :, chosen - first, :] = np.eye(self.size)
            columns = self.solve(unit.reshape(self.nodes, self.size, -1)).reshape(unit.shape)
            found[chosen] = columns[chosen, :, chosen - first, :]
        return found


def _factorize(matrix: sparse.csc_array) -> sparse.linalg.SuperLU:
    options = {"SymmetricMode": True, "Equil": False}
    return splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)


def _scalar_matrix(matrix: SymmetricBlocks, nodes: int) -> sparse.csr_array:
    """The matrix entry by entry; of diagonal blocks the lower triangle is read."""
    size = matrix.values.shape[1]
    own = matrix.rows == matrix.columns
    values = np.where(own[:, None, None], np.tril(matrix.values), matrix.values)
    rows = np.broadcast_to(
        size * matrix.rows[:, None, None] + np.arange(size)[:, None], values.shape
    )
    columns = np.broadcast_to(size * matrix.columns[:, None, None] + np.arange(size), values.shape)
    entries = values.ravel(), (rows.ravel(), columns.ravel())
    half = sparse.csr_array(entries, shape=(nodes * size, nodes * size))
    return half + half.T - sparse.diags_array(half.diagonal())
