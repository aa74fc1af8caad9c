"""Sparse symmetric matrices of small square blocks, one block per pair of nodes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ...core.arrays import Array
from .ordering import IntArray


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
        return sum_by_index(entries, self.rows[own], nodes)

    def __matmul__(self, x: Array) -> Array:
        """The product with x (nodes, size, k); diagonal blocks must be complete."""
        off = self.rows != self.columns
        transposed = np.swapaxes(self.values[off], 1, 2)
        products = np.concatenate([self.values @ x[self.columns], transposed @ x[self.rows[off]]])
        return sum_by_index(products, np.concatenate([self.rows, self.columns[off]]), len(x))


def sum_by_index(values: Array, index: IntArray, count: int) -> Array:
    """Sums (count, ...) of `values` (k, ...) that have the same `index` (k,)."""
    each = np.arange(len(index))
    gather = sparse.csr_array((np.ones(len(index)), (index, each)), shape=(count, len(index)))
    rest = values.shape[1:]
    return np.asarray(gather @ values.reshape(len(values), math.prod(rest))).reshape(count, *rest)
