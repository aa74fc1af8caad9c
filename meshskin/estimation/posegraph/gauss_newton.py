"""Runs of IPOPT, relinearised between, until the gradient and Hessian say that it is enough."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...core import se3
from ...core.errors import GraphError
from ...core.se3 import Array
from .edge_assembly import displacements
from .graph import PoseGraph
from .kernel import EDGE, RELATIVE, ROOT
from .ordering import Integers
from .problem import PoseGraphProblem

ACCURACY = 1e-9
"""A solution is optimal if a Newton step would lower the cost by less than this share of it."""
ROUNDING = 1e-13
"""Relative error of a residual that rounding alone makes: no gain below its cost can be seen."""
SUCCEEDED = "Solve_Succeeded"
"""What IPOPT says where its own tolerance is met."""
TIGHTER = 0.03
"""The gradient's tolerance after a run that stopped too early, as a share of what it was."""
STAGES = ((0.0, 3), (1.0, 60), (1.0, 60), (1.0, 60))
"""(blend, iterations) of the runs: Gauss-Newton, where it suffices, then the exact Hessian."""
FAR_STAGES = ((1.0, 15),) * 20
"""From the origin: exact Hessian throughout, relinearised often (a Cayley step cannot reach pi)."""
UPPER = np.triu_indices(6)
"""Entries of W among the kernel's numbers, row by row."""


@dataclass
class State:
    """Poses under way, what is known about them, and the history that led to them."""

    poses: Array
    decrement: float = 0.0
    """By how much a Newton step would lower the cost, as a share of it."""
    cost: float = 0.0
    iterations: int = 0
    solver_status: str = "not run"
    iterates: list[Array] = field(default_factory=list)

    @property
    def status(self) -> str:
        """ "optimal", or what is wrong."""
        if self.decrement < ACCURACY:
            return "optimal"
        if np.isinf(self.decrement):
            return "saddle: the Hessian is not positive definite; start from 'chordal'"
        return (
            f"not converged (IPOPT: {self.solver_status}): a Newton step would lower the cost by "
            f"{self.decrement:.1e} of it; allow more iterations, or start from 'chordal'"
        )


def minimise(
    problem: PoseGraphProblem,
    graph: PoseGraph,
    root: Array,
    state: State,
    stages: tuple[tuple[float, int], ...] = STAGES,
    keep: bool = False,
    accuracy: float = ACCURACY,
    most: int | None = None,
) -> None:
    """Bring `state` to a minimum of the `problem` weighted by `root` (m, 6, 6).

    Every run starts from the poses of the last. Stops as soon as a Newton step promises less than
    `accuracy`, a share of the cost: neither units nor the scale of the information matter; or once
    `state` has seen `most` iterations. Raises GraphError where the cost is no number.
    """
    weight = np.sum(root * root, axis=1)  # (m, 6): the diagonal of Omega
    floor = ROUNDING**2 * _size(graph, weight)
    tolerance = float(np.sqrt(accuracy / (6 * len(problem.free))))
    for blend, limit in stages:
        if most is not None:
            limit = min(limit, most - state.iterations)
        edge = edge_numbers(graph, state.poses, root)
        cost = max(problem.cost(parameter_vector(edge, np.ones(2), blend)), floor, 1e-300)
        edge[:, -ROOT:] /= np.sqrt(cost)
        scale = _scale(weight / cost, edge[:, :3], len(problem.free))
        parameters = parameter_vector(edge, scale, blend)
        if not (np.isfinite(cost) and np.isfinite(parameters).all()):
            raise GraphError(
                "the cost is no number",
                value=f"{cost:.3g}",
                remedy="scale the information matrices: the cost must stay below 1e300",
            )
        run = problem.solve(parameters, tolerance, limit, keep)
        state.iterations += run.iterations
        state.solver_status = run.status
        for x in run.path[1:]:
            state.iterates.append(retract(state.poses, problem.free, x, scale))
        state.poses = retract(state.poses, problem.free, run.x, scale)
        state.cost = run.cost * cost
        state.decrement = run.gain / max(run.cost, floor / cost / accuracy)
        if state.decrement < accuracy or (most is not None and state.iterations >= most):
            return
        if run.status == SUCCEEDED:  # the gradient is small, along weak directions not enough
            tolerance *= TIGHTER


def geodesic_roots(information: Array) -> Array:
    """Upper-triangular W (m, 6, 6) with W^T W = `information`, which may be singular."""
    try:
        return np.swapaxes(np.linalg.cholesky(information), 1, 2)
    except np.linalg.LinAlgError:  # singular: the QR factor of sqrt(Lambda) V^T
        values, vectors = np.linalg.eigh(information)
        half = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
        return np.asarray(np.linalg.qr(half, mode="r"))


def chordal_roots(tau: Array, kappa: Array) -> Array:
    """W (m, 6, 6) of the chordal objective: |R_j - R_i dR|_F^2 = 8 |vec(q_err)|^2."""
    w = np.zeros((len(tau), 6, 6))
    w[:, (0, 1, 2), (0, 1, 2)] = np.sqrt(2 * tau)[:, None]
    w[:, (3, 4, 5), (3, 4, 5)] = np.sqrt(4 * kappa)[:, None]
    return w


def edge_numbers(graph: PoseGraph, poses: Array, root: Array) -> Array:
    """The kernel's numbers (m, 35): displacements now, displacements measured, W."""
    numbers = np.empty((len(graph.edges), EDGE))
    displacements(poses, graph.edges, numbers[:, :RELATIVE])
    displacements(graph.measurements, None, numbers[:, RELATIVE : 2 * RELATIVE])
    numbers[:, -ROOT:] = root[:, UPPER[0], UPPER[1]]
    return numbers


def parameter_vector(edge: Array, scale: Array, blend: float) -> Array:
    """The parameters of a `ReducedProblem`."""
    return np.concatenate([edge.ravel(), scale, [blend]])


def weighted_errors(edge: Array, residual: str) -> Array:
    """W e (6, m) of the kernel's numbers `edge` (m, 35), the kernel's "log" or "vec" residual."""
    edge = edge.T
    now, measured = edge[:RELATIVE], edge[RELATIVE : 2 * RELATIVE]
    (v, w), (mv, mw) = (now[3:], now[6]), (measured[3:], measured[6])
    v, mv = v[:3], mv[:3]
    missed = mw * v - w * mv - np.cross(mv, v, axis=0)
    cosine = mw * w + np.sum(mv * v, axis=0)
    e = np.empty((6, edge.shape[1]))
    e[:3] = now[:3] - measured[:3]
    e[3:] = 2 * missed
    if residual == "log":
        sine = np.sqrt(np.sum(missed**2, axis=0) + 1e-24)
        sign = np.where(cosine < 0, -1.0, 1.0)
        e[3:] = 2 * np.arctan2(sine, sign * cosine) / sine * sign * missed
    weighted = np.zeros_like(e)
    for entry, row, column in zip(edge[-ROOT:], *UPPER, strict=True):
        weighted[row] += entry * e[column]
    return weighted


def retract(poses: Array, free: Integers, increments: Array, scale: Array) -> Array:
    """Poses (n, 4, 4) moved by scaled local increments (6 * free,) of the poses `free`."""
    steps = increments.reshape(-1, 6)
    moved = np.array(poses)
    moved[free] = poses[free] @ se3.transform(
        se3.cayley(scale[1] * steps[:, 3:]), scale[0] * steps[:, :3]
    )
    return moved


def _size(graph: PoseGraph, weight: Array) -> float:
    """What the cost would be if the residuals were as large as the displacements."""
    with np.errstate(over="ignore"):  # infinity is found, and named, where it counts
        length2 = np.sum(graph.measurements[:, :3, 3] ** 2, axis=1)
        return float(np.sum(weight[:, :3].sum(axis=1) * length2 + weight[:, 3:].sum(axis=1)))


def _scale(weight: Array, displacement: Array, free: int) -> Array:
    """Lengths (m, rad) at which the Hessian's diagonal is about 1."""
    lever = np.sum(displacement**2, axis=1)
    translation = 2 * weight[:, :3].sum() / (3 * free)
    rotation = (2 * weight[:, 3:].sum() + weight[:, :3].sum(axis=1) @ lever) / (3 * free)
    return np.array([v**-0.5 if v > 0 else 1.0 for v in (translation, rotation)])
