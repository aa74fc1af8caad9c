"""Marginal covariances: against the dense inverse, and against the spread of many seeds."""

import numpy as np
import pytest
from scipy import sparse

from meshskin import se3
from meshskin.estimation.posegraph import PoseGraph, linear, marginals, ordering


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


@pytest.mark.parametrize("kind", ["chain", "star", "grid", "random", "apart", "single"])
def test_selected_inverse_equals_dense(kind):
    rng, n = np.random.default_rng(0), 40
    links = {
        "chain": [(k, k + 1) for k in range(n - 1)],
        "star": [(0, k) for k in range(1, n)],
        "grid": [(k, k + 1) for k in range(n - 1) if (k + 1) % 8] + [(k, k + 8) for k in range(32)],
        "random": [tuple(rng.choice(n, 2, replace=False)) for _ in range(120)],
        "apart": [(k, k + 1) for k in range(19)] + [(k, k + 1) for k in range(22, n - 1)],
        "single": [],
    }[kind]
    n = 1 if kind == "single" else n
    dense = spd(n, links, rng)
    blocks = marginals.diagonal_of_inverse(sparse.csr_array(dense))
    inverse = np.linalg.inv(dense).reshape(n, 6, n, 6)
    each = np.arange(n)
    assert np.allclose(blocks, inverse[each, :, each, :], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("metis", [True, False])
def test_orders_of_elimination(metis, monkeypatch):
    if not metis:
        monkeypatch.setattr(ordering, "_metis", lambda: None)
    elif ordering._metis() is None:
        pytest.skip("no METIS 4 beside this CasADi")
    n, side = 400, 20
    links = [(k, k + 1) for k in range(n - 1) if (k + 1) % side]
    links += [(k, k + side) for k in range(n - side)]
    matrix = sparse.csr_array(spd(n, links, np.random.default_rng(2)))
    order = ordering.elimination_order(matrix, 6)
    assert np.array_equal(np.sort(order), np.arange(n))
    scalar = (6 * order[:, None] + np.arange(6)).ravel()
    fill = [linear.factorise(m, "NATURAL").L.nnz for m in (matrix[scalar][:, scalar], matrix)]
    assert fill[0] < 0.7 * fill[1]


def test_indefinite_matrix_is_refused():
    matrix = spd(10, [(k, k + 1) for k in range(9)], np.random.default_rng(1))
    matrix[7, 7] = -1.0
    with pytest.raises(marginals.SingularError):
        marginals.diagonal_of_inverse(sparse.csr_array(matrix))


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
    assert np.isinf(covariances[10, 5, 5])
    assert np.isfinite(np.delete(np.diagonal(covariances[10]), 5)).all()
    assert np.isfinite(covariances[:10]).all()
    reference = graph.solve().covariances()
    assert np.allclose(covariances[:10], reference, rtol=1e-3, atol=1e-12)
