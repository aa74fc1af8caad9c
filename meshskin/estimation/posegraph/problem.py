"""The pose graph as a CasADi NLP for IPOPT: built once a topology, for any poses and weights.

The unknowns are the local increments of all poses but the anchored ones. Cost, gradient and Hessian
are CasADi functions that sum the edge kernel over the graph, so that CasADi differentiates nothing
and builds no expression that grows with the graph.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ...core.ipopt import BufferCallback, BufferedFunction, IterationCallback, solver
from ...core.se3 import Array
from . import linear
from .cholesky import Blocks, Cholesky
from .edge_assembly import EdgeAssembly
from .kernel import EDGE
from .ma57 import IpoptLinearSolver
from .marginals import lower_blocks
from .ordering import Integers

METIS = 5
"""MUMPS' number for an order by METIS (ICNTL(7))."""
OPTIONS: dict[str, object] = {
    # The kernel is scaled, and the Hessian positive definite in all but a few iterations: what
    # MUMPS does for indefinite or badly scaled matrices only costs time here.
    "nlp_scaling_method": "none",
    "mumps_pivtol": 0.0,
    "mumps_permuting_scaling": 0,
    "mumps_scaling": 0,
    "mumps_pivot_order": METIS,
    "mumps_mem_percent": 20,
    "min_refinement_steps": 0,
    "max_refinement_steps": 0,
}


@dataclass(frozen=True)
class IpoptRun:
    """What one call of IPOPT returned; its status is reported, never believed."""

    x: Array
    """(6 * free poses,) increments."""
    cost: float
    """At x."""
    gain: float
    """By how much a Newton step from x would lower the cost; infinite at a saddle."""
    iterations: int
    status: str
    path: tuple[Array, ...]
    """x after each iteration, the start included; empty if not recorded."""


class PoseGraphProblem:
    """min over x of the sum of edge costs, for fixed edges (m, 2) and anchored poses.

    `parameters` of a solve: the kernel's numbers of each edge (m, 35), row by row; the lengths
    (m, rad) of a unit increment; `blend`, 0 for Gauss-Newton, 1 for the exact Hessian.
    """

    def __init__(
        self, edges: Integers, anchors: Integers, residual: str, cholesky: Cholesky
    ) -> None:
        poses = cholesky.nodes
        self.edges, self.residual = edges, residual
        self.free: Integers = np.setdiff1d(np.arange(poses), anchors)
        """Poses that move, in the order of x."""
        self._held = anchors
        slot = np.full(poses, len(self.free))  # an anchored pose reads the zeros after x
        slot[self.free] = np.arange(len(self.free))
        self._sweep = EdgeAssembly(slot[edges], len(self.free), residual)
        self._evaluator, self._pattern = _Evaluator(self._sweep), self._sweep.pattern()
        self._build(6 * len(self.free), EDGE * len(edges) + 3)
        self._solvers: dict[tuple[tuple[str, object], ...], BufferedFunction] = {}
        self._door = IpoptLinearSolver(cholesky, self.free, anchors)

    def solve(
        self, parameters: Array, tolerance: float, limit: int, record: bool = False
    ) -> IpoptRun:
        """Minimise from x = 0 until the gradient is below `tolerance`, `limit` iterations at most.

        `tolerance` is for the parameters' own scale. With `record`, the path is kept.
        """
        gauss_newton = bool(parameters[-1] == 0.0)
        # one thread at a time: graphs of a topology share the problem
        with self._door.open(alike=gauss_newton):
            return self._run(parameters, tolerance, limit, record)

    def _run(self, parameters: Array, tolerance: float, limit: int, record: bool) -> IpoptRun:
        size, path = 6 * len(self.free), list[Array]()
        options: dict[str, object] = {"max_iter": limit, "tol": tolerance}
        key = tuple(options.items())
        if record:
            recorder = IterationCallback(size, 0, lambda x, g: path.append(x))
            run = BufferedFunction(self._solver(options, recorder))
        elif key in self._solvers:
            run = self._solvers[key]
        else:
            run = self._solvers[key] = BufferedFunction(self._solver(options))
        free = np.full(size, np.inf)
        self._evaluator.forget()
        x = run(np.zeros(size), parameters, -free, free)[0]
        stats = run.stats()
        cost, gradient = self._evaluator.gradient(x, parameters)
        values = np.empty(self._sweep.size)
        self._evaluator.hessian(x, parameters, values)
        product, diagonal = partial(self._sweep.multiply, values), self._sweep.diagonal(values)
        gain = 0.5 * linear.energy(product, diagonal, gradient)
        return IpoptRun(x, cost, gain, stats["iter_count"], stats["return_status"], tuple(path))

    def cost(self, parameters: Array) -> float:
        """Cost at x = 0."""
        edges, scale, _ = _split(parameters)
        zero = np.zeros(6 * len(self.free))
        return self._sweep.gradient(edges, scale, zero, np.empty_like(zero))

    def hessian(self, parameters: Array) -> Blocks:
        """The Hessian at x = 0; poses that are held have a diagonal block of typical size."""
        values = np.empty(self._sweep.size)
        edges, scale, blend = _split(parameters)
        self._sweep.hessian(edges, scale, blend, np.zeros(6 * len(self.free)), values)
        lower = lower_blocks(self._sweep.matrix(values).T)
        typical = self._sweep.diagonal(values).reshape(-1, 6).max(axis=0, initial=0.0)
        own = np.broadcast_to(np.diag(np.where(typical > 0, typical, 1.0)), (len(self._held), 6, 6))
        return Blocks(
            np.concatenate([self.free[lower.rows], self._held]),
            np.concatenate([self.free[lower.columns], self._held]),
            np.concatenate([lower.values, own]),
        )

    def _build(self, size: int, parameters: int) -> None:
        evaluator, one, none = self._evaluator, ca.Sparsity.dense(1), ca.Sparsity(0, 1)
        dense, data = ca.Sparsity.dense(size), ca.Sparsity.dense(parameters)

        def gradient(given: list[Array], out: list[Array | None]) -> None:
            found: tuple[Any, ...] = evaluator.gradient(*given)
            for place, value in zip(out, found, strict=False):  # f alone, or f and its gradient
                if place is not None:
                    place[:] = value

        def hessian(given: list[Array], out: list[Array | None]) -> None:
            x, p, factor, _ = given
            if out[0] is not None:
                evaluator.hessian(x, p, out[0])
                if factor != 1.0:
                    out[0] *= factor

        inputs = [dense, data]
        # Kept: CasADi does not own callbacks.
        self._f = BufferCallback("f", inputs, [one], gradient)
        self._grad_f = BufferCallback("grad_f", inputs, [one, dense], gradient)
        self._hess_lag = BufferCallback("hess_lag", [*inputs, one, none], [self._pattern], hessian)
        x, p = ca.MX.sym("x", dense), ca.MX.sym("p", data)
        self._nlp: dict[str, Any] = {"x": x, "p": p, "f": self._f(x, p)}

    def _solver(
        self, options: dict[str, object], callback: IterationCallback | None = None
    ) -> ca.Function:
        return solver(
            "posegraph",
            self._nlp,
            {**OPTIONS, **self._door.options, "acceptable_iter": 0, **options},
            gradient=self._grad_f,
            hessian=self._hess_lag,
            callback=callback,
        )


def _split(parameters: Array) -> tuple[Array, Array, Array]:
    """The edges' numbers (m, 35), scale (2,) and blend (1,) in a parameter vector."""
    return parameters[:-3].reshape(-1, EDGE), parameters[-3:-1], parameters[-1:]


class _Evaluator:
    """The sums at x for parameters p. Gradients are asked for where the cost just was: kept."""

    def __init__(self, sweep: EdgeAssembly) -> None:
        self.sweep = sweep
        self.forget()

    def forget(self) -> None:
        """To be called when parameters change."""
        self._x, self._found = np.empty(0), (0.0, np.empty(0))

    def gradient(self, x: Array, parameters: Array) -> tuple[float, Array]:
        """Cost and gradient."""
        if not np.array_equal(x, self._x):
            edges, scale, _ = _split(parameters)
            gradient = np.empty(len(x))
            self._found = self.sweep.gradient(edges, scale, x, gradient), gradient
            self._x = np.array(x)
        return self._found

    def hessian(self, x: Array, parameters: Array, values: Array) -> None:
        """The nonzeros of the upper triangle, written to `values`."""
        edges, scale, blend = _split(parameters)
        self.sweep.hessian(edges, scale, blend, x, values)
