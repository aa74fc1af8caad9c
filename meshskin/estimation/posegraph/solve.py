"""Solving a pose graph, and the solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import GraphError, UnknownNameError
from ...core.se3 import Array
from . import certificate as certificates
from . import marginals
from . import start as starts
from .gauss_newton import (
    FAR_STAGES,
    STAGES,
    State,
    chordal_roots,
    edge_numbers,
    geodesic_roots,
    minimise,
    parameter_vector,
)
from .graph import PoseGraph
from .problem import PoseGraphProblem
from .robust import ROBUST, reweight

OBJECTIVES = {"geodesic": "log", "chordal": "vec"}
"""Objective -> the kernel's residual."""
POLISH = 1e-18
"""Accuracy of the minimum that a certificate examines: its gap grows with the gradient."""
FREEDOMS = ("x", "y", "z", "rx", "ry", "rz")
"""Degrees of freedom of a pose, translation first."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The poses found, and what is known about them."""

    graph: PoseGraph
    """The graph that was solved."""
    poses: Array
    """(n, 4, 4) T_w_i; each component's first pose is the anchor, and as it was."""
    cost: float
    """Value of the objective: half the weighted sum of squares ("geodesic"), or sum of
    kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2 ("chordal"); each displacement times its
    weight if robust."""
    objective: str
    """ "geodesic" or "chordal"."""
    status: str
    """ "optimal", or what is wrong; from the gradient and Hessian at `poses`, not from IPOPT."""
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
    weights: Array
    """(m,) the displacements' weights; 1 unless robust."""
    iterates: Array | None = None
    """(k, n, 4, 4) the estimates along the iterations, the start first; if they were kept."""

    def __repr__(self) -> str:
        return (
            f"<Solution of {self.graph!r}: {self.status}, {self.objective} cost {self.cost:.9g} in "
            f"{self.iterations} iterations>"
        )

    @property
    def is_optimal(self) -> bool:
        """Whether the poses are a minimum, at least a local one."""
        return self.status == "optimal"

    @cached_property
    def _weighted(self) -> PoseGraph:
        """The graph, its information times the weights."""
        if (self.weights == 1.0).all():
            return self.graph
        information = self.graph.information * self.weights[:, None, None]
        return replace(self.graph, information=information)

    @cached_property
    def certificate(self) -> certificates.Certificate:
        """Proof of global optimality, computed when first asked for.

        It concerns the chordal objective with the `weights`: its minimum next to `poses` is
        examined.
        """
        graph = self._weighted
        state = State(self.poses)
        if len(graph.edges):
            problem = _problem(graph, "chordal")
            root = chordal_roots(*graph.chordal_weights)
            minimise(problem, graph, root, state, STAGES[1:], accuracy=POLISH)
        return certificates.certify(graph, state.poses)

    @property
    def undetermined(self) -> tuple[tuple[int, str], ...]:
        """What the displacements say nothing about: (id of the pose, degree of freedom).

        Translations "x", "y", "z" and rotations "rx", "ry", "rz", along and about the pose's axes.
        """
        variances = np.diagonal(self._covariances, axis1=1, axis2=2)
        found = np.argwhere(np.isinf(variances)).tolist()
        return tuple((int(self.graph.ids[pose]), FREEDOMS[k]) for pose, k in found)

    def covariances(self) -> Array:
        """Marginal covariances (n, 6, 6) of the poses: local frame, translation (m) first, (rad).

        The inverse of the Gauss-Newton information at `poses`, given the anchors: theirs are zero.
        A degree of freedom that the displacements do not determine has an infinite variance.
        """
        return self._covariances.copy()

    @cached_property
    def _covariances(self) -> Array:
        if not len(self.graph.edges):
            return np.zeros((len(self.poses), 6, 6))
        problem = _problem(self.graph, self.objective)
        root = _roots(self.graph, self.objective) * np.sqrt(self.weights)[:, None, None]
        edge = edge_numbers(self.graph, self.poses, root)
        parameters = parameter_vector(edge, np.ones(2), 0.0)
        information = problem.hessian(parameters)
        covariances = marginals.covariances(self.graph.topology.cholesky, information)
        covariances[self.graph.anchors] = 0.0
        return covariances


def solve(
    graph: PoseGraph,
    objective: str = "geodesic",
    start: str | ArrayLike = "chordal",
    robust: str | None = None,
    keep_iterates: bool = False,
    certify: bool = False,
    limit: int | None = None,
) -> Solution:
    """The poses that minimise the `objective` of `graph`.

    "geodesic": 1/2 sum of e^T Omega e with e = (R_i^T (t_j - t_i) - dt, Log(dR^T R_i^T R_j));
    "chordal": sum of kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2, the objective of the
    published optima. `start`: "chordal", "tree", "origin" (every pose at its anchor) or poses
    (n, 4, 4). From "origin" the chordal objective is minimised first: Log has no basin there.
    `robust`: "gnc", "huber" or "cauchy" weigh outlying displacements down. The first pose of every
    component is held. `certify`: where another start's result is no certified optimum, solve again
    from the chordal start; the cheaper result is returned, and its `certificate` says what is
    proven. `limit`: IPOPT's iterations at most; what they did not suffice for is in the `status`.
    Raises UnknownNameError, GraphError.
    """
    if objective not in OBJECTIVES:
        raise UnknownNameError("objective", objective, OBJECTIVES)
    if robust is not None and robust not in ROBUST:
        raise UnknownNameError("robust cost", robust, ROBUST)
    if limit is not None and limit < 1:
        raise GraphError("no iteration is allowed", value=limit, limit="at least 1")
    solution = _solve(graph, objective, start, robust, keep_iterates, limit)
    chordal = isinstance(start, str) and start == "chordal"
    if not certify or chordal or (solution.is_optimal and solution.certificate.certified):
        return solution
    other = _solve(graph, objective, "chordal", robust, keep_iterates, limit)
    better = other.is_optimal and (other.cost < solution.cost or not solution.is_optimal)
    return other if better else solution


def _solve(
    graph: PoseGraph,
    objective: str,
    start: str | ArrayLike,
    robust: str | None,
    keep: bool,
    limit: int | None,
) -> Solution:
    began = perf_counter()
    state = State(starts.start(graph, start))
    state.iterates = [state.poses]
    started, build = perf_counter(), 0.0
    weights = np.ones(len(graph.edges))
    if len(graph.edges):
        problem = _problem(graph, objective)
        build += perf_counter() - started
        if isinstance(start, str) and start == "origin":
            again = perf_counter()
            far = problem if objective == "chordal" else _problem(graph, "chordal")
            build += perf_counter() - again
            root = chordal_roots(*starts.weights(graph))
            minimise(far, graph, root, state, FAR_STAGES, keep, most=limit)
        root = _roots(graph, objective)
        if robust is None:
            minimise(problem, graph, root, state, STAGES, keep, most=limit)
        else:
            weights = reweight(problem, graph, root, state, robust, keep, limit)
    return Solution(
        graph=graph,
        poses=state.poses,
        cost=state.cost,
        objective=objective,
        status=state.status,
        decrement=state.decrement,
        iterations=state.iterations,
        solver_status=state.solver_status,
        build_time=build,
        start_time=started - began,
        solve_time=perf_counter() - started - build,
        weights=weights,
        iterates=np.array(state.iterates) if keep else None,
    )


def _problem(graph: PoseGraph, objective: str) -> PoseGraphProblem:
    """The NLP of `graph`, built when first asked for and kept with the graph."""
    return graph.problem(OBJECTIVES[objective])


def _roots(graph: PoseGraph, objective: str) -> Array:
    """W (m, 6, 6) with cost = |W e|^2 / 2, e the kernel's residual."""
    if objective == "chordal":
        return chordal_roots(*graph.chordal_weights)
    return geodesic_roots(graph.information)
