"""The pose graph as a CasADi NLP for IPOPT: built once per topology, for any poses and weights.

What depends on the edges alone is kept for all graphs with the same edges.

The unknowns are the local increments of all poses except the anchors. Cost, gradient and Hessian
are CasADi functions that sum the edge kernel over the graph, so that CasADi differentiates nothing
and builds no expression that grows with the graph.
"""

from __future__ import annotations

import functools
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...core.arrays import Array
from ...core.ipopt import BufferCallback, BufferedFunction, IterationCallback, solver
from .cholesky import Cholesky
from .edge_assembly import EDGE, EdgeAssembly
from .ipopt_linear_solver import IpoptLinearSolver
from .symbolic_factorization import IntArray
from .symmetric_blocks import SymmetricBlocks

IPOPT_OPTIONS: dict[str, object] = {
    # The kernel is scaled, and the Hessian positive definite in all but a few iterations: what
    # MUMPS does for indefinite or badly scaled matrices only costs time here.
    "nlp_scaling_method": "none",
    "mumps_pivtol": 0.0,
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "mumps_pivot_order": 5,  # METIS: ICNTL(7) of MUMPS
    "mumps_mem_percent": 20,
    "min_refinement_steps": 0,
    "max_refinement_steps": 0,
    "acceptable_iter": 0,
}
DECREMENT_ITERATIONS = 200
"""Most conjugate gradient iterations for a Newton decrement: a bound that only graphs with weights
many decades apart reach."""


@dataclass(frozen=True)
class IpoptResult:
    """What one call of IPOPT returned; optimality is judged by `decrease`, not by `status`."""

    x: Array
    """(6 * free poses,) increments."""
    cost: float
    """Cost at x."""
    decrease: float
    """Decrease of the cost by a Newton step from x, to second order; infinite at a saddle."""
    iterations: int
    status: str
    """IPOPT's return status."""


class PoseGraphProblem:
    """min over x of the sum of edge costs, for fixed edges (m, 2) and anchors.

    Its parameters are those of `pack_parameters`.
    """

    def __init__(
        self, edges: IntArray, anchors: IntArray, residual: str, cholesky: Cholesky
    ) -> None:
        poses = cholesky.nodes
        self.edges, self.residual = edges, residual
        self.free: IntArray = np.setdiff1d(np.arange(poses), anchors)
        """Poses that move, in the order of x."""
        self._anchors = anchors
        slot = np.full(poses, len(self.free))
        slot[self.free] = np.arange(len(self.free))
        self._assembly = EdgeAssembly(slot[edges], len(self.free), residual)
        self._last: tuple[Array, float, Array] | None = None
        """x, cost and gradient of the last evaluation, which IPOPT asks for again."""
        self._build(6 * len(self.free), EDGE * len(edges) + 3)
        self._solvers: dict[tuple[float, int], BufferedFunction] = {}
        self._linear_solver = IpoptLinearSolver(cholesky, self.free, anchors)

    def solve(
        self,
        parameters: Array,
        tolerance: float,
        limit: int,
        watch: Callable[[Array], None] | None = None,
    ) -> IpoptResult:
        """Minimize from x = 0 until the gradient is below `tolerance`, at most `limit` iterations.

        `tolerance` is in units of the parameters. `watch` gets x at the start and after each
        iteration, and may raise.
        """
        size, gauss_newton = 6 * len(self.free), bool(parameters[-1] == 0.0)
        callback = None if watch is None else IterationCallback(size, 0, lambda x, g: watch(x))
        unbounded = np.full(size, np.inf)
        # one thread at a time: graphs of a topology share the problem
        with self._linear_solver.activate(similar=gauss_newton):
            run = self._solver(tolerance, limit, callback)
            self._last = None  # the parameters change
            x = run(np.zeros(size), parameters, -unbounded, unbounded)[0]
            if callback is not None:
                callback.check()
            stats = run.stats()
            cost, gradient = self._gradient(x, parameters)
            values = self._hessian(x, parameters)
        product = functools.partial(self._assembly.multiply, values)
        decrease = 0.5 * inverse_quadratic_form(product, self._assembly.diagonal(values), gradient)
        return IpoptResult(x, cost, decrease, stats["iter_count"], stats["return_status"])

    def cost(self, edges: Array) -> float:
        """Cost at x = 0 of edges (m, 35)."""
        zero = np.zeros(6 * len(self.free))
        return self._assembly.gradient(edges, np.ones(2), zero, np.empty_like(zero))

    def hessian(self, edges: Array) -> SymmetricBlocks:
        """The Gauss-Newton Hessian at x = 0 of edges (m, 35), of increments in m and rad; anchors
        have a diagonal block of typical size."""
        values = self._hessian(np.zeros(6 * len(self.free)), pack_parameters(edges, np.ones(2), 0))
        lower = SymmetricBlocks.from_lower_triangle(self._assembly.matrix(values).T, 6)
        typical = self._assembly.diagonal(values).reshape(-1, 6).max(axis=0, initial=0.0)
        own = np.diag(np.where(typical > 0, typical, 1.0))
        return SymmetricBlocks(
            np.concatenate([self.free[lower.rows], self._anchors]),
            np.concatenate([self.free[lower.columns], self._anchors]),
            np.concatenate([lower.values, np.broadcast_to(own, (len(self._anchors), 6, 6))]),
        )

    def _gradient(self, x: Array, parameters: Array) -> tuple[float, Array]:
        """Cost and gradient."""
        if self._last is None or not np.array_equal(x, self._last[0]):
            edges, scale, _ = _unpack(parameters)
            gradient = np.empty(len(x))
            cost = self._assembly.gradient(edges, scale, x, gradient)
            self._last = np.array(x), cost, gradient
        return self._last[1:]

    def _hessian(self, x: Array, parameters: Array, values: Array | None = None) -> Array:
        """The nonzeros of the upper triangle, written to `values` if they are given."""
        values = np.empty(self._assembly.size) if values is None else values
        edges, scale, blend = _unpack(parameters)
        self._assembly.hessian(edges, scale, blend, x, values)
        return values

    def _build(self, size: int, parameters: int) -> None:
        one, none = ca.Sparsity.dense(1), ca.Sparsity(0, 1)
        dense, data = ca.Sparsity.dense(size), ca.Sparsity.dense(parameters)

        def gradient(given: list[Array], out: list[Array | None]) -> None:
            found: tuple[Any, ...] = self._gradient(*given)
            for target, value in zip(out, found, strict=False):  # f alone, or f and its gradient
                if target is not None:
                    target[:] = value

        def hessian(given: list[Array], out: list[Array | None]) -> None:
            x, p, factor, _ = given
            if out[0] is not None:
                self._hessian(x, p, out[0])
                if factor != 1.0:
                    out[0] *= factor

        inputs, pattern = [dense, data], self._assembly.pattern()
        # attributes: CasADi does not own callbacks
        self._f = BufferCallback("f", inputs, [one], gradient)
        self._grad_f = BufferCallback("grad_f", inputs, [one, dense], gradient)
        self._hess_lag = BufferCallback("hess_lag", [*inputs, one, none], [pattern], hessian)
        x, p = ca.MX.sym("x", dense), ca.MX.sym("p", data)
        self._nlp: dict[str, Any] = {"x": x, "p": p, "f": self._f(x, p)}

    def _solver(
        self, tolerance: float, limit: int, callback: IterationCallback | None
    ) -> BufferedFunction:
        """IPOPT; without a callback it is kept for these options."""
        if callback is None and (tolerance, limit) in self._solvers:
            return self._solvers[tolerance, limit]
        options = {"max_iter": limit, "tol": tolerance, **self._linear_solver.options}
        made = BufferedFunction(
            solver(
                "posegraph", self._nlp, {**IPOPT_OPTIONS, **options}, gradient=self._grad_f,
                hessian=self._hess_lag, callback=callback,
            )
        )  # fmt: skip
        if callback is None:
            self._solvers[tolerance, limit] = made
        return made


def pack_parameters(edges: Array, scale: Array, blend: float) -> Array:
    """The parameter vector of a problem.

    edges (m, 35): parameters of the kernel; scale (2,): lengths (m, rad) of a unit increment;
    blend: 0 for the Gauss-Newton Hessian, 1 for the exact one.
    """
    return np.concatenate([edges.ravel(), scale, [blend]])


def _unpack(parameters: Array) -> tuple[Array, Array, Array]:
    """Edges (m, 35), scale (2,) and blend (1,) of a parameter vector."""
    return parameters[:-3].reshape(-1, EDGE), parameters[-3:-1], parameters[-1:]


def inverse_quadratic_form(multiply: Callable[[Array], Array], diagonal: Array, b: Array) -> float:
    """b^T A^-1 b to about one digit, for a symmetric A with this `diagonal`; b (n,).

    multiply: x -> A x. Conjugate gradients with a Jacobi preconditioner sum b^T A^-1 b in positive
    terms (Hestenes and Stiefel, 1952); they stop once the last terms add nothing. Infinite where A
    is found not to be positive definite.
    """
    inverse = 1.0 / np.where(diagonal > 0.0, diagonal, 1.0)
    r = b.copy()
    z = inverse * r
    d, rz, total, terms = z, float(r @ z), 0.0, list[float]()
    for _ in range(DECREMENT_ITERATIONS):
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
        rz, rz_before = float(r @ z), rz
        d = z + rz / rz_before * d
    return total


class Topology:
    """Edges (m, 2) between `poses` poses, of which `anchors` are fixed."""

    def __init__(self, poses: int, edges: IntArray, anchors: IntArray) -> None:
        self.poses, self.edges, self.anchors = poses, edges, anchors
        self._lock = threading.Lock()
        self._problems: dict[str, PoseGraphProblem] = {}

    @functools.cached_property
    def cholesky(self) -> Cholesky:
        """Factorizations of matrices with a block for every pose and every edge."""
        return Cholesky(self.poses, *self.edges.T)

    def problem(self, residual: str) -> PoseGraphProblem:
        """The NLP with the kernel's `residual` "log" or "vec", built when first asked for."""
        with self._lock:
            if residual not in self._problems:
                self._problems[residual] = PoseGraphProblem(
                    self.edges, self.anchors, residual, self.cholesky
                )
            return self._problems[residual]


class TopologyCache:
    """The most recently used topologies, at most `edges` edges in all."""

    def __init__(self, edges: int) -> None:
        self._limit, self._lock = edges, threading.Lock()
        self._topologies: OrderedDict[bytes, Topology] = OrderedDict()

    def get(self, poses: int, edges: IntArray, anchors: IntArray) -> Topology:
        """The topology of these edges, new or from the cache; the anchors follow from the edges."""
        digest = hashlib.blake2b(f"{poses} ".encode())
        digest.update(np.ascontiguousarray(edges, dtype=np.int64).tobytes())
        key = digest.digest()
        with self._lock:
            if key not in self._topologies:
                self._topologies[key] = Topology(poses, edges, anchors)
            self._topologies.move_to_end(key)
            while sum(len(t.edges) for t in self._topologies.values()) > self._limit:
                if len(self._topologies) == 1:
                    break
                self._topologies.popitem(last=False)
            return self._topologies[key]


topology_cache = TopologyCache(edges=400_000)
"""The cache of the process. An edge takes up to 15 kB after solving with both residuals (torus3D),
mostly in IPOPT, so that the limit is about 6 GB."""
