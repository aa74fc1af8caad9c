"""The gauge: alignment of connected parts, and the covariance after it."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.estimation.posegraph import PoseGraph
from meshskin.estimation.posegraph.symmetric_blocks import _scalar_matrix
from meshskin.estimation.uncertainty import gauge


@pytest.fixture
def graph():
    """Two parts, of 7 and 4 poses, and one pose alone."""
    rng = np.random.default_rng(0)
    poses = se3.transform(se3.exp_so3(rng.normal(size=(12, 3))), rng.normal(size=(12, 3)))
    edges = [(a, b) for a in range(7) for b in range(a + 1, 7) if (a + b) % 3]
    edges = np.array([*edges, (7, 8), (8, 9), (9, 10), (7, 10)])
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    root = rng.normal(size=(len(edges), 6, 6))
    return PoseGraph(poses, edges, measured, root @ np.swapaxes(root, 1, 2) + np.eye(6))


def information(graph):
    """(72, 72)."""
    return _scalar_matrix(gauge.information(graph, graph.poses, "geodesic"), 12).toarray()


def test_alignment_part_by_part(graph):
    moved = graph.poses.copy()
    moved[:7] = se3.transform(se3.exp_so3([0.3, -0.2, 0.5]), [1, 2, 3]) @ moved[:7]
    moved[7:11] = se3.transform(se3.exp_so3([1.0, 0.0, 0.0]), [0, 0, 1]) @ moved[7:11]
    back, linked = gauge.aligned(graph, moved)
    assert linked.tolist() == [True] * 11 + [False]
    assert np.allclose(back[:11], graph.poses[:11])
    heap = np.tile(np.eye(4), (12, 1, 1))
    back, _ = gauge.aligned(graph, heap)
    assert np.allclose(back[:7, :3, 3], graph.poses[:7, :3, 3].mean(axis=0))


def test_covariance_against_linearized_alignment(graph):
    told = gauge.covariances(graph, graph.poses)
    assert np.isinf(np.diag(told[11])).all()
    rows, free = np.arange(7), np.arange(6, 42)
    inner = information(graph)[:42, :42]
    s = np.zeros((42, 42))
    s[np.ix_(free, free)] = np.linalg.inv(inner[np.ix_(free, free)])
    # The alignment, linearized by finite differences of `aligned` itself.
    step, projector = 1e-5, np.zeros((42, 42))
    for k in range(42):
        shift = np.zeros((7, 6))
        shift.flat[k] = step
        moved = graph.poses.copy()
        moved[rows] = moved[rows] @ se3.transform(se3.exp_so3(shift[:, 3:]), shift[:, :3])
        back, _ = gauge.aligned(graph, moved)
        local = se3.inverse(graph.poses[rows]) @ back[rows]
        log = np.concatenate([local[:, :3, 3], se3.log_so3(local[:, :3, :3])], axis=1)
        projector[:, k] = log.ravel() / step
    full = projector @ s @ projector.T
    blocks = full.reshape(7, 6, 7, 6)[rows, :, rows]
    assert np.allclose(told[:7], blocks, atol=2e-3 * np.abs(blocks).max())


def test_correlated_errors_increase_the_covariance(graph):
    rng, told = np.random.default_rng(2), gauge.covariances(graph, graph.poses)
    root = np.linalg.cholesky(np.linalg.inv(graph.information))
    apart = root @ rng.normal(size=(len(graph.edges), 6, 4000))
    found = gauge.covariances(graph, graph.poses, apart)
    assert np.allclose(found[:7], told[:7], rtol=0.05)  # independent, as S takes them
    together = 3.0 * apart
    wide = gauge.covariances(graph, graph.poses, together)
    assert np.allclose(wide[:7], told[:7] * 9, rtol=0.05)
    assert np.isinf(np.diag(wide[11])).all()
    narrow = gauge.covariances(graph, graph.poses, 0.1 * apart)
    assert np.array_equal(narrow[:11], told[:11])  # never less than the information says


def test_information_is_the_curvature_of_the_cost(graph):
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(12, 6))
    direction[graph.anchors] = 0.0

    def cost(h):
        poses = graph.poses @ se3.transform(se3.exp_so3(h * direction[:, 3:]), h * direction[:, :3])
        i, j = graph.edges.T
        relative = se3.inverse(poses[i]) @ poses[j]
        turned = np.swapaxes(graph.measurements[:, :3, :3], 1, 2) @ relative[:, :3, :3]
        shift = relative[:, :3, 3] - graph.measurements[:, :3, 3]
        e = np.concatenate([shift, se3.log_so3(turned)], axis=1)
        return np.einsum("mi,mij,mj->", e, graph.information, e) / 2

    h = 1e-4
    curvature = (cost(h) + cost(-h)) / h**2
    x = direction.ravel()
    assert x @ information(graph) @ x == pytest.approx(curvature, rel=1e-4)
