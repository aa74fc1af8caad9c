"""Where an optimisation starts: chordal relaxation, spanning tree, origin, or poses given."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph

from ...core import se3
from ...core.errors import GraphError, UnknownNameError
from ...core.se3 import Array
from .cholesky import Blocks, SingularError, summed
from .graph import PoseGraph, transforms
from .ordering import Integers

LITTLE = 1e-12
"""Share of a pose's weight that holds it to the tree's, so that what no displacement determines is
solvable, too."""


def start(graph: PoseGraph, kind: str | ArrayLike) -> Array:
    """Poses (n, 4, 4) by the name of a start, or those given; anchors stay where they are."""
    if isinstance(kind, str):
        if kind not in STARTS:
            raise UnknownNameError("start", kind, STARTS)
        poses = STARTS[kind](graph)
        poses[graph.anchors] = graph.poses[graph.anchors]  # to the last digit
        return poses
    return transforms("start poses", kind, len(graph.poses))


def chordal(graph: PoseGraph) -> Array:
    """Rotations by linear least squares without their constraint, projected; then translations.

    Minimises sum of kappa |R_j - R_i dR|_F^2 over matrices, then sum of
    tau |t_j - t_i - R_i dt|^2. What these leave open is as along a tree.
    Source: Martinec and Pajdla, CVPR 2007; Carlone et al., ICRA 2015.
    """
    (tau, kappa), guess = weights(graph), tree(graph)
    turns, steps = graph.measurements[:, :3, :3], graph.measurements[:, :3, 3]
    back, along = (np.swapaxes(r, 1, 2) for r in (turns, guess[:, :3, :3]))
    matrices = _least_squares(graph, kappa, back, along, step=0.0)  # R_j^T - dR^T R_i^T
    u, _, vt = np.linalg.svd(np.swapaxes(matrices, 1, 2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotations, unit = u @ vt, np.ones((len(steps), 1, 1))
    arrows = np.einsum("eab,eb->ea", rotations[graph.edges[:, 0]], steps)
    places = _least_squares(graph, tau, unit, guess[:, None, :3, 3], arrows[:, None])
    return se3.transform(rotations, places[:, 0])


def tree(graph: PoseGraph) -> Array:
    """Measurements composed along a spanning tree, breadth first from each anchor."""
    n, m, (i, j) = len(graph.poses), len(graph.edges), graph.edges.T
    poses = np.array(graph.poses)
    # Both directions of every displacement, named by (from, to); of repeated ones the first counts.
    names, first = np.unique(np.concatenate([i * n + j, j * n + i]), return_index=True)
    links = sparse.csr_array((np.ones(len(names)), (names // n, names % n)), shape=(n, n))
    for anchor in graph.anchors:
        order, parents = csgraph.breadth_first_order(links, anchor, directed=True)
        for poses_of_level in _levels(order, parents):
            above = parents[poses_of_level]
            step = first[np.searchsorted(names, above * np.int64(n) + poses_of_level)]
            moves = graph.measurements[step % m]
            moves[step >= m] = se3.inverse(moves[step >= m])
            poses[poses_of_level] = poses[above] @ moves
    return poses


def origin(graph: PoseGraph) -> Array:
    """Every pose at its component's anchor: nothing is known (the paper's figures 6 to 8)."""
    return np.array(graph.poses[graph.anchors][graph.components])


STARTS = {"chordal": chordal, "tree": tree, "origin": origin}


def weights(graph: PoseGraph) -> tuple[Array, Array]:
    """(tau, kappa) for a start: chordal weights, and where singular the mean of the information."""
    tau, kappa = graph.chordal_weights
    mean = np.trace(graph.information[:, :3, :3], axis1=1, axis2=2) / 3
    mean_r = np.trace(graph.information[:, 3:, 3:], axis1=1, axis2=2) / 6
    return np.where(tau > 0, tau, mean), np.where(kappa > 0, kappa, mean_r)


def _levels(order: Integers, parents: Integers) -> list[Integers]:
    """Poses in breadth-first `order`, level by level, without the root."""
    depth = {int(order[0]): 0}
    for pose, parent in zip(order[1:].tolist(), parents[order[1:]].tolist(), strict=True):
        depth[pose] = depth[parent] + 1
    depths = np.fromiter(depth.values(), dtype=np.int64, count=len(depth))
    return np.split(order, np.flatnonzero(np.diff(depths)) + 1)[1:]


def _least_squares(
    graph: PoseGraph, weight: Array, carry: Array, guess: Array, step: Array | float
) -> Array:
    """X (n, k, 3) that minimises sum of weight |X_j - carry X_i - step|^2, anchors as in `guess`.

    `carry` (m, k, k) orthogonal, `guess` (n, k, 3), `step` (m, k, 3). Raises GraphError where the
    weights are too far apart to compute with.
    """
    n, (i, j) = len(graph.poses), graph.edges.T
    size = guess.shape[1]
    weighted = weight[:, None, None] * (guess[j] - carry @ guess[i] - step)
    both = np.concatenate([i, j])
    back = np.swapaxes(carry, 1, 2)
    gradient = summed(np.concatenate([-back @ weighted, weighted]), both, n)
    degree = np.bincount(both, np.tile(weight, 2), n)
    degree[graph.anchors] = 1.0
    gradient[graph.anchors] = 0.0
    held = np.zeros(n, dtype=bool)
    held[graph.anchors] = True
    between = ~(held[i] | held[j])
    own = np.where(degree > 0, degree * (1 + LITTLE), 1.0)[:, None, None] * np.eye(size)
    links = Blocks(j[between], i[between], -(weight[:, None, None] * carry)[between])
    try:
        return guess - graph.topology.cholesky.solve(links.and_diagonal(own), gradient)
    except SingularError as error:
        raise GraphError(
            "no chordal start: weights too far apart",
            value=f"pose {graph.ids[error.node]}, weights {weight.min():.3g} to {weight.max():.3g}",
            remedy="start from 'tree'",
        ) from error
