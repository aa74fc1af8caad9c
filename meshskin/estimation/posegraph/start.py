"""Where an optimisation starts: chordal relaxation, spanning tree, origin, or poses given."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph

from meshskin import se3
from meshskin.errors import UnknownNameError
from meshskin.estimation.posegraph import linear
from meshskin.estimation.posegraph.graph import PoseGraph, transforms
from meshskin.estimation.posegraph.linear import Integers
from meshskin.se3 import Array

TOLERANCE = 1e-5
"""Of the chordal start's rotations: its cost is then within 2e-4 of the exact start's on the
standard sets; at 1e-3 it is up to a hundred times larger, and 45 iterations follow instead of 3."""


def start(graph: PoseGraph, kind: str | ArrayLike) -> Array:
    """Poses (n, 4, 4) by the name of a start, or those given; anchors stay where they are."""
    if isinstance(kind, str):
        if kind not in STARTS:
            raise UnknownNameError("start", kind, STARTS)
        poses = STARTS[kind](graph)
        poses[graph.anchors] = graph.poses[graph.anchors]  # to the last digit
        return poses
    return transforms("start poses", kind, len(graph.poses))


def chordal(graph: PoseGraph, tolerance: float = TOLERANCE) -> Array:
    """Rotations by linear least squares without their constraint, projected; then translations.

    Minimises sum of kappa |R_j - R_i dR|_F^2 over matrices, then sum of
    tau |t_j - t_i - R_i dt|^2; the first to the relative `tolerance`.
    Source: Martinec and Pajdla, CVPR 2007; Carlone et al., ICRA 2015.
    """
    tau, kappa = weights(graph)
    rotations = _relaxed_rotations(graph, kappa, tolerance)
    arrows = np.einsum("eab,eb->ea", rotations[graph.edges[:, 0]], graph.measurements[:, :3, 3])
    return se3.transform(rotations, _translations(graph, tau, arrows))


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


def _relaxed_rotations(graph: PoseGraph, kappa: Array, tolerance: float) -> Array:
    """R (n, 3, 3). The unknowns are Y_i = (R_i G_i^T)^T with G the rotations along a tree.

    With e.g. no noise all Y are equal: in these unknowns the normal matrix is near the graph's
    Laplacian, whose factor is cheap and makes conjugate gradients converge in a few iterations.
    """
    n, (i, j) = len(graph.poses), graph.edges.T
    guess = tree(graph)[:, :3, :3]
    # Residual R_j - R_i dR with R = Y^T G: Y_j - D^T Y_i, D = G_i dR G_j^T.
    turns = guess[i] @ graph.measurements[:, :3, :3] @ np.swapaxes(guess[j], 1, 2)
    turns *= kappa[:, None, None]
    laplacian = _laplacian(graph, kappa)
    nodes = np.arange(n)
    blocks = np.concatenate(
        [-turns, -np.swapaxes(turns, 1, 2), laplacian.diagonal()[:, None, None] * np.eye(3)]
    )
    rows, columns = np.concatenate([i, j, nodes]), np.concatenate([j, i, nodes])
    matrix = linear.block_matrix(blocks, rows, columns, n)
    free = np.setdiff1d(nodes, graph.anchors)
    solved = np.tile(np.eye(3), (n, 1, 1))  # as along the tree, and the anchors' for good
    if len(free):
        scalars = (3 * free[:, None] + np.arange(3)).ravel()
        flat = solved.reshape(-1, 3)
        part = matrix[scalars]
        factor = linear.factorise(laplacian[free][:, free])

        def near(r: Array) -> Array:
            return factor.solve(r.reshape(len(free), 9)).reshape(r.shape)

        flat[scalars] += linear.solve(part[:, scalars].tocsr(), -(part @ flat), near, tolerance)
    u, _, vt = np.linalg.svd(np.swapaxes(solved, 1, 2) @ guess)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return np.asarray(u @ vt)


def _translations(graph: PoseGraph, tau: Array, arrows: Array) -> Array:
    """t (n, 3) that minimises sum of tau |t_j - t_i - arrow|^2."""
    n, (i, j) = len(graph.poses), graph.edges.T
    weighted = tau[:, None] * arrows
    right = np.stack(
        [np.bincount(j, w, n) - np.bincount(i, w, n) for w in weighted.T],
        axis=1,
    )
    laplacian = _laplacian(graph, tau)
    solved = np.array(graph.poses[:, :3, 3])
    free = np.setdiff1d(np.arange(n), graph.anchors)
    if len(free):
        right -= laplacian[:, graph.anchors] @ solved[graph.anchors]
        solved[free] = linear.factorise(laplacian[free][:, free]).solve(right[free])
    return solved


def _laplacian(graph: PoseGraph, weight: Array) -> sparse.csr_array:
    """The graph's Laplacian (n, n), and a little on the diagonal.

    So poses that no displacement determines stay solvable.
    """
    n, (i, j) = len(graph.poses), graph.edges.T
    degree = np.bincount(i, weight, n) + np.bincount(j, weight, n)
    nodes = np.arange(n)
    little = 1e-12 * degree.max() or 1.0
    values = np.concatenate([-weight, -weight, degree + little])
    places = (np.concatenate([i, j, nodes]), np.concatenate([j, i, nodes]))
    return sparse.csr_array((values, places), shape=(n, n))
