"""Assembly: cost, gradient and Hessian of a graph as sums of the edge kernel over all edges.

The loop is C (edge_assembly.c), compiled once for all graphs; the poses of each edge are data.
CasADi's own `map` was weighed: its code grows with the graph or returns every edge's Hessian, which
then must be summed. It is the path without a C compiler, with sums by NumPy.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

import casadi as ca
import numpy as np
from scipy import sparse

from ...core import codegen, se3
from ...core.arrays import Array
from .kernel import EDGE, LOWER, edge_kernel
from .symbolic_factorization import Int64Array, IntArray


class EdgeAssembly:
    """Sums over edges (m, 2), given as numbers of free poses in x, or `free` for an anchored pose.

    The Hessian is the upper triangle in compressed columns, as edge_assembly.c describes.
    """

    def __init__(self, slots: IntArray, free: int, residual: str) -> None:
        self.slots: Int64Array = np.ascontiguousarray(slots, dtype=np.int64)
        self.free = free
        self._kernel, self._library = edge_kernel(residual), library(residual)
        self._both_free = (self.slots < free).all(axis=1)
        row, column = np.sort(self.slots, axis=1).T
        keys = column[self._both_free] * np.int64(free) + row[self._both_free]
        blocks, block_of_edge = np.unique(keys, return_inverse=True)
        self.columns, self.rows = blocks // free, blocks % free
        """(blocks,) of the blocks above the diagonal, sorted by column, then by row."""
        self.heights: Int64Array = np.bincount(self.columns, minlength=free).astype(np.int64)
        """(free,) blocks above the diagonal in each block column."""
        first = np.cumsum(self.heights) - self.heights
        self.above: Int64Array = np.zeros(len(slots), dtype=np.int64)
        """(m,) place of each edge's block in its block column."""
        self.above[self._both_free] = block_of_edge - first[column[self._both_free]]
        sizes = 36 * self.heights + 21
        self.starts: Int64Array = np.cumsum(sizes) - sizes
        """(free,) first nonzero of each block column."""
        self.size = int(sizes.sum())
        """Nonzeros of the upper triangle."""

    def pattern(self) -> ca.Sparsity:
        """Sparsity of the upper triangle of the Hessian (6 free, 6 free)."""
        n = self.free
        rows = np.concatenate([self.rows, np.arange(n)])
        columns = np.concatenate([self.columns, np.arange(n)])
        rows = rows[np.lexsort((rows, columns))]
        ends = np.concatenate([[0], np.cumsum(self.heights + 1)])
        blocks = ca.Sparsity(n, n, ends.tolist(), rows.tolist())
        return ca.triu(ca.kron(blocks, ca.Sparsity.dense(6, 6)))

    def gradient(self, edges: Array, scale: Array, x: Array, out: Array) -> float:
        """Return the cost; write its gradient (6 free,) to `out`."""
        if self._library is None:
            return self._mapped_gradient(edges, scale, x, out)
        count = (len(self.slots), self.free, self.slots.ctypes.data)
        addresses = [a.ctypes.data for a in (edges, scale, x, out)]
        return float(self._library.sum_gradient(*count, *addresses))

    def hessian(self, edges: Array, scale: Array, blend: Array, x: Array, out: Array) -> None:
        """Write the nonzeros (size,) of the upper triangle of the Hessian to `out`."""
        if self._library is None:
            return self._mapped_hessian(edges, scale, blend, x, out)
        count = (len(self.slots), self.free, self.slots.ctypes.data)
        inputs = [a.ctypes.data for a in (edges, scale, x, blend)]
        layout = [a.ctypes.data for a in (self.starts, self.heights, self.above)]
        self._library.sum_hessian(*count, *inputs, *layout, self.size, out.ctypes.data)
        return None

    def multiply(self, values: Array, x: Array) -> Array:
        """The Hessian with upper triangle `values` (size,) times x (6 free,)."""
        if self._library is None:
            upper = self.matrix(values)
            return np.asarray(upper @ x + upper.T @ x - upper.diagonal() * x)
        out = np.empty(len(x))
        inputs = (self.starts, self.heights, self.rows, values, x, out)
        self._library.multiply_symmetric(self.free, *(a.ctypes.data for a in inputs))
        return out

    def diagonal(self, values: Array) -> Array:
        """Diagonal (6 free,) of the Hessian with upper triangle `values` (size,)."""
        pose, k = np.arange(self.free)[:, None], np.arange(6)
        return np.asarray(values[self._index(pose, self.heights[pose], k, k)].ravel())

    def matrix(self, values: Array) -> sparse.csc_array:
        """The upper triangle (6 free, 6 free) with nonzeros `values` (size,)."""
        pattern = self.pattern()
        rows, ends = (np.array(part()) for part in (pattern.row, pattern.colind))
        return sparse.csc_array((values, rows, ends), shape=(6 * self.free, 6 * self.free))

    def _mapped_gradient(self, edges: Array, scale: Array, x: Array, out: Array) -> float:
        mapped, repeated = self._kernel.gradient.map(len(edges)), _repeat(scale, len(edges))
        costs, gradients = mapped.call([self._local(x), edges.T, repeated])
        padded = np.zeros((self.free + 1, 6))
        for end in range(2):
            np.add.at(padded, self.slots[:, end], gradients.full()[6 * end : 6 * end + 6].T)
        out[:] = padded[:-1].ravel()
        return float(costs.full().sum())

    def _mapped_hessian(
        self, edges: Array, scale: Array, blend: Array, x: Array, out: Array
    ) -> None:
        m = len(edges)
        inputs = [self._local(x), edges.T, _repeat(scale, m), _repeat(blend, m)]
        of_i, of_j, between = (b.full().T for b in self._kernel.hessian.map(m).call(inputs))
        out[:] = 0.0
        c, r = np.array(LOWER).T  # the transposed lower triangle is the upper
        for end, blocks in enumerate((of_i, of_j)):
            own = self.slots[:, end] < self.free
            pose = self.slots[own, end][:, None]
            np.add.at(out, self._index(pose, self.heights[pose], r, c), blocks[own])
        i, j = self.slots[self._both_free][:, :, None].swapaxes(0, 1)
        r, c = np.divmod(np.arange(36), 6)
        r, c = np.where(i < j, r, c), np.where(i < j, c, r)
        index = self._index(np.maximum(i, j), self.above[self._both_free][:, None], r, c)
        np.add.at(out, index, between[self._both_free])

    def _index(self, column: IntArray, block: IntArray, r: IntArray, c: IntArray) -> IntArray:
        """Index of entry (r, c) of a block of a block column among the nonzeros."""
        first = self.starts[column] + c * 6 * self.heights[column]
        return np.asarray(first + c * (c + 1) // 2 + 6 * block + r)

    def _local(self, x: Array) -> Array:
        """Increments (12, m) of both poses of each edge."""
        padded = np.concatenate([x.reshape(-1, 6), np.zeros((1, 6))])
        return np.asarray(padded[self.slots].reshape(-1, 12).T)


def displacements(poses: Array, edges: Int64Array | None, out: Array) -> None:
    """Write translation (m) and quaternion, xyzw, of T_i^-1 T_j to the rows of `out` (m, 7).

    `out` is a view of rows of `EDGE` numbers. Without `edges` (m, 2): of `poses` (m, 4, 4).
    """
    compiled = library("log")
    if compiled is not None:
        poses = np.ascontiguousarray(poses)
        pairs = None if edges is None else edges.ctypes.data
        compiled.displacements(len(out), pairs, poses.ctypes.data, out.ctypes.data)
        return
    if edges is not None:
        poses = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    out[:, :3], out[:, 3:] = poses[:, :3, 3], se3.quaternion(poses[:, :3, :3])


def _repeat(values: Array, count: int) -> Array:
    return np.tile(np.reshape(values, (-1, 1)), (1, count))


@functools.cache
def library(residual: str) -> ctypes.CDLL | None:
    """The compiled sums of a `residual`; None without a C compiler."""
    one = edge_kernel(residual)
    text = "\n".join(
        [
            codegen.c_source(one.gradient, one.gauss_newton, one.hessian),
            f"#define EDGE {EDGE}",
            *(
                f"#define RESIDUAL_{n} {residual}_{n}"
                for n in ("gradient", "gauss_newton", "hessian")
            ),
            "#define DECLARE CASADI_SYMBOL_EXPORT",
            Path(__file__).with_name("edge_assembly.c").read_text(encoding="utf-8"),
        ]
    )
    found = codegen.compile_library(f"posegraph_{residual}", text)
    if found is not None:
        integer, pointer = ctypes.c_longlong, ctypes.c_void_p
        found.multiply_symmetric.restype = found.displacements.restype = None
        found.multiply_symmetric.argtypes = [integer] + [pointer] * 6
        found.displacements.argtypes = [integer] + [pointer] * 3
        found.sum_gradient.restype = ctypes.c_double
        found.sum_gradient.argtypes = [integer] * 2 + [pointer] * 5
        found.sum_hessian.restype = None
        found.sum_hessian.argtypes = [integer] * 2 + [pointer] * 8 + [integer, pointer]
    return found
