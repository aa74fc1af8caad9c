"""Cost, gradient and Hessian of a graph: those of one displacement, summed over all edges.

Unknowns of an edge (i, j) are local increments x = (p, a) of its two poses, six numbers each, with
the Cayley retraction R <- R C(l_r a), t <- t + R l_t p and the scales (l_t, l_r) in m and rad. The
current displacement, the measured displacement and the square root W of the information matrix
(W^T W = Omega) are parameters: relinearization and reweighting need no new kernel. With q_err the
rotation between the measured and the current displacement, the residual is

    e = (t - delta_t, Log(q_err))     "log": the geodesic objective
    e = (t - delta_t, 2 vec(q_err))   "vec": the chordal objective, with a wide basin of convergence

and the cost |W e|^2 / 2. The Hessian is J^T J + blend * (curvature of the residual): Gauss-Newton
at blend 0, exact at 1.

The loop over the edges is C (edge_assembly.c), compiled once for all graphs; the poses of each edge
are data. `map` of CasADi was weighed: its code grows with the graph or returns the Hessian of every
edge, which then must be summed. It is the path without a C compiler, with sums by NumPy.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from scipy import sparse

from ...core import codegen, se3
from ...core.arrays import Array
from .symbolic_factorization import Int64Array, IntArray

DISPLACEMENT = 7
"""Numbers of a displacement: translation (3) in m, quaternion (4) xyzw."""
SQRT_INFORMATION = 21
"""Entries of the upper triangle of W, by rows."""
EDGE = 2 * DISPLACEMENT + SQRT_INFORMATION
"""Parameters of an edge: current displacement, measured displacement, W."""
LOWER = [(r, c) for r in range(6) for c in range(r + 1)]
"""Entries of the lower triangle of a block, by rows."""


@dataclass(frozen=True)
class EdgeKernel:
    """Functions of one edge: (x (12,), edge (35,), scale (2,)[, blend]) -> their value."""

    weighted_error: ca.Function
    """edge -> W e (6,) at x = 0."""
    gradient: ca.Function
    """Cost, gradient (12,)."""
    gauss_newton: ca.Function
    """`hessian` at blend 0, at a third of its cost."""
    hessian: ca.Function
    """78 entries of the Hessian in three outputs: of pose i (21,) and of pose j (21,) the lower
    triangle, by rows; and the block (6, 6) of the rows of i and the columns of j, by rows (36,)."""


@functools.cache
def edge_kernel(residual: str) -> EdgeKernel:
    """The kernel of a `residual`, "log" or "vec"."""
    x, edge, scale = ca.SX.sym("x", 12), ca.SX.sym("edge", EDGE), ca.SX.sym("s", 2)
    blend, fixed = ca.SX.sym("blend"), ca.SX.sym("fixed", 6)
    e = error(residual, x, edge[:DISPLACEMENT], edge[DISPLACEMENT : 2 * DISPLACEMENT], scale)
    root = ca.densify(ca.SX(ca.Sparsity.lower(6), edge[2 * DISPLACEMENT :]).T)
    weighted = ca.mtimes(root, e)
    cost = ca.dot(weighted, weighted) / 2
    jacobian = ca.mtimes(root, ca.jacobian(e, x))
    curvature = ca.hessian(ca.dot(fixed, e), x)[0]
    curvature = ca.substitute(curvature, fixed, ca.mtimes(root.T, weighted))
    square = ca.mtimes(jacobian.T, jacobian)
    inputs = [x, edge, scale]

    def function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
        return ca.Function(f"{residual}_{name}", inputs, outputs, {"cse": True})

    at_zero = ca.substitute(weighted, ca.vertcat(x, scale), ca.vertcat(ca.SX.zeros(12), 1, 1))
    return EdgeKernel(
        weighted_error=function("weighted_error", [edge], [at_zero]),
        gradient=function("gradient", inputs, [cost, ca.gradient(cost, x)]),
        gauss_newton=function("gauss_newton", inputs, _blocks(square)),
        hessian=function("hessian", [*inputs, blend], _blocks(square + blend * curvature)),
    )


def _blocks(hessian: ca.SX) -> list[ca.SX]:
    """The three outputs of `EdgeKernel.hessian`."""
    return [
        ca.vertcat(*(hessian[r, c] for r, c in LOWER)),
        ca.vertcat(*(hessian[6 + r, 6 + c] for r, c in LOWER)),
        ca.vec(hessian[:6, 6:].T),
    ]


def error(residual: str, x: ca.SX, current: ca.SX, measured: ca.SX, scale: ca.SX) -> ca.SX:
    """e (6,) of the displacement D(x_i)^-1 T_ij D(x_j), T_ij the `current` one."""
    p_i, p_j = scale[0] * x[:3], scale[0] * x[6:9]
    c_i, c_j = cayley(scale[1] * x[3:6]), cayley(scale[1] * x[9:])
    t, q = current[:3], current[3:]
    moved = t + ca.mtimes(se3.casadi_rotation(q), p_j) - p_i
    translation = ca.mtimes(se3.casadi_rotation(conjugate(c_i)), moved)
    rotated = quaternion_product(q, c_j)
    rotated = quaternion_product(conjugate(c_i), rotated)
    q_err = quaternion_product(conjugate(measured[3:]), rotated)
    rotation = 2 * q_err[:3] if residual == "vec" else log(q_err)
    return ca.vertcat(translation - measured[:3], rotation)


def quaternion_product(p: ca.SX, q: ca.SX) -> ca.SX:
    """Hamilton product of quaternions (4,), xyzw: the rotation `q`, followed by `p`."""
    v = p[3] * q[:3] + q[3] * p[:3] + ca.cross(p[:3], q[:3])
    return ca.vertcat(v, p[3] * q[3] - ca.dot(p[:3], q[:3]))


def conjugate(q: ca.SX) -> ca.SX:
    """Inverse of a unit quaternion (4,), xyzw."""
    return ca.vertcat(-q[:3], q[3])


def cayley(a: ca.SX) -> ca.SX:
    """Unit quaternion (4,), xyzw, of the increment `a` (3,): (a/2, 1) / sqrt(1 + |a|^2/4).

    Equal to the exponential map to second order at 0 (the angle is 2 atan(|a|/2)), and cheaper.
    """
    return ca.vertcat(a / 2, 1) / ca.sqrt(1 + ca.dot(a, a) / 4)


def log(q: ca.SX) -> ca.SX:
    """Rotation vector (3,), in rad, of a unit quaternion (4,), xyzw.

    Value, gradient and Hessian are finite everywhere, also at the identity and at pi.
    """
    v, w = q[:3], q[3]
    sign = ca.if_else(w < 0, -1, 1)
    n = ca.sqrt(ca.dot(v, v) + 1e-24)
    return 2 * ca.atan2(n, sign * w) / n * sign * v


def weighted_errors(edges: Array, residual: str) -> Array:
    """W e (6, m) at x = 0 of the parameters `edges` (m, 35), for the "log" or "vec" residual."""
    return np.asarray(edge_kernel(residual).weighted_error.map(len(edges))(edges.T).full())


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
