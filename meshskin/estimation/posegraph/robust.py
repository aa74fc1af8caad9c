"""Robust estimation by reweighting: graduated non-convexity, Huber, Cauchy.

The information of each displacement is multiplied by a weight in (0, 1] that is a function of its
chi-square e^T Omega e; the poses are solved for again, and so on (iteratively reweighted least
squares).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv

from ...core.arrays import Array
from .kernel import weighted_errors
from .minimize import Estimate, edge_parameters, minimize
from .problem import PoseGraphProblem

if TYPE_CHECKING:
    from .graph import PoseGraph

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
    keep_iterates: bool,
    limit: int | None = None,
) -> Array:
    """Bring `estimate` to the minimum of the robust cost; return the weights (m,).

    The information must be right in scale: the limit on a chi-square is the quantile of its
    distribution at `INLIER_PROBABILITY`, with the rank of the information as degrees of freedom.
    """
    geodesic = problem.residual == "log"
    information = graph.semidefinite_information if geodesic else graph.information
    rank = np.linalg.matrix_rank(information, hermitian=True)
    chi2_limit = 2.0 * gammaincinv(np.maximum(rank, 1) / 2.0, INLIER_PROBABILITY)

    def chi_squares(weight: Array) -> Array:
        root = sqrt_information * np.sqrt(weight)[:, None, None]
        minimize(problem, graph, root, estimate, keep_iterates=keep_iterates, limit=limit)
        edges = edge_parameters(graph, estimate.poses, sqrt_information)
        return np.asarray(np.sum(weighted_errors(edges, problem.residual) ** 2, axis=0))

    weight, function = np.ones(len(graph.edges)), ROBUST[robust]
    chi2 = chi_squares(weight)
    mu = max(2.0 * float((chi2 / chi2_limit).max()), 1.0) if robust == "gnc" else 1.0
    for _ in range(MAX_REWEIGHTINGS):
        before, weight = weight, function(chi2, chi2_limit, mu)
        if mu == 1.0 and np.abs(weight - before).max() < WEIGHT_TOLERANCE:
            break
        if limit is not None and estimate.iterations >= limit:
            break
        chi2 = chi_squares(weight)
        mu = max(mu / CONVEXITY_STEP, 1.0)
    return weight
