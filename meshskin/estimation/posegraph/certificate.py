"""A certificate of global optimality: a bound on how far the global optimum is below a cost.

With rows x = (t_i, r_i) of X = (t_1 R_1 ... t_n R_n), (3, 4 n), the chordal objective is
f = tr(X M X^T). At a stationary point (X M)_{R_i} = R_i Lambda_i with symmetric Lambda_i; then for
every feasible X, with S = M - diag(0, Lambda) and optimal translations,

    f(X) = tr(Lambda) + tr(X S X^T) >= tr(Lambda) - 3 n delta    if S + delta diag(0, I) >= 0,

since |R|_F^2 = 3 n. That matrix is positive definite if the pivots of a factorization without
exchanges are positive: then no entry grows, and the factors are those of a matrix that differs by
rounding, for which delta has an allowance.

Source: Rosen, Carlone, Bandeira, Leonard, "SE-Sync", IJRR 38 (2019); Higham, "Accuracy and
Stability of Numerical Algorithms", theorem 10.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array
from .symmetric_blocks import SymmetricBlocks

if TYPE_CHECKING:
    from .graph import PoseGraph

RELATIVE_GAPS = 0.5 * 10.0 ** np.arange(-10, 0.5, 1.0)
"""Relative gaps that are tried in turn, one factorization each: the result is at most ten times the
smallest possible."""
CERTIFIED_GAP = 1e-6
"""Relative gap up to which a cost is certified to be the global optimum: the accuracy of the
published optima."""
NEGLIGIBLE_COST = 1e-20
"""Gap that counts as zero, as a share of the cost of residuals as large as the displacements: the
square of a relative residual of 1e-10."""
POSITION_ROUNDING = 16 * 2.0**-53
"""Rounding of a residual of translation as a share of the positions that it is the difference of:
about ten operations. A cost below that of such residuals is zero."""
NO_WEIGHT = (
    "the chordal objective is zero everywhere: no displacement has translation or rotation "
    "information of full rank"
)
"""What is said where no displacement has a weight in the chordal objective."""
FACTORIZATION_ROUNDING = 1e-14
"""Rounding of the factorization, as a share of the largest diagonal entry: theorem 10.3 bounds it
by (k + 1) 1.1e-16, with k nonzeros in a row of the factor; 90 are typical."""


@dataclass(frozen=True)
class Certificate:
    """What is proven about the global optimum of the chordal objective."""

    cost: float
    """Chordal objective of the examined poses."""
    gap: float
    """The global optimum is at least cost - gap; the whole cost if nothing could be proven."""
    limit: float
    """Gap up to which the poses are certified."""
    poses: Array
    """(n, 4, 4) the examined poses: a minimum of the chordal objective."""
    obstacle: str = ""
    """Why nothing can be certified; empty where the objective can be examined."""

    @property
    def relative_gap(self) -> float:
        """`gap` as a share of the cost."""
        return self.gap / self.cost if self.cost > 0 else 0.0

    @property
    def certified(self) -> bool:
        """Whether the poses are proven to be globally optimal."""
        return not self.obstacle and self.gap <= self.limit

    def __str__(self) -> str:
        if self.obstacle:
            return f"not certified: {self.obstacle}"
        if 0.0 <= self.cost <= self.limit:
            return f"certified: chordal cost {self.cost:.1e}, zero up to rounding"
        verdict = "certified" if self.certified else "not certified"
        return (
            f"{verdict}: chordal cost {self.cost:.9g}, relative gap at most {self.relative_gap:.1e}"
        )


def certify(graph: PoseGraph, poses: Array) -> Certificate:
    """A bound on how much lower than that of `poses` (n, 4, 4) the chordal objective can be.

    It is tight only at a minimum: minimize first.
    """
    n = len(poses)
    if not len(graph.edges):
        return Certificate(0.0, 0.0, 0.0, poses)
    (tau, kappa), lengths = graph.chordal_weights, graph.measurements[:, :3, 3]
    if not (tau.any() or kappa.any()):
        return Certificate(0.0, 0.0, 0.0, poses, NO_WEIGHT)
    cost = chordal_cost(graph, poses)
    scale = float(tau @ np.sum(lengths**2, axis=1) + 3 * kappa.sum())
    far = float(tau @ np.sum(poses[graph.edges, :3, 3] ** 2, axis=(1, 2)))
    limit = max(CERTIFIED_GAP * cost, NEGLIGIBLE_COST * scale, POSITION_ROUNDING**2 * far)
    if cost <= limit:  # the residuals are zero up to rounding
        return Certificate(cost, cost, limit, poses)
    form = quadratic_form(graph)
    x = np.swapaxes(poses[:, :3, [3, 0, 1, 2]], 1, 2)  # X^T, block by block
    product = form @ x
    multipliers = np.einsum("nba,ncb->nac", poses[:, :3, :3], product[:, 1:])
    multipliers = (multipliers + np.swapaxes(multipliers, 1, 2)) / 2
    bound = float(np.trace(multipliers, axis1=1, axis2=2).sum())
    subtracted = np.zeros((n, 4, 4))
    subtracted[:, 1:, 1:] = multipliers
    slack = form.add_diagonal(-subtracted)
    rounding = FACTORIZATION_ROUNDING * float(slack.diagonal(n)[:, 1:].max())
    for relative_gap in RELATIVE_GAPS:
        delta = relative_gap * cost / (3 * n)
        if delta > 2 * rounding and is_positive_definite(graph, slack, delta - rounding):
            gap = abs(cost - bound) + 3 * n * delta
            return Certificate(cost, min(gap, cost), limit, poses)
    return Certificate(cost, cost, limit, poses)  # the cost is a sum of squares


def chordal_cost(graph: PoseGraph, poses: Array) -> float:
    """The chordal objective at `poses` (n, 4, 4), summed over squares: never negative."""
    (tau, kappa), measured = graph.chordal_weights, graph.measurements
    one, two = poses[graph.edges[:, 0]], poses[graph.edges[:, 1]]
    turn = two[:, :3, :3] - one[:, :3, :3] @ measured[:, :3, :3]
    step = np.einsum("eab,eb->ea", one[:, :3, :3], measured[:, :3, 3])
    shift = two[:, :3, 3] - one[:, :3, 3] - step
    return float(kappa @ np.sum(turn**2, axis=(1, 2)) + tau @ np.sum(shift**2, axis=1))


def quadratic_form(graph: PoseGraph) -> SymmetricBlocks:
    """M (4 n, 4 n) of the chordal objective f = tr(X M X^T)."""
    (tau, kappa), m, (i, j) = graph.chordal_weights, len(graph.edges), graph.edges.T
    weight = np.zeros((m, 4, 4))
    weight[:, 0, 0] = tau
    weight[:, (1, 2, 3), (1, 2, 3)] = kappa[:, None]
    step = np.zeros((m, 4, 4))  # residual x_j - step x_i, x = (t, r) of one row
    step[:, 0, 0] = 1.0
    step[:, 0, 1:] = graph.measurements[:, :3, 3]
    step[:, 1:, 1:] = np.swapaxes(graph.measurements[:, :3, :3], 1, 2)
    between = -np.swapaxes(step, 1, 2) @ weight
    blocks = np.concatenate([-between @ step, weight, between])
    return SymmetricBlocks(np.concatenate([i, j, i]), np.concatenate([i, j, j]), blocks)


def is_positive_definite(graph: PoseGraph, slack: SymmetricBlocks, delta: float) -> bool:
    """Whether `slack` + delta diag(0, I) is positive definite, without the anchors' translations
    and those without weight, whose rows are zero.

    The matrix is scaled to a unit diagonal.
    """
    n = len(graph.poses)
    diagonal = slack.diagonal(n) + delta * np.array([0.0, 1.0, 1.0, 1.0])
    fixed = np.zeros((n, 4), dtype=bool)
    fixed[graph.anchors, 0] = True
    fixed[:, 0] |= diagonal[:, 0] == 0.0
    if (diagonal[~fixed] <= 0.0).any():
        return False
    scale = np.where(fixed, 0.0, np.where(fixed, 1.0, diagonal) ** -0.5)
    added = fixed.astype(float)
    added[:, 1:] = delta * scale[:, 1:] ** 2
    scaled = slack.values * scale[slack.rows][:, :, None] * scale[slack.columns][:, None, :]
    matrix = SymmetricBlocks(slack.rows, slack.columns, scaled)
    return graph.topology.cholesky.is_positive_definite(
        matrix.add_diagonal(added[:, :, None] * np.eye(4))
    )
