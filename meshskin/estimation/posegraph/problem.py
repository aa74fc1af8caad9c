"""The pose graph as a CasADi NLP for IPOPT: built once a topology, for any poses and weights.

The unknowns are the local increments of all poses but the anchored ones. Each edge's cost, gradient
and Hessian come from the compiled kernel, mapped over the edges; they are gathered with `.nz` and
added up by constant sparse products, so that CasADi differentiates nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy import sparse

from meshskin.estimation.posegraph.kernel import LOWER, RELATIVE, ROOT, Kernel, kernel
from meshskin.estimation.posegraph.linear import Integers
from meshskin.se3 import Array

EDGE = 2 * RELATIVE + ROOT
METIS = 5
OPTIONS: dict[str, object] = {
    # The kernel is scaled, and the Hessian positive definite in all but a few iterations: what
    # MUMPS does for indefinite or badly scaled matrices only costs time here.
    "nlp_scaling_method": "none",
    "mumps_pivtol": 0.0,
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "mumps_pivot_order": METIS,
    "min_refinement_steps": 0,
    "max_refinement_steps": 0,
    "print_level": 0,
    "sb": "yes",
}


@dataclass(frozen=True)
class Run:
    """What one call of IPOPT returned; its status is reported, never believed."""

    x: Array
    """(6 * free poses,) increments."""
    iterations: int
    status: str
    path: tuple[Array, ...]
    """x after each iteration, the start included; empty if not recorded."""


class Problem:
    """min over x of the sum of edge costs, for fixed edges (m, 2) and anchored poses.

    `parameters` of a solve: the kernel's numbers of each edge (35, m), column by column; the
    lengths (m, rad) of a unit increment; `blend`, 0 for Gauss-Newton, 1 for the exact Hessian.
    """

    def __init__(self, poses: int, edges: Integers, anchors: Integers, residual: str) -> None:
        self.poses, self.edges, self.residual = poses, edges, residual
        self.free: Integers = np.setdiff1d(np.arange(poses), anchors)
        """Poses that move, in the order of x."""
        slot = np.full(poses, len(self.free))  # an anchored pose reads the zeros after x
        slot[self.free] = np.arange(len(self.free))
        self._slots: Integers = slot[edges]  # (m, 2)
        self._build(kernel(residual))
        self._solvers: dict[tuple[tuple[str, object], ...], _Call] = {}

    def solve(self, parameters: Array, tolerance: float, limit: int, record: bool = False) -> Run:
        """Minimise from x = 0 until the gradient is below `tolerance`, `limit` iterations at most.

        `tolerance` is for the parameters' own scale. With `record`, the path is kept.
        """
        recorder = _Recorder(len(self.free) * 6) if record else None
        options: dict[str, object] = {"max_iter": limit, "tol": tolerance}
        if recorder is not None:
            solver = _Call(self._solver(options, iteration_callback=recorder))
        else:
            key = tuple(options.items())
            if key not in self._solvers:
                self._solvers[key] = _Call(self._solver(options))
            solver = self._solvers[key]
        size = 6 * len(self.free)
        free = np.full(size, np.inf)
        x = solver(np.zeros(size), parameters, -free, free)[0]
        stats = solver.stats()
        path = tuple(recorder.path) if recorder else ()
        return Run(x, stats["iter_count"], stats["return_status"], path)

    def gradient(self, x: Array, parameters: Array) -> tuple[float, Array]:
        """Cost, and its gradient (6 free,)."""
        cost, gradient = self._call_gradient(x, parameters)
        return float(cost[0]), gradient

    def hessian(self, x: Array, parameters: Array) -> sparse.csc_array:
        """Upper triangle of the Hessian (6 free, 6 free)."""
        (values,) = self._call_hessian(x, parameters, np.ones(1))
        size = 6 * len(self.free)
        return sparse.csc_array((values, *self._pattern), shape=(size, size))

    def _solver(self, ipopt: dict[str, object], **options: object) -> ca.Function:
        all_options: dict[str, Any] = {
            "grad_f": self._grad_f,
            "hess_lag": self._hess_lag,
            "no_nlp_grad": True,
            "calc_f": False,
            "calc_g": False,
            "calc_lam_x": False,
            "calc_lam_p": False,
            "print_time": False,
            "ipopt": {**OPTIONS, "acceptable_iter": 0, **ipopt},
            **options,
        }
        return ca.nlpsol("posegraph", "ipopt", self._nlp, all_options)

    def _build(self, one: Kernel) -> None:
        m, size = len(self.edges), 6 * len(self.free)
        x, p = ca.MX.sym("x", size), ca.MX.sym("p", EDGE * m + 3)
        edge = ca.reshape(p[: EDGE * m], EDGE, m)
        scale = ca.repmat(p[EDGE * m : EDGE * m + 2], 1, m)
        blend = ca.repmat(p[EDGE * m + 2], 1, m)
        entries = (6 * self._slots[:, :, None] + np.arange(6)).reshape(m, 12)
        entries = np.minimum(entries, size)
        padded = ca.vertcat(x, 0)
        local = ca.reshape(padded.nz[entries.ravel().tolist()], 12, m)

        value = ca.sum2(one.value.map(m).call([local, edge, scale])[0])
        costs, gradients = one.gradient.map(m).call([local, edge, scale])
        gradient = ca.vec(self._sum_poses(gradients[:6, :], gradients[6:, :]))
        hessian = self._hessian(*one.hessian.map(m).call([local, edge, scale, blend]))
        factor, none = ca.MX.sym("factor"), ca.MX.sym("none", 0)
        self._grad_f = ca.Function("grad_f", [x, p], [ca.sum2(costs), gradient])
        self._hess_lag = ca.Function("hess_lag", [x, p, factor, none], [factor * hessian])
        self._call_gradient, self._call_hessian = _Call(self._grad_f), _Call(self._hess_lag)
        self._nlp: dict[str, Any] = {"x": x, "p": p, "f": value}

    def _sum_poses(self, of_i: ca.MX, of_j: ca.MX) -> ca.MX:
        """Sum (k, free) of the edges' columns (k, m) of their first and their second pose."""
        total = ca.MX(of_i.shape[0], len(self.free))
        for columns, slots in ((of_i, self._slots[:, 0]), (of_j, self._slots[:, 1])):
            keep = np.flatnonzero(slots < len(self.free))
            total += ca.mtimes(
                columns, _incidence(keep, slots[keep], columns.shape[1], len(self.free))
            )
        return total

    def _hessian(self, of_i: ca.MX, of_j: ca.MX, between: ca.MX) -> ca.MX:
        """Upper triangle of the Hessian: diagonal blocks by pose, the others by pair of poses."""
        free, (i, j) = len(self.free), self._slots.T
        diagonal = self._sum_poses(of_i, of_j)  # (21, free)
        both = (i < free) & (j < free)
        forward, backward = np.flatnonzero(both & (i < j)), np.flatnonzero(both & (i > j))
        kept = np.concatenate([forward, backward])
        first, second = np.minimum(i, j)[kept], np.maximum(i, j)[kept]
        pairs, pair = np.unique(first * free + second, return_inverse=True)
        turned = np.arange(36).reshape(6, 6).T.ravel().tolist()
        blocks = ca.horzcat(between[:, forward.tolist()], between[turned, backward.tolist()])
        blocks = ca.mtimes(blocks, _incidence(np.arange(len(kept)), pair, len(kept), len(pairs)))
        self._pattern, order = _upper_pattern(free, pairs // free, pairs % free)
        rows, ends = (part.tolist() for part in self._pattern)
        sparsity = ca.Sparsity(6 * free, 6 * free, ends, rows)
        entries = ca.vertcat(ca.vec(diagonal), ca.vec(blocks))
        return ca.MX(sparsity, entries.nz[order])


class _Call:
    """A CasADi function of arrays that are handed over as they are, with its memory kept.

    From Python's arrays to CasADi's matrices and back would cost more than most evaluations.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._buffer: Any
        self._buffer, self._evaluate = function.buffer()

    def __call__(self, *inputs: Array) -> list[Array]:
        """Nonzeros of every output; the last inputs may be left out: zero."""
        view: Any = memoryview
        for k, value in enumerate(inputs):
            self._buffer.set_arg(k, view(value))
        sizes = [self._function.nnz_out(k) for k in range(self._function.n_out())]
        outputs = [np.zeros(size) for size in sizes]
        for k, value in enumerate(outputs):
            self._buffer.set_res(k, view(value))
        self._evaluate()
        return outputs

    def stats(self) -> dict[str, Any]:
        """Statistics of the last call."""
        return dict(self._buffer.stats())


class _Recorder(ca.Callback):
    """Keeps x after every iteration of IPOPT."""

    def __init__(self, size: int) -> None:
        ca.Callback.__init__(self)
        self.size, self.path = size, list[Array]()
        self.construct("recorder", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        name = ca.nlpsol_out(i)
        if name in ("x", "lam_x"):
            return ca.Sparsity.dense(self.size)
        return ca.Sparsity.dense(1) if name == "f" else ca.Sparsity(0, 0)

    def eval(self, arguments: Sequence[ca.DM]) -> list[ca.DM]:
        self.path.append(arguments[0].full()[:, 0])
        return [ca.DM(0)]


def _incidence(rows: Integers, columns: Integers, height: int, width: int) -> ca.DM:
    """Constant 0/1 matrix (height, width): right factor that adds up columns of a matrix."""
    return ca.DM(ca.Sparsity.triplet(height, width, rows.tolist(), columns.tolist()), 1.0)


def _upper_pattern(
    free: int, first: Integers, second: Integers
) -> tuple[tuple[Integers, Integers], list[int]]:
    """Pattern (rows, column ends) of the upper triangle, and where each of its nonzeros is found.

    `first` < `second`: the pairs of poses, sorted. Nonzeros come from the diagonal blocks (21 each,
    lower triangles row by row), then from the pairs' blocks (36 each, rows of the first pose).
    """
    r, c = np.array(LOWER).T
    lower = np.zeros((6, 6), dtype=np.int64)
    lower[c, r] = np.arange(21)  # transposed: the upper triangle
    diagonal = 21 * np.arange(free)[:, None, None] + lower
    between = 21 * free + 36 * np.arange(len(first))[:, None, None] + np.arange(36).reshape(6, 6)
    rows = np.concatenate([np.arange(free), first])
    columns = np.concatenate([np.arange(free), second])
    by_row = np.argsort(rows * free + columns, kind="stable")
    start = np.searchsorted(rows[by_row], np.arange(free + 1))
    blocks = np.concatenate([diagonal, between])[by_row]
    matrix = sparse.bsr_array((blocks, columns[by_row], start), shape=(6 * free, 6 * free))
    matrix = matrix.tocsc()
    matrix.sort_indices()
    column = np.repeat(np.arange(6 * free), np.diff(matrix.indptr))
    keep = matrix.indices <= column
    ends = np.concatenate([[0], np.cumsum(keep)])[matrix.indptr]
    return (matrix.indices[keep], ends), matrix.data[keep].tolist()
