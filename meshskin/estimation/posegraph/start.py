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
from meshskin.se3 import Array


def start(graph: PoseGraph, kind: str | ArrayLike) -> Array:
    """Poses (n, 4, 4) by the name of a start, or those given; anchors stay where they are."""
    if isinstance(kind, str):
        if kind not in STARTS:
            raise UnknownNameError("start", kind, STARTS)
        return STARTS[kind](graph)
    return transforms("start poses", kind, len(graph.poses))


def chordal(graph: PoseGraph) -> Array:
    """Rotations by linear least squares without their constraint, projected; then translations.

    Minimises sum of kappa |R_j - R_i dR|_F^2 over matrices, then sum of
    tau |t_j - t_i - R_i dt|^2. Source: Martinec and Pajdla, CVPR 2007; Carlone et al., ICRA 2015.
    """
    tau, kappa = weights(graph)
    rotations = _relaxed_rotations(graph, kappa)
    arrows = np.einsum("eab,eb->ea", rotations[graph.edges[:, 0]], graph.measurements[:, :3, 3])
    return se3.transform(rotations, _translations(graph, tau, arrows))


def tree(graph: PoseGraph) -> Array:
    """Measurements composed along a spanning tree, breadth first from each anchor."""
    n, (i, j) = len(graph.poses), graph.edges.T
    edge = np.arange(1, len(i) + 1)
    both = (np.concatenate([i, j]), np.concatenate([j, i]))
    # Repeated edges: the first counts.
    _, first = np.unique(both[0] * n + both[1], return_index=True)
    number = np.concatenate([edge, -edge])[first]
    keys = (both[0][first], both[1][first])
    lookup = dict(zip(zip(*(k.tolist() for k in keys), strict=True), number.tolist(), strict=True))
    links = sparse.csr_array((np.ones(len(number)), keys), shape=(n, n))
    poses = np.array(graph.poses)
    for anchor in graph.anchors:
        order, parents = csgraph.breadth_first_order(links, anchor, directed=True)
        for child in order[1:]:
            signed = lookup[int(parents[child]), int(child)]
            step = graph.measurements[abs(signed) - 1]
            poses[child] = poses[parents[child]] @ (step if signed > 0 else se3.inverse(step))
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


def _relaxed_rotations(graph: PoseGraph, kappa: Array) -> Array:
    """R (n, 3, 3): the unknown blocks are X_i = R_i^T, and X_j - dR^T X_i the residual."""
    n, (i, j) = len(graph.poses), graph.edges.T
    turns = kappa[:, None, None] * graph.measurements[:, :3, :3]
    degree = np.bincount(i, kappa, n) + np.bincount(j, kappa, n)
    blocks = np.concatenate([-turns, -np.swapaxes(turns, 1, 2), degree[:, None, None] * np.eye(3)])
    rows = np.concatenate([i, j, np.arange(n)])
    columns = np.concatenate([j, i, np.arange(n)])
    matrix = linear.block_matrix(blocks, rows, columns, n)
    fixed = np.swapaxes(graph.poses[:, :3, :3], 1, 2)
    matrix = matrix.tocsr()
    matrix.sum_duplicates()
    solved = _with_anchors(graph, matrix, fixed, 0.0)
    u, _, vt = np.linalg.svd(np.swapaxes(solved, 1, 2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return np.asarray(u @ vt)


def _translations(graph: PoseGraph, tau: Array, arrows: Array) -> Array:
    """t (n, 3) that minimises sum of tau |t_j - t_i - arrow|^2."""
    n, m, (i, j) = len(graph.poses), len(graph.edges), graph.edges.T
    edge = np.arange(m)
    incidence = sparse.csr_array(
        (np.repeat([1.0, -1.0], m), (np.tile(edge, 2), np.concatenate([j, i]))), shape=(m, n)
    )
    weighted = incidence.multiply(tau[:, None]).tocsr()
    right = weighted.T @ arrows
    matrix = (incidence.T @ weighted).tocsr()
    return _with_anchors(graph, matrix, graph.poses[:, None, :3, 3], right[:, None, :])[:, 0]


def _with_anchors(
    graph: PoseGraph, matrix: sparse.csr_array, fixed: Array, right: Array | float
) -> Array:
    """Unknown blocks (n, k, 3) of `matrix` x = `right`, the anchors' set to those of `fixed`."""
    n, k, _ = fixed.shape
    solved = np.array(fixed, order="C")
    at_anchor = np.zeros((n, k), dtype=bool)
    at_anchor[graph.anchors] = True
    anchor, free = np.flatnonzero(at_anchor), np.flatnonzero(~at_anchor)
    if not len(free):
        return solved
    known = matrix[free][:, anchor] @ solved.reshape(-1, 3)[anchor]
    goal = np.broadcast_to(right, solved.shape).reshape(-1, 3)[free] - known
    system = matrix[free][:, free].tocsr()
    # Poses that no displacement determines stay solvable: a little weight on zero.
    little = 1e-12 * system.diagonal().max() or 1.0
    system += sparse.diags_array(np.full(len(free), little))
    solved.reshape(-1, 3)[free] = linear.solve(system.tocsr(), goal)
    return solved
