"""Solving a pose graph with IPOPT, and judging the result by its own gradient and Hessian."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from meshskin import se3
from meshskin.errors import UnknownNameError
from meshskin.estimation.posegraph import linear
from meshskin.estimation.posegraph import start as starts
from meshskin.estimation.posegraph.graph import PoseGraph
from meshskin.estimation.posegraph.kernel import ROOT
from meshskin.estimation.posegraph.problem import EDGE, Integers, Problem
from meshskin.se3 import Array

OBJECTIVES = {"geodesic": "log", "chordal": "vec"}
ACCURACY = 1e-9
"""A solution is optimal if a Newton step would lower the cost by less than this share of it."""
ROUNDING = 1e-13
"""Relative error of a residual that rounding alone makes: no gain below its cost can be seen."""
STAGES = ((0.0, 3), (1.0, 60), (1.0, 60), (1.0, 60))
"""(blend, iterations) of the runs: Gauss-Newton, where it suffices, then the exact Hessian."""
FAR_STAGES = ((1.0, 15),) * 20
"""From the origin: exact Hessian throughout, relinearised often (a Cayley step cannot reach pi)."""
UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class Solution:
    """The poses found, and what is known about them."""

    graph: PoseGraph
    """The graph that was solved."""
    poses: Array
    """(n, 4, 4) T_w_i; each component's first pose is the anchor, and as it was."""
    cost: float
    """Value of the objective: half the weighted sum of squares ("geodesic"), or sum of
    kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2 ("chordal")."""
    objective: str
    """"geodesic" or "chordal"."""
    status: str
    """"optimal", or what is wrong; from the gradient and Hessian at `poses`, not from IPOPT."""
    decrement: float
    """By how much a Newton step would lower the cost, as a share of it."""
    iterations: int
    """Iterations of IPOPT in all."""
    solver_status: str
    """What IPOPT said last."""
    build_time: float
    """Seconds to build the NLP."""
    start_time: float
    """Seconds to find the starting poses."""
    solve_time: float
    """Seconds in IPOPT and in checking its result."""
    iterates: Array | None = None
    """(k, n, 4, 4) the estimates along the iterations, the start first; if they were kept."""

    @property
    def is_optimal(self) -> bool:
        """Whether the poses are a minimum, at least a local one."""
        return self.status == "optimal"


@dataclass
class _State:
    """Poses under way, and the history that led to them."""

    poses: Array
    decrement: float = 0.0
    cost: float = 0.0
    iterations: int = 0
    status: str = "not run"
    iterates: list[Array] = field(default_factory=list)


def solve(
    graph: PoseGraph,
    objective: str = "geodesic",
    start: str | ArrayLike = "chordal",
    keep_iterates: bool = False,
) -> Solution:
    """The poses that minimise the `objective` of `graph`.

    "geodesic": 1/2 sum of e^T Omega e with e = (R_i^T (t_j - t_i) - dt, Log(dR^T R_i^T R_j));
    "chordal": sum of kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2, the objective of the
    published optima. `start`: "chordal", "tree", "origin" (every pose at its anchor) or poses
    (n, 4, 4). From "origin" the chordal objective is minimised first: Log has no basin there.
    The first pose of every component is held. Raises UnknownNameError, GraphError.
    """
    if objective not in OBJECTIVES:
        raise UnknownNameError("objective", objective, OBJECTIVES)
    began = perf_counter()
    state = _State(starts.start(graph, start))
    state.iterates = [state.poses]
    started = perf_counter()
    build = 0.0
    far = isinstance(start, str) and start == "origin"
    if far and len(graph.edges):
        problem = Problem(len(graph.poses), graph.edges, graph.anchors, "vec")
        build += perf_counter() - started
        _minimise(
            problem, graph, chordal_roots(*starts.weights(graph)), state, FAR_STAGES, keep_iterates
        )
    if len(graph.edges):
        again = perf_counter()
        problem = Problem(len(graph.poses), graph.edges, graph.anchors, OBJECTIVES[objective])
        build += perf_counter() - again
        _minimise(problem, graph, roots(graph, objective), state, STAGES, keep_iterates)
    return Solution(
        graph=graph,
        poses=state.poses,
        cost=state.cost,
        objective=objective,
        status=_judge(state),
        decrement=state.decrement,
        iterations=state.iterations,
        solver_status=state.status,
        build_time=build,
        start_time=started - began,
        solve_time=perf_counter() - started - build,
        iterates=np.array(state.iterates) if keep_iterates else None,
    )


def roots(graph: PoseGraph, objective: str) -> Array:
    """Upper-triangular W (m, 6, 6) with cost = |W e|^2 / 2, e the kernel's residual."""
    if objective == "chordal":
        return chordal_roots(*graph.chordal_weights)
    try:
        return np.swapaxes(np.linalg.cholesky(graph.information), 1, 2)
    except np.linalg.LinAlgError:  # singular: the QR factor of sqrt(Lambda) V^T
        values, vectors = np.linalg.eigh(graph.information)
        half = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
        return np.asarray(np.linalg.qr(half, mode="r"))


def chordal_roots(tau: Array, kappa: Array) -> Array:
    """W (m, 6, 6) of the chordal objective: |R_j - R_i dR|_F^2 = 8 |vec(q_err)|^2."""
    w = np.zeros((len(tau), 6, 6))
    w[:, (0, 1, 2), (0, 1, 2)] = np.sqrt(2 * tau)[:, None]
    w[:, (3, 4, 5), (3, 4, 5)] = np.sqrt(4 * kappa)[:, None]
    return w


def edge_numbers(graph: PoseGraph, poses: Array, root: Array) -> Array:
    """The kernel's numbers (35, m): displacements now, displacements measured, W."""
    i, j = graph.edges.T
    now = se3.inverse(poses[i]) @ poses[j]
    numbers = np.empty((EDGE, len(i)))
    for at, pose in ((0, now), (7, graph.measurements)):
        numbers[at : at + 3] = pose[:, :3, 3].T
        numbers[at + 3 : at + 7] = se3.quaternion(pose[:, :3, :3]).T
    numbers[-ROOT:] = root[:, UPPER[0], UPPER[1]].T
    return numbers


def retract(poses: Array, free: Integers, increments: Array, scale: Array) -> Array:
    """Poses (n, 4, 4) moved by scaled local increments (6 * free,) of the poses `free`."""
    steps = increments.reshape(-1, 6)
    moved = np.array(poses)
    moved[free] = poses[free] @ se3.transform(
        se3.cayley(scale[1] * steps[:, 3:]), scale[0] * steps[:, :3]
    )
    return moved


def _minimise(
    problem: Problem,
    graph: PoseGraph,
    root: Array,
    state: _State,
    stages: tuple[tuple[float, int], ...],
    keep: bool,
) -> None:
    """Runs of IPOPT, relinearised between, until a Newton step promises no more."""
    weight = np.sum(root * root, axis=1)  # (m, 6): the diagonal of Omega
    size = np.sum(graph.measurements[:, :3, 3] ** 2, axis=1)
    floor = ROUNDING**2 * float(
        np.sum(weight[:, :3].sum(axis=1) * size + weight[:, 3:].sum(axis=1))
    )
    tolerance = float(np.sqrt(ACCURACY / (6 * len(problem.free))))
    for blend, limit in stages:
        edge = edge_numbers(graph, state.poses, root)
        cost = max(_cost(problem, edge), floor, 1e-300)
        edge[-ROOT:] /= np.sqrt(cost)
        scale = _scale(weight / cost, edge[:3], len(problem.free))
        parameters = ca.DM(np.concatenate([edge.ravel(order="F"), scale, [blend]]))
        run = problem.solve(parameters, tolerance, limit, keep)
        state.iterations += run.iterations
        state.status = run.status
        for x in run.path[1:]:
            state.iterates.append(retract(state.poses, problem.free, x, scale))
        state.poses = retract(state.poses, problem.free, run.x, scale)
        share, drop = _newton(problem, run.x, parameters)
        state.cost = share * cost
        state.decrement = drop / max(share, floor / cost / ACCURACY)
        if state.decrement < ACCURACY:
            return


def _cost(problem: Problem, edge: Array) -> float:
    """Cost at x = 0."""
    e = problem.errors(edge)
    w = np.zeros((edge.shape[1], 6, 6))
    w[:, UPPER[0], UPPER[1]] = edge[-ROOT:].T
    return 0.5 * float(np.sum(np.einsum("eab,be->ea", w, e) ** 2))


def _scale(weight: Array, displacement: Array, free: int) -> Array:
    """Lengths (m, rad) at which the Hessian's diagonal is about 1."""
    lever = np.sum(displacement**2, axis=0)
    translation = 2 * weight[:, :3].sum() / (3 * free)
    rotation = (2 * weight[:, 3:].sum() + weight[:, :3].sum(axis=1) @ lever) / (3 * free)
    return np.array([v**-0.5 if v > 0 else 1.0 for v in (translation, rotation)])


def _newton(problem: Problem, x: Array, parameters: ca.DM) -> tuple[float, float]:
    """Cost at x, and by how much a Newton step would lower it; infinite at a saddle."""
    cost, gradient = problem.gradient(x, parameters)
    upper = problem.hessian(x, parameters).sparse()
    matrix = sparse.csr_array(upper + sparse.triu(upper, 1).T)
    return float(cost), 0.5 * linear.energy(matrix, gradient.full()[:, 0])


def _judge(state: _State) -> str:
    if state.decrement < ACCURACY:
        return "optimal"
    if np.isinf(state.decrement):
        return "saddle: the Hessian is not positive definite"
    return f"not converged: a Newton step would lower the cost by {state.decrement:.1e} of it"
