"""Solving a pose graph, and its solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_integer, check_name
from ...core.arrays import Array
from ...core.blas import single_threaded
from ...core.errors import GraphError
from ...core.progress import Progress, Stage
from . import certificate as certificates
from . import start as starts
from .minimize import (
    FAR_STAGES,
    ROBUST,
    STAGES,
    Estimate,
    chordal_sqrt_information,
    edge_parameters,
    geodesic_sqrt_information,
    minimize,
    minimize_reweighted,
)
from .symmetric_blocks import SymmetricBlocks

if TYPE_CHECKING:
    from .graph import PoseGraph

RESIDUALS = {"geodesic": "log", "chordal": "vec"}
"""The kernel's residual of each objective."""
CERTIFICATE_TOLERANCE = 1e-18
"""Newton decrement of the minimum that a certificate examines: its gap is linear in the gradient,
thus in the square root of this, and must stay below `certificate.CERTIFIED_GAP`."""
USUAL_ITERATIONS = 5
"""Iterations that a solution usually takes: 3 on sphere2500.g2o, more from other starts."""
FREEDOMS = ("x", "y", "z", "rx", "ry", "rz")
"""Degrees of freedom of a pose, translation first."""


@dataclass(frozen=True, eq=False)
class PoseGraphSolution:
    """The estimated poses, and what is known about them."""

    graph: PoseGraph
    """The graph that was solved."""
    poses: Array
    """(n, 4, 4) T_w_i; the first pose of each component is its anchor, unchanged."""
    cost: float
    """Value of the objective: half the weighted sum of squares ("geodesic"), or sum of
    kappa |R_j - R_i dR|_F^2 + tau |t_j - t_i - R_i dt|^2 ("chordal"); each displacement times its
    weight if robust."""
    objective: str
    """ "geodesic" or "chordal"."""
    status: str
    """ "optimal", or what is wrong; from the gradient and Hessian at `poses`, not from IPOPT."""
    decrement: float
    """Decrease of the cost by a Newton step, as a share of the cost."""
    iterations: int
    """Iterations of IPOPT in all."""
    solver_status: str
    """IPOPT's last return status."""
    build_time: float
    """Seconds to build the NLP."""
    start_time: float
    """Seconds to compute the initial poses."""
    solve_time: float
    """Seconds in IPOPT and in checking its result."""
    weights: Array
    """(m,) weights of the displacements; 1 unless robust."""
    iterates: Array | None = None
    """(k, n, 4, 4) poses along the iterations, the start first; None unless kept."""

    def __repr__(self) -> str:
        return (
            f"<PoseGraphSolution of {self.graph!r}: {self.status}, {self.objective} cost "
            f"{self.cost:.9g} in {self.iterations} iterations>"
        )

    @property
    def is_optimal(self) -> bool:
        """Whether the poses are a minimum, at least a local one."""
        return self.status == "optimal"

    @cached_property
    @single_threaded()
    def certificate(self) -> certificates.Certificate:
        """Proof of global optimality, computed when first asked for.

        It is about the chordal objective with the `weights`: its minimum next to `poses` is
        examined. Where that objective is zero everywhere, nothing is certified.
        """
        graph = self.graph
        if not (self.weights == 1.0).all():
            information = graph.information * self.weights[:, None, None]
            graph = replace(graph, information=information)
        estimate = Estimate(self.poses)
        tau, kappa = graph.chordal_weights
        if tau.any() or kappa.any():
            problem = graph.problem(RESIDUALS["chordal"])
            root = chordal_sqrt_information(tau, kappa)
            minimize(problem, graph, root, estimate, STAGES[1:], tolerance=CERTIFICATE_TOLERANCE)
        return certificates.certify(graph, estimate.poses)

    @property
    def undetermined(self) -> tuple[tuple[int, str], ...]:
        """What the displacements do not determine: (id of the pose, degree of freedom).

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
    @single_threaded()
    def _covariances(self) -> Array:
        graph = self.graph
        if not len(graph.edges):
            return np.zeros((len(self.poses), 6, 6))
        blocks = information(graph, self.poses, self.objective, self.weights)
        covariances = graph.topology.cholesky.marginal_covariances(blocks)
        covariances[graph.anchors] = 0.0
        return covariances


def information(
    graph: PoseGraph, poses: Array, objective: str, weights: Array | float = 1.0
) -> SymmetricBlocks:
    """Gauss-Newton information on local increments of the `poses` (n, 4, 4), of displacements with
    `weights` (m,); anchors have a block of typical size, apart from the others."""
    root = _sqrt_information(graph, objective) * np.sqrt(weights).reshape(-1, 1, 1)
    return graph.problem(RESIDUALS[objective]).hessian(edge_parameters(graph, poses, root))


@single_threaded()
def solve(
    graph: PoseGraph,
    objective: str,
    start: str | ArrayLike,
    robust: str | None,
    keep_iterates: bool,
    certify: bool,
    limit: int | None,
    progress: Progress | None,
) -> PoseGraphSolution:
    """The poses that minimize the `objective` of `graph`; arguments as in `PoseGraph.solve`.

    Raises UnknownNameError, GraphError.
    """
    check_name("objective", objective, RESIDUALS)
    if robust is not None:
        check_name("robust cost", robust, ROBUST)
    if limit is not None:
        check_integer("limit of iterations", limit, least=1, error=GraphError)
    stage = Stage(progress, "solve", USUAL_ITERATIONS)
    solution = _solve(graph, objective, start, robust, keep_iterates, limit, stage)
    chordal = isinstance(start, str) and start == "chordal"
    if certify and not (chordal or (solution.is_optimal and solution.certificate.certified)):
        stage.expect(USUAL_ITERATIONS)
        other = _solve(graph, objective, "chordal", robust, keep_iterates, limit, stage)
        if other.is_optimal and (other.cost < solution.cost or not solution.is_optimal):
            solution = other
    stage.end()
    return solution


def _solve(
    graph: PoseGraph,
    objective: str,
    start: str | ArrayLike,
    robust: str | None,
    keep_iterates: bool,
    limit: int | None,
    stage: Stage,
) -> PoseGraphSolution:
    began = perf_counter()
    estimate = Estimate(starts.initial_poses(graph, start), stage=stage)
    if keep_iterates:
        estimate.iterates = [estimate.poses]
    started, build = perf_counter(), 0.0
    weights = np.ones(len(graph.edges))
    if len(graph.edges):
        root = _sqrt_information(graph, objective)
        far = isinstance(start, str) and start == "origin"
        problem = graph.problem(RESIDUALS[objective])
        chordal = graph.problem(RESIDUALS["chordal"]) if far else problem
        build = perf_counter() - started
        if far:
            near = chordal_sqrt_information(*starts.initial_weights(graph))
            minimize(chordal, graph, near, estimate, FAR_STAGES, limit=limit)
        if robust is None:
            minimize(problem, graph, root, estimate, STAGES, limit=limit)
        else:
            weights = minimize_reweighted(problem, graph, root, estimate, robust, limit)
    return PoseGraphSolution(
        graph=graph,
        poses=estimate.poses,
        cost=estimate.cost,
        objective=objective,
        status=estimate.status,
        decrement=estimate.decrement,
        iterations=estimate.iterations,
        solver_status=estimate.solver_status,
        build_time=build,
        start_time=started - began,
        solve_time=perf_counter() - started - build,
        weights=weights,
        iterates=None if estimate.iterates is None else np.array(estimate.iterates),
    )


def _sqrt_information(graph: PoseGraph, objective: str) -> Array:
    """W (m, 6, 6) with cost = |W e|^2 / 2, e the kernel's residual. GraphError if it is zero."""
    if objective == "chordal":
        root = chordal_sqrt_information(*graph.chordal_weights)
        what, remedy = (
            certificates.NO_WEIGHT,
            "use objective='geodesic', which takes singular information",
        )
    else:
        root = geodesic_sqrt_information(graph.semidefinite_information)
        what = "the objective is zero everywhere: no displacement has positive information"
        remedy = "give information matrices that are positive definite"
    if not root.any():
        raise GraphError(what, remedy=remedy)
    return root
