"""Marginal covariances: against the dense inverse, and against the spread of many seeds."""

import numpy as np
import pytest
from scipy import sparse

from meshskin.core import se3
from meshskin.estimation.posegraph import PoseGraph
from meshskin.estimation.posegraph.cholesky import Cholesky
from meshskin.estimation.posegraph.symmetric_blocks import SymmetricBlocks


def spd(n, links, rng):
    """Random positive definite matrix (6 n, 6 n) with blocks where poses are linked."""
    matrix = np.zeros((n, 6, n, 6))
    for i, j in links:
        jacobian = rng.normal(size=(6, 12))
        block = (jacobian.T @ jacobian).reshape(2, 6, 2, 6)
        for a, p in enumerate((i, j)):
            for b, q in enumerate((i, j)):
                matrix[p, :, q, :] += block[a, :, b, :]
    return matrix.reshape(6 * n, 6 * n) + 1e-2 * np.eye(6 * n)


def test_marginals_of_a_matrix_equal_the_dense_inverse():
    rng, n = np.random.default_rng(0), 40
    links = [tuple(rng.choice(n, 2, replace=False)) for _ in range(120)]
    dense = spd(n, links, rng)
    inverse = np.linalg.inv(dense).reshape(n, 6, n, 6)
    each = np.arange(n)
    blocks = SymmetricBlocks.from_lower_triangle(sparse.csr_array(np.tril(dense)), 6)
    found = Cholesky(n, blocks.rows, blocks.columns).marginal_covariances(blocks)
    assert np.allclose(found, inverse[each, :, each, :], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_covariances_are_those_of_many_seeds(skin_graph):
    """Isotropic noise: the squared error, whitened by the covariance, is chi-square."""
    count, seeds, sigma = 20, 60, (1e-3, 0.02)
    nees = []
    for seed in range(seeds):
        graph, truth = skin_graph(count, seed=seed, sigma=sigma)
        solution = graph.solve()
        covariances = solution.covariances()
        assert np.array_equal(covariances[0], np.zeros((6, 6)))
        miss = se3.inverse(truth[1:]) @ solution.poses[1:]
        error = np.concatenate([miss[:, :3, 3], se3.log_so3(miss[:, :3, :3])], axis=1)
        nees.append(np.einsum("ia,iab,ib->i", error, np.linalg.inv(covariances[1:]), error))
    # Six degrees of freedom a pose. The poses of a seed are correlated, so seeds are compared.
    means = np.mean(nees, axis=1)
    assert abs(means.mean() - 6.0) < 4 * means.std() / np.sqrt(seeds)
    assert 5.0 < means.mean() < 7.0


def test_undetermined_degree_of_freedom_has_infinite_variance(skin_graph):
    """The last pose hangs on one displacement that says nothing about its rotation about z."""
    graph, _ = skin_graph(10)
    information = np.concatenate([graph.information, graph.information[:1]])
    information[-1, 5, :] = information[-1, :, 5] = 0.0
    measured = np.concatenate([graph.measurements, graph.measurements[:1]])
    poses = np.concatenate([graph.poses, graph.poses[:1] @ measured[-1:]])
    hanging = PoseGraph(poses, np.concatenate([graph.edges, [[0, 10]]]), measured, information)
    solution = hanging.solve()
    covariances = solution.covariances()
    assert solution.is_optimal
    assert solution.undetermined == ((10, "rz"),)
    assert np.isinf(covariances[10, 5, 5])
    assert np.isfinite(np.delete(np.diagonal(covariances[10]), 5)).all()
    assert np.isfinite(covariances[:10]).all()
    reference = graph.solve().covariances()
    assert np.allclose(covariances[:10], reference, rtol=1e-3, atol=1e-12)
