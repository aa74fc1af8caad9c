"""Outlying displacements: graduated non-convexity, Huber, Cauchy, by reweighting.

Each displacement's information is multiplied by a weight in (0, 1] that follows from its own
chi-square e^T Omega e; the poses are solved again, and so on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import gammaincinv

from ...core.se3 import Array
from .gauss_newton import State, edge_numbers, minimise, weighted_errors
from .graph import PoseGraph
from .problem import PoseGraphProblem

QUANTILE = 0.99
"""An inlier's chi-square is below its limit with this probability."""
STEP = 1.4
"""By how much graduated non-convexity approaches the full robust cost, a round."""
ROUNDS = 100
"""Most rounds of reweighting."""
SETTLED = 1e-4
"""Largest change of a weight at which reweighting ends."""

Weight = Callable[[Array, Array, float], Array]
"""(chi-squares (m,), their limits (m,), looseness) -> weights (m,) in (0, 1]."""


def geman_mcclure(chi2: Array, limit: Array, looseness: float) -> Array:
    """(mu c / (chi2 + mu c))^2: convex for a large `looseness` mu, the full cost at 1.

    Source: Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial
    perception", IEEE RA-L 5 (2020).
    """
    return np.asarray((looseness * limit / (chi2 + looseness * limit)) ** 2)


def huber(chi2: Array, limit: Array, looseness: float) -> Array:
    """1 within the limit, sqrt(limit / chi2) beyond."""
    return np.asarray(np.sqrt(limit / np.maximum(chi2, limit)))


def cauchy(chi2: Array, limit: Array, looseness: float) -> Array:
    """1 / (1 + chi2 / limit)."""
    return np.asarray(1.0 / (1.0 + chi2 / limit))


ROBUST: dict[str, Weight] = {"gnc": geman_mcclure, "huber": huber, "cauchy": cauchy}


def reweight(
    problem: PoseGraphProblem,
    graph: PoseGraph,
    root: Array,
    state: State,
    kind: str,
    keep: bool,
    most: int | None = None,
) -> Array:
    """Bring `state` to the minimum of the robust cost; the displacements' weights (m,).

    The information must be right in scale: the limit on a chi-square is the `QUANTILE` of its
    distribution, with as many degrees of freedom as the information has rank.
    """
    rank = np.linalg.matrix_rank(graph.information, hermitian=True)
    limit = 2.0 * gammaincinv(np.maximum(rank, 1) / 2.0, QUANTILE)  # of a chi-square
    weight, function = np.ones(len(graph.edges)), ROBUST[kind]
    minimise(problem, graph, root, state, keep=keep, most=most)
    chi2 = _chi_squares(graph, state.poses, root, problem.residual)
    looseness = max(2.0 * float((chi2 / limit).max()), 1.0) if kind == "gnc" else 1.0
    for _ in range(ROUNDS):
        before, weight = weight, function(chi2, limit, looseness)
        if looseness == 1.0 and np.abs(weight - before).max() < SETTLED:
            break
        if most is not None and state.iterations >= most:
            break
        minimise(problem, graph, root * np.sqrt(weight)[:, None, None], state, keep=keep, most=most)
        chi2 = _chi_squares(graph, state.poses, root, problem.residual)
        looseness = max(looseness / STEP, 1.0)
    return weight


def _chi_squares(graph: PoseGraph, poses: Array, root: Array, residual: str) -> Array:
    """e^T Omega e (m,)."""
    errors = weighted_errors(edge_numbers(graph, poses, root), residual)
    return np.asarray(np.sum(errors**2, axis=0))
