"""Minimization by IPOPT in local increments, with relinearization between the runs.

Each run minimizes over increments about the poses that the last one found. First a few
Gauss-Newton iterations, then runs with the exact Hessian, until the Newton decrement says that a
minimum is reached.

Robust estimation is by reweighting: the information of each displacement is multiplied by a weight
in (0, 1] that is a function of its chi-square e^T Omega e; the poses are solved for again, and so
on (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv

from ...core import se3
from ...core.arrays import Array
from ...core.errors import GraphError
from ...core.progress import Stage
from .edge_assembly import DISPLACEMENT, EDGE, SQRT_INFORMATION, displacements, weighted_errors
from .problem import PoseGraphProblem, pack_parameters
from .symbolic_factorization import IntArray
from .symmetric_blocks import UPPER

if TYPE_CHECKING:
    from .graph import PoseGraph

OPTIMALITY_TOLERANCE = 1e-9
"""A solution is optimal if a Newton step would lower the cost by less than this share of it: poses
are then within 5e-5 of their standard deviations where the cost is about one per displacement."""
RESIDUAL_ROUNDING = 1e-13
"""Rounding of a residual, relative to its displacement: a few operations on 1e-16. Of a cost below
that of such residuals no decrease can be observed."""
SUCCEEDED = "Solve_Succeeded"
"""IPOPT's status where its own tolerance is met."""
TOLERANCE_REDUCTION = 0.03
"""Factor of IPOPT's tolerance for the gradient after a run that met it without a minimum: the cost
is quadratic in the gradient, so that each run gains three decades of the Newton decrement."""
STAGES = ((0.0, 3), (1.0, 60), (1.0, 60), (1.0, 60))
"""(blend, most iterations) of the runs: Gauss-Newton, where it suffices, then the exact Hessian."""
FAR_STAGES = ((1.0, 15),) * 20
"""From the origin: exact Hessian, relinearized often, because a Cayley step cannot reach pi."""
INLIER_PROBABILITY = 0.99
"""Probability that the chi-square of an inlier is below the limit of its robust cost: the usual
choice, see the source of `geman_mcclure`."""
CONVEXITY_STEP = 1.4
"""Factor by which graduated non-convexity lowers mu in each iteration: the value of its source."""
MAX_REWEIGHTINGS = 100
"""Most iterations of reweighting: graduated non-convexity takes 50 from a chi-square of 1e7 times
its limit."""
WEIGHT_TOLERANCE = 1e-4
"""Largest change of a weight at which reweighting ends: it moves the poses by about this share of
what the displacement moves them."""

WeightFunction = Callable[[Array, Array, float], Array]
"""(chi-squares (m,), their limits (m,), mu) -> weights (m,) in (0, 1]."""


@dataclass
class Estimate:
    """The current poses, what is known about them, and the iterations that led to them."""

    poses: Array
    decrement: float = 0.0
    """Decrease of the cost by a Newton step, as a share of the cost."""
    cost: float = 0.0
    iterations: int = 0
    solver_status: str = "not run"
    iterates: list[Array] | None = None
    """Poses along the iterations, the start first; None: they are not kept."""
    stage: Stage = field(default_factory=Stage)
    """Whose steps are the iterations."""
    reweighted: float = 0.0
    """Largest change of a weight that another reweighting would make; 0 unless it was ended."""

    @property
    def status(self) -> str:
        """ "optimal", or what is wrong."""
        if self.reweighted > 0.0:
            return (
                f"not converged: another reweighting would change a weight by {self.reweighted:.1e}"
                "; allow more iterations"
            )
        if self.decrement < OPTIMALITY_TOLERANCE:
            return "optimal"
        if np.isinf(self.decrement):
            return "saddle: the Hessian is not positive definite; start from 'chordal'"
        return (
            f"not converged (IPOPT: {self.solver_status}): a Newton step would lower the cost by "
            f"{self.decrement:.1e} of it; allow more iterations, or start from 'chordal'"
        )

    def watch(self, free: IntArray, scale: Array) -> Callable[[Array], None] | None:
        """What is called with the increments of each iteration of a run from the current poses;
        None: nothing."""
        if self.iterates is None and self.stage.progress is None:
            return None
        start, begun = self.poses, False

        def watch(x: Array) -> None:
            nonlocal begun
            if begun:
                self.stage.step()
            if begun and self.iterates is not None:
                self.iterates.append(retract(start, free, x, scale))
            begun = True  # the first is the start

        return watch


def minimize(
    problem: PoseGraphProblem,
    graph: PoseGraph,
    sqrt_information: Array,
    estimate: Estimate,
    stages: tuple[tuple[float, int], ...] = STAGES,
    tolerance: float = OPTIMALITY_TOLERANCE,
    limit: int | None = None,
) -> None:
    """Bring `estimate` to a minimum of the `problem` weighted by `sqrt_information` (m, 6, 6).

    Stops as soon as the Newton decrement is below `tolerance`, which is relative: neither units nor
    the scale of the information matter; or once `estimate` has `limit` iterations. Raises
    GraphError where the cost is not finite.
    """
    weight = np.sum(sqrt_information * sqrt_information, axis=1)  # (m, 6): the diagonal of Omega
    floor = RESIDUAL_ROUNDING**2 * _cost_of_displacements(graph, weight)
    gradient_tolerance = float(np.sqrt(tolerance / (6 * len(problem.free))))
    for blend, most in stages:
        if limit is not None:
            most = min(most, limit - estimate.iterations)
        edges = edge_parameters(graph, estimate.poses, sqrt_information)
        cost = max(problem.cost(edges), floor, 1e-300)
        edges[:, -SQRT_INFORMATION:] /= np.sqrt(cost)
        scale = _scale(weight / cost, edges[:, :3], len(problem.free))
        parameters = pack_parameters(edges, scale, blend)
        if not (np.isfinite(cost) and np.isfinite(parameters).all()):
            raise GraphError(
                "the cost must be finite",
                value=f"{cost:.3g}",
                remedy="scale the information matrices: the cost must stay below 1e300",
            )
        watch = estimate.watch(problem.free, scale)
        run = problem.solve(parameters, gradient_tolerance, most, watch)
        estimate.iterations += run.iterations
        estimate.solver_status = run.status
        estimate.poses = retract(estimate.poses, problem.free, run.x, scale)
        estimate.cost = run.cost * cost
        estimate.decrement = run.decrease / max(run.cost, floor / cost / tolerance)
        converged = estimate.decrement < tolerance
        if converged or (limit is not None and estimate.iterations >= limit):
            return
        if run.status == SUCCEEDED:  # the gradient is small, along weak directions not enough
            gradient_tolerance *= TOLERANCE_REDUCTION


def geodesic_sqrt_information(information: Array) -> Array:
    """Upper-triangular W (m, 6, 6) with W^T W = `information`, which may be singular."""
    try:
        return np.swapaxes(np.linalg.cholesky(information), 1, 2)
    except np.linalg.LinAlgError:  # singular: the QR factor of sqrt(Lambda) V^T
        values, vectors = np.linalg.eigh(information)
        half = np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
        return np.asarray(np.linalg.qr(half, mode="r"))


def chordal_sqrt_information(tau: Array, kappa: Array) -> Array:
    """W (m, 6, 6) of the chordal objective: |R_j - R_i dR|_F^2 = 8 |vec(q_err)|^2."""
    w = np.zeros((len(tau), 6, 6))
    w[:, (0, 1, 2), (0, 1, 2)] = np.sqrt(2 * tau)[:, None]
    w[:, (3, 4, 5), (3, 4, 5)] = np.sqrt(4 * kappa)[:, None]
    return w


def edge_parameters(graph: PoseGraph, poses: Array, sqrt_information: Array) -> Array:
    """The kernel's parameters (m, 35): current displacements, measured displacements, W."""
    parameters = np.empty((len(graph.edges), EDGE))
    displacements(poses, graph.edges, parameters[:, :DISPLACEMENT])
    displacements(graph.measurements, None, parameters[:, DISPLACEMENT : 2 * DISPLACEMENT])
    parameters[:, -SQRT_INFORMATION:] = sqrt_information[:, UPPER[0], UPPER[1]]
    return parameters


def retract(poses: Array, free: IntArray, increments: Array, scale: Array) -> Array:
    """Poses (n, 4, 4) moved by scaled local increments (6 * free,) of the poses `free`."""
    steps = increments.reshape(-1, 6)
    moved = np.array(poses)
    moved[free] = poses[free] @ se3.transform(
        se3.cayley(scale[1] * steps[:, 3:]), scale[0] * steps[:, :3]
    )
    return moved


def _cost_of_displacements(graph: PoseGraph, weight: Array) -> float:
    """The cost if the residuals were as large as the displacements."""
    with np.errstate(over="ignore"):  # infinity is found in `minimize`
        length2 = np.sum(graph.measurements[:, :3, 3] ** 2, axis=1)
        return float(np.sum(weight[:, :3].sum(axis=1) * length2 + weight[:, 3:].sum(axis=1)))


def _scale(weight: Array, displacement: Array, free: int) -> Array:
    """Lengths (m, rad) of a unit increment for which the Hessian's diagonal is about 1."""
    lever = np.sum(displacement**2, axis=1)
    translation = 2 * weight[:, :3].sum() / (3 * free)
    rotation = (2 * weight[:, 3:].sum() + weight[:, :3].sum(axis=1) @ lever) / (3 * free)
    return np.array([v**-0.5 if v > 0 else 1.0 for v in (translation, rotation)])


def geman_mcclure(chi2: Array, limit: Array, mu: float) -> Array:
    """(mu c / (chi2 + mu c))^2: convex for a large mu, the robust cost itself at mu = 1.

    Source: Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial
    perception", IEEE RA-L 5 (2020).
    """
    return np.asarray((mu * limit / (chi2 + mu * limit)) ** 2)


def huber(chi2: Array, limit: Array, mu: float) -> Array:
    """1 within the limit, sqrt(limit / chi2) beyond."""
    return np.asarray(np.sqrt(limit / np.maximum(chi2, limit)))


def cauchy(chi2: Array, limit: Array, mu: float) -> Array:
    """1 / (1 + chi2 / limit)."""
    return np.asarray(1.0 / (1.0 + chi2 / limit))


ROBUST: dict[str, WeightFunction] = {"gnc": geman_mcclure, "huber": huber, "cauchy": cauchy}


def minimize_reweighted(
    problem: PoseGraphProblem,
    graph: PoseGraph,
    sqrt_information: Array,
    estimate: Estimate,
    robust: str,
    limit: int | None = None,
) -> Array:
    """Bring `estimate` to the minimum of the robust cost; return the weights (m,) of its poses.

    The information must be right in scale: the limit on a chi-square is the quantile of its
    distribution at `INLIER_PROBABILITY`, with the rank of the information as degrees of freedom.
    """
    geodesic = problem.residual == "log"
    information = graph.semidefinite_information if geodesic else graph.information
    rank = np.linalg.matrix_rank(information, hermitian=True)
    chi2_limit = 2.0 * gammaincinv(np.maximum(rank, 1) / 2.0, INLIER_PROBABILITY)

    def chi_squares(weight: Array) -> Array:
        root = sqrt_information * np.sqrt(weight)[:, None, None]
        minimize(problem, graph, root, estimate, limit=limit)
        edges = edge_parameters(graph, estimate.poses, sqrt_information)
        return np.asarray(np.sum(weighted_errors(edges, problem.residual) ** 2, axis=0))

    weight, function = np.ones(len(graph.edges)), ROBUST[robust]
    chi2 = chi_squares(weight)
    mu = max(2.0 * float((chi2 / chi2_limit).max()), 1.0) if robust == "gnc" else 1.0
    for _ in range(MAX_REWEIGHTINGS):
        following = function(chi2, chi2_limit, mu)
        change = float(np.abs(following - weight).max())
        if mu == 1.0 and change < WEIGHT_TOLERANCE:
            return weight
        if limit is not None and estimate.iterations >= limit:
            break
        weight = following
        chi2 = chi_squares(weight)
        mu = max(mu / CONVEXITY_STEP, 1.0)
    estimate.reweighted = change
    return weight
