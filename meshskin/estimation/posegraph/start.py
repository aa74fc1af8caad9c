"""Initial poses of an optimization: chordal relaxation, spanning tree, origin, or poses given."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph

from ...core import se3
from ...core.arguments import check_name
from ...core.arrays import Array, rows_by_key, sums_by_group
from ...core.errors import GraphError
from .symmetric_blocks import SingularMatrixError, SymmetricBlocks
from .validation import chordal_weights, transforms

if TYPE_CHECKING:
    from .graph import PoseGraph

REGULARIZATION = 1e-12
"""Weight that ties each pose to the spanning tree, as a share of its total weight: it makes the
poses that no displacement determines solvable, and moves the others by no more than this share."""


def initial_poses(graph: PoseGraph, kind: str | ArrayLike) -> Array:
    """Poses (n, 4, 4) by the name of a start, or those given; anchors keep their poses.

    Each component of given poses is moved as a whole, so that its anchor is in its place.
    """
    anchors = graph.poses[graph.anchors]
    if not isinstance(kind, str):
        poses = transforms("start poses", kind, len(graph.poses))
        moves = anchors @ se3.inverse(poses[graph.anchors])
        poses = moves[graph.components] @ poses
    else:
        check_name("start", kind, STARTS)
        poses = STARTS[kind](graph)
    poses[graph.anchors] = anchors  # exactly
    return poses


def chordal(graph: PoseGraph) -> Array:
    """Rotations by linear least squares without their constraint, projected; then translations.

    Minimizes sum of kappa |R_j - R_i dR|_F^2 over matrices, then sum of
    tau |t_j - t_i - R_i dt|^2. What these do not determine is as along a spanning tree.
    Source: Martinec and Pajdla, CVPR 2007; Carlone et al., ICRA 2015.
    """
    (tau, kappa), guess = initial_weights(graph), tree(graph)
    rotations, translations = graph.measurements[:, :3, :3], graph.measurements[:, :3, 3]
    transposed, guess_t = (np.swapaxes(r, 1, 2) for r in (rotations, guess[:, :3, :3]))
    matrices = _least_squares(graph, kappa, transposed, guess_t, step=0.0)  # R_j^T - dR^T R_i^T
    u, _, vt = np.linalg.svd(np.swapaxes(matrices, 1, 2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    projected, unit = u @ vt, np.ones((len(translations), 1, 1))
    steps = np.einsum("eab,eb->ea", projected[graph.edges[:, 0]], translations)
    positions = _least_squares(graph, tau, unit, guess[:, None, :3, 3], steps[:, None])
    return se3.transform(projected, positions[:, 0])


def tree(graph: PoseGraph) -> Array:
    """Measurements composed along shortest paths from the anchors, a spanning tree."""
    n, m, (i, j) = len(graph.poses), len(graph.edges), graph.edges.T
    poses = np.array(graph.poses)
    # Both directions of every displacement, by (from, to); of repeated ones the first is used.
    keys, first = np.unique(np.concatenate([i * n + j, j * n + i]), return_index=True)
    links = sparse.csr_array((np.ones(len(keys)), (keys // n, keys % n)), shape=(n, n))
    depth, parents, _ = csgraph.dijkstra(
        links, indices=graph.anchors, unweighted=True, min_only=True, return_predecessors=True
    )
    for level in rows_by_key(depth)[1:]:
        above = parents[level]
        step = first[np.searchsorted(keys, above * np.int64(n) + level)]
        moves = graph.measurements[step % m]
        moves[step >= m] = se3.inverse(moves[step >= m])
        poses[level] = poses[above] @ moves
    return poses


def origin(graph: PoseGraph) -> Array:
    """Every pose at its component's anchor: nothing is known (the paper's figures 6 to 8)."""
    return np.array(graph.poses[graph.anchors][graph.components])


STARTS = {"chordal": chordal, "tree": tree, "origin": origin}


def initial_weights(graph: PoseGraph) -> tuple[Array, Array]:
    """(tau, kappa), (m,) each: chordal weights, where singular the mean of the information."""
    tau, kappa, *_ = chordal_weights(graph.information)
    for weight, block, factor in ((tau, slice(0, 3), 1.0), (kappa, slice(3, 6), 0.5)):
        rows = np.flatnonzero(weight == 0.0)
        values = np.linalg.eigvalsh(graph.information[rows, block, block])
        weight[rows] = factor * np.maximum(values, 0.0).mean(axis=1)
    return tau, kappa


def _least_squares(
    graph: PoseGraph, weight: Array, rotation: Array, guess: Array, step: Array | float
) -> Array:
    """X (n, k, 3) that minimizes sum of weight |X_j - rotation X_i - step|^2, anchors fixed.

    `rotation` (m, k, k) orthogonal, `guess` (n, k, 3) with the anchors' values, `step` (m, k, 3).
    Raises GraphError where the weights are too far apart to compute with.
    """
    n, (i, j) = len(graph.poses), graph.edges.T
    size = guess.shape[1]
    weighted = weight[:, None, None] * (guess[j] - rotation @ guess[i] - step)
    both = np.concatenate([i, j])
    back = np.swapaxes(rotation, 1, 2)
    gradient = sums_by_group(np.concatenate([-back @ weighted, weighted]), both, n)
    degree = np.bincount(both, np.tile(weight, 2), n)
    degree[graph.anchors] = 1.0
    gradient[graph.anchors] = 0.0
    fixed = np.zeros(n, dtype=bool)
    fixed[graph.anchors] = True
    free = ~(fixed[i] | fixed[j])
    own = np.where(degree > 0, degree * (1 + REGULARIZATION), 1.0)[:, None, None] * np.eye(size)
    links = SymmetricBlocks(j[free], i[free], -(weight[:, None, None] * rotation)[free])
    try:
        return guess - graph.topology.cholesky.solve(links.add_diagonal(own), gradient)
    except SingularMatrixError as error:
        raise GraphError(
            "the chordal start cannot be computed: weights too far apart",
            value=f"pose {graph.ids[error.node]}, weights {weight.min():.3g} to {weight.max():.3g}",
            remedy="start from 'tree'",
        ) from error
