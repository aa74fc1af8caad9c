"""The gauge of a pose graph: displacements do not determine the pose of a connected part.

Here the rigid alignment of a part's positions with known ones fixes it, and the covariances are
those after the alignment.
"""

from __future__ import annotations

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ..posegraph import PoseGraph
from ..posegraph.solve import PoseGraphSolution, information
from ..result import EstimatorResult
from .observability import SPIN

UNLINKED = "shares too few contacts with other taxels"
MIN_PART = 3
"""Fewest taxels of a part that can be aligned: three points determine a rotation."""


def aligned_estimate(
    graph: PoseGraph,
    solution: PoseGraphSolution,
    fit: EstimatorResult,
    errors: Array,
    weighting: str,
    seconds: float,
) -> EstimatorResult:
    """The estimate of all taxels from a solved graph of the taxels that `fit` has found.

    errors: as in `covariances`; weighting: name of the weighting of the edges; seconds: time of
    building the graph.
    """
    assert solution.iterates is not None
    placed, linked = aligned(graph, solution.poses)
    row, n = np.flatnonzero(fit.found), len(fit.reasons)
    poses = np.full((n, 4, 4), np.nan)
    poses[row[linked]] = placed[linked]
    reasons = fit.reasons.copy()
    reasons[row[~linked]] = UNLINKED
    spread = np.tile(np.diag([np.inf] * 6), (n, 1, 1))
    spread[row[linked]] = covariances(graph, placed, errors)[linked]
    spread[:, SPIN, :] = spread[:, :, SPIN] = 0.0
    spread[:, SPIN, SPIN] = np.inf
    iterates = np.full((len(solution.iterates), n, 3), np.nan)
    for k, step in enumerate(solution.iterates):
        iterates[k, row[linked]] = aligned(graph, step)[0][linked, :3, 3]
    return EstimatorResult(
        points=poses[:, :3, 3],
        rotations=poses[:, :3, :3],
        covariance=spread[:, :2, :2],
        pose_covariances=spread,
        reasons=reasons,
        chi2=np.full(n, np.nan),
        iterates=iterates,
        anchor="rigid alignment of each connected part with the trilaterated positions",
        factors=(
            f"{len(graph.edges)} displacements of taxels active together, {weighting} "
            "information, taken as independent; the covariance is scaled for the readings that "
            "they share",
            "rotation of each frame about its normal: a convention",
        ),
        seconds={"graph": seconds, "build": solution.build_time, "solve": solution.solve_time},
    )


def aligned(graph: PoseGraph, poses: Array) -> tuple[Array, np.ndarray]:
    """`poses` (n, 4, 4) with each part aligned with the graph's own positions, and which of them
    could be aligned (n,) bool.
    """
    out, linked = poses.copy(), np.zeros(len(poses), dtype=bool)
    for rows in _parts(graph):
        out[rows] = se3.align(poses[rows, :3, 3], graph.poses[rows, :3, 3]) @ poses[rows]
        linked[rows] = True
    return out, linked


def covariances(graph: PoseGraph, poses: Array, errors: Array | None = None) -> Array:
    """Covariances (n, 6, 6) of aligned `poses` (n, 4, 4), taxel frames; inf where not aligned.

    With S the covariance given the part's first pose and N (6 n, 6) the rigid motions of the part,
    of which N_t are the translations, the alignment results in (I - A) S (I - A)^T with
    A = N (N_t^T N_t)^-1 N_t^T. S assumes independent displacements with the graph's information.
    They are correlated where they share readings: random `errors` (m, 6, draws) of the m
    displacements give the mean factor by which the part's S is too small.
    """
    out = np.tile(np.diag([np.inf] * 6), (len(poses), 1, 1))
    blocks, cholesky = information(graph, poses, "geodesic"), graph.topology.cholesky
    s = cholesky.marginal_covariances(blocks)
    s[graph.anchors] = 0.0
    parts, whole = _parts(graph), np.zeros((len(poses), 6, 6))
    for rows in parts:
        whole[rows] = _rigid_motions(poses[rows])
    shift = whole * np.repeat([1.0, 0.0], 3)[:, None]

    def moves_by(gradients: Array) -> Array:
        """Moves (n, 6, k) of all poses except the anchors, under gradients (n, 6, k)."""
        free = gradients.copy()
        free[graph.anchors] = 0.0
        return cholesky.solve(blocks, free)

    w = moves_by(shift)
    moves = None if errors is None else moves_by(_gradients(graph, poses, errors))
    for rows in parts:
        lever = whole[rows] @ np.linalg.inv(np.einsum("nij,nik->jk", shift[rows], shift[rows]))
        back = lever @ np.swapaxes(w[rows], 1, 2)
        inner = np.einsum("nij,nik->jk", shift[rows], w[rows])
        ends = lever @ inner @ np.swapaxes(lever, 1, 2)
        out[rows] = s[rows] - back - np.swapaxes(back, 1, 2) + ends
        if moves is not None:
            off = lever @ np.einsum("nij,nik->jk", shift[rows], moves[rows])
            out[rows] *= max(_excess(moves[rows] - off, out[rows]), 1.0)
    return out


def _excess(moves: Array, covariance: Array) -> float:
    """Mean square of `moves` (n, 6, draws) along the surface relative to `covariance` (n, 6, 6)."""
    along = moves[:, :2]
    return float(np.mean(along * np.linalg.solve(covariance[:, :2, :2], along)))


def _gradients(graph: PoseGraph, poses: Array, errors: Array) -> Array:
    """The cost's gradients (n, 6, draws) that errors (m, 6, draws) of the displacements cause."""
    out = np.zeros((len(poses), 6, errors.shape[2]))
    for end, jacobian in zip(graph.edges.T, _jacobians(graph, poses), strict=True):
        np.add.at(out, end, np.swapaxes(jacobian, 1, 2) @ graph.semidefinite_information @ errors)
    return out


def _parts(graph: PoseGraph) -> list[np.ndarray]:
    """Rows of each connected part that can be aligned."""
    parts = [np.flatnonzero(graph.components == c) for c in np.unique(graph.components)]
    return [rows for rows in parts if len(rows) >= MIN_PART]


def _rigid_motions(poses: Array) -> Array:
    """Local increments (n, 6, 6) of each pose per translation and rotation of the whole."""
    back = np.swapaxes(poses[:, :3, :3], 1, 2)
    out = np.zeros((len(poses), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = back
    out[:, :3, 3:] = -back @ se3.hat(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0))
    return out


def _jacobians(graph: PoseGraph, poses: Array) -> tuple[Array, Array]:
    """Derivatives (m, 6, 6) of the residuals by the local increments of both ends of each edge."""
    i, j = graph.edges.T
    relative = se3.inverse(poses[i]) @ poses[j]
    rotation = relative[:, :3, :3]
    into_i, into_j = np.zeros((2, len(i), 6, 6))
    into_i[:, :3, :3] = -np.eye(3)
    into_i[:, :3, 3:] = se3.hat(relative[:, :3, 3])
    into_i[:, 3:, 3:] = -np.swapaxes(rotation, 1, 2)
    into_j[:, :3, :3], into_j[:, 3:, 3:] = rotation, np.eye(3)
    return into_i, into_j
