"""Cost, gradient and Hessian of a whole graph: the edge kernel over all edges, summed.

The loop is C, compiled once whatever the graph; which edge belongs to which poses is data. Without
a C compiler the kernel is mapped over the edges by CasADi and summed by NumPy.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

import casadi as ca
import numpy as np
from scipy import sparse

from ...core import codegen, se3
from ...core.se3 import Array
from .kernel import EDGE, LOWER, Kernel, kernel
from .ordering import Integers, Long


class EdgeAssembly:
    """Sums over the edges (m, 2), given as rows of x, or `free` where a pose is held."""

    def __init__(self, slots: Integers, free: int, residual: str) -> None:
        self.slots: Long = np.ascontiguousarray(slots, dtype=np.int64)
        self.free = free
        self._kernel, self._library = kernel(residual), library(residual)
        both = (self.slots < free).all(axis=1)
        lower, upper = np.sort(self.slots, axis=1).T
        names = upper[both] * np.int64(free) + lower[both]  # sorted by column, then by row
        pairs, place = np.unique(names, return_inverse=True)
        self.columns, self.rows = pairs // free, pairs % free
        """(pairs,) block columns and rows above the diagonal, sorted by column, then by row."""
        self.heights: Long = np.bincount(self.columns, minlength=free).astype(np.int64)
        first = np.cumsum(self.heights) - self.heights
        self.above: Long = np.zeros(len(slots), dtype=np.int64)
        self.above[both] = place - first[upper[both]]
        sizes = 36 * self.heights + 21
        self.starts: Long = np.cumsum(sizes) - sizes
        self.size = int(sizes.sum())
        """Nonzeros of the upper triangle."""

    def pattern(self) -> ca.Sparsity:
        """The Hessian's upper triangle (6 free, 6 free)."""
        n = self.free
        rows = np.concatenate([self.rows, np.arange(n)])
        columns = np.concatenate([self.columns, np.arange(n)])
        rows = rows[np.lexsort((rows, columns))]
        ends = np.concatenate([[0], np.cumsum(self.heights + 1)])
        blocks = ca.Sparsity(n, n, ends.tolist(), rows.tolist())
        return ca.triu(ca.kron(blocks, ca.Sparsity.dense(6, 6)))

    def gradient(self, edges: Array, scale: Array, x: Array, out: Array) -> float:
        """Cost; its gradient (6 free,) is written to `out`."""
        if self._library is None:
            return self._interpreted_gradient(edges, scale, x, out)
        count = (len(self.slots), self.free, self.slots.ctypes.data)
        addresses = [a.ctypes.data for a in (edges, scale, x, out)]
        return float(self._library.sum_gradient(*count, *addresses))

    def hessian(self, edges: Array, scale: Array, blend: Array, x: Array, out: Array) -> None:
        """Nonzeros (size,) of the Hessian's upper triangle, column by column, into `out`."""
        if self._library is None:
            return self._interpreted_hessian(edges, scale, blend, x, out)
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
        self._library.multiply(self.free, *(a.ctypes.data for a in inputs))
        return out

    def diagonal(self, values: Array) -> Array:
        """(6 free,) of the Hessian."""
        pose, k = np.arange(self.free)[:, None], np.arange(6)
        return np.asarray(values[self._entry(pose, self.heights[pose], k, k)].ravel())

    def matrix(self, values: Array) -> sparse.csc_array:
        """The upper triangle (6 free, 6 free) with nonzeros `values`."""
        pattern = self.pattern()
        rows, ends = (np.array(part()) for part in (pattern.row, pattern.colind))
        return sparse.csc_array((values, rows, ends), shape=(6 * self.free, 6 * self.free))

    def _interpreted_gradient(self, edges: Array, scale: Array, x: Array, out: Array) -> float:
        one = self._kernel.gradient.map(len(edges))
        costs, gradients = one.call([self._local(x), edges.T, _repeated(scale, len(edges))])
        padded = np.zeros((self.free + 1, 6))
        for end in range(2):
            np.add.at(padded, self.slots[:, end], gradients.full()[6 * end : 6 * end + 6].T)
        out[:] = padded[:-1].ravel()
        return float(costs.full().sum())

    def _interpreted_hessian(
        self, edges: Array, scale: Array, blend: Array, x: Array, out: Array
    ) -> None:
        m = len(edges)
        inputs = [self._local(x), edges.T, _repeated(scale, m), _repeated(blend, m)]
        of_i, of_j, between = (b.full().T for b in self._kernel.hessian.map(m).call(inputs))
        out[:] = 0.0
        for end, blocks in enumerate((of_i, of_j)):
            own = self.slots[:, end] < self.free
            pose = self.slots[own, end]
            for k, (c, r) in enumerate(LOWER):  # the transposed lower triangle is the upper
                at = self._entry(pose, self.heights[pose], r, c)
                np.add.at(out, at, blocks[own, k])
        both = (self.slots < self.free).all(axis=1)
        i, j = self.slots[both].T
        for k in range(36):
            row, column = np.where(i < j, k // 6, k % 6), np.where(i < j, k % 6, k // 6)
            at = self._entry(np.maximum(i, j), self.above[both], row, column)
            np.add.at(out, at, between[both, k])

    def _entry(
        self, column: Integers, block: Integers, r: Integers | int, c: Integers | int
    ) -> Integers:
        """Where entry (r, c) of a block is among the nonzeros."""
        return np.asarray(
            self.starts[column]
            + c * 6 * self.heights[column]
            + np.asarray(c) * (np.asarray(c) + 1) // 2
            + 6 * block
            + r
        )

    def _local(self, x: Array) -> Array:
        padded = np.concatenate([x.reshape(-1, 6), np.zeros((1, 6))])
        return np.asarray(padded[self.slots].reshape(-1, 12).T)


def displacements(poses: Array, edges: Long | None, out: Array) -> None:
    """Translation (m) and quaternion, xyzw, of T_i^-1 T_j, written to the rows of `out` (m, 7).

    `out` is the view of rows of `EDGE` numbers. Without `edges` (m, 2): of `poses` (m, 4, 4).
    """
    fast = library("log")
    if fast is not None:
        poses = np.ascontiguousarray(poses)
        pairs = None if edges is None else edges.ctypes.data
        fast.displacements(len(out), pairs, poses.ctypes.data, out.ctypes.data)
        return
    if edges is not None:
        poses = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    out[:, :3], out[:, 3:] = poses[:, :3, 3], se3.quaternion(poses[:, :3, :3])


def _repeated(values: Array, count: int) -> Array:
    return np.tile(np.reshape(values, (-1, 1)), (1, count))


@functools.cache
def library(residual: str) -> ctypes.CDLL | None:
    """The compiled sums of a `residual`, or None."""
    one: Kernel = kernel(residual)
    text = "\n".join(
        [
            codegen.c_source(one.gradient, one.gauss_newton, one.hessian),
            f"#define EDGE {EDGE}",
            f"#define RESIDUAL_gradient {residual}_gradient",
            f"#define RESIDUAL_gauss_newton {residual}_gauss_newton",
            f"#define RESIDUAL_hessian {residual}_hessian",
            "#define DECLARE CASADI_SYMBOL_EXPORT",
            Path(__file__).with_name("edge_assembly.c").read_text(encoding="utf-8"),
        ]
    )
    found = codegen.compile_library(f"posegraph_{residual}", text)
    if found is not None:
        integer, pointer = ctypes.c_longlong, ctypes.c_void_p
        found.multiply.restype = found.displacements.restype = None
        found.multiply.argtypes = [integer] + [pointer] * 6
        found.displacements.argtypes = [integer] + [pointer] * 3
        found.sum_gradient.restype = ctypes.c_double
        found.sum_gradient.argtypes = [integer] * 2 + [pointer] * 5
        found.sum_hessian.restype = None
        found.sum_hessian.argtypes = [integer] * 2 + [pointer] * 8 + [integer, pointer]
    return found
