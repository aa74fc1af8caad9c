"""The certificate: tight at global optima, a valid bound everywhere."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import GraphError
from meshskin.estimation.posegraph import PoseGraph
from meshskin.estimation.posegraph.certificate import certify, is_positive_definite, quadratic_form


def test_quadratic_form_is_the_chordal_cost(skin_graph):
    graph, truth = skin_graph(20)
    x = np.concatenate([truth[:, :3, 3:], truth[:, :3, :3]], axis=2)
    x = np.swapaxes(x, 1, 2)
    i, j = graph.edges.T
    tau, kappa = graph.chordal_weights
    r, t = truth[:, :3, :3], truth[:, :3, 3]
    turn = r[j] - r[i] @ graph.measurements[:, :3, :3]
    shift = t[j] - t[i] - np.einsum("eab,eb->ea", r[i], graph.measurements[:, :3, 3])
    cost = kappa @ np.sum(turn**2, axis=(1, 2)) + tau @ np.sum(shift**2, axis=1)
    assert np.isclose(np.sum(x * (quadratic_form(graph) @ x)), cost, rtol=1e-10)


@pytest.mark.parametrize("start", ["chordal", "origin"])
def test_skin_graphs_are_certified(skin_graph, start):
    graph, _ = skin_graph(80, seed=1)
    certificate = graph.solve(start=start).certificate
    assert certificate.certified
    assert certificate.relative_gap < 1e-8
    assert np.isclose(certificate.cost, graph.solve("chordal").cost, rtol=1e-7)


def test_bound_holds_away_from_a_minimum(skin_graph):
    """Whatever poses are examined, no bound may lie above the true optimum."""
    graph, truth = skin_graph(40, seed=2)
    optimum = graph.solve("chordal").certificate.cost
    rng = np.random.default_rng(0)
    for size in (1e-8, 1e-5, 1e-2):
        turned = truth.copy()
        turned[:, :3, :3] = truth[:, :3, :3] @ se3.exp_so3(size * rng.normal(size=(40, 3)))
        certificate = certify(graph, turned)
        assert certificate.cost - certificate.gap <= optimum * (1 + 1e-9)
        assert not certificate.certified


def reduced(form):
    """A symmetric matrix (3 n, 3 n) of rotations, the free translations eliminated, dense."""
    n = form.rows.max() + 1
    dense = np.zeros((n, 4, n, 4))
    for row, column, block in zip(form.rows, form.columns, form.values, strict=True):
        dense[row, :, column] += block
        if row != column:
            dense[column, :, row] += block.T
    dense = dense.reshape(4 * n, 4 * n)[1:, 1:]  # without the anchor's translation
    rotation = np.arange(1, 4 * n) % 4 > 0
    translations, mixed = dense[np.ix_(~rotation, ~rotation)], dense[np.ix_(~rotation, rotation)]
    schur = dense[np.ix_(rotation, rotation)] - mixed.T @ np.linalg.solve(translations, mixed)
    return (schur + schur.T) / 2


@pytest.mark.parametrize("seed", range(3))
def test_gap_bounds_the_most_negative_direction(skin_graph, seed):
    """With the lowest eigenvalue -delta of S, the bound is at most tr(Lambda) - 3 n delta."""
    n = 20
    graph, _ = skin_graph(n, seed, sigma=(1e-3, 1.5))  # far from tight
    certificate = graph.solve("chordal").certificate
    x = np.swapaxes(certificate.poses[:, :3, [3, 0, 1, 2]], 1, 2)
    form = quadratic_form(graph)
    multipliers = np.zeros((n, 4, 4))
    multipliers[:, 1:, 1:] = certificate.poses[:, :3, :3].swapaxes(1, 2) @ (
        (form @ x)[:, 1:].swapaxes(1, 2)
    )
    multipliers = (multipliers + multipliers.swapaxes(1, 2)) / 2
    delta = -np.linalg.eigvalsh(reduced(form.add_diagonal(-multipliers)))[0]
    assert certificate.gap < certificate.cost
    assert certificate.gap >= 3 * n * delta


def test_gap_is_above_the_rounding_of_the_factorization(skin_graph):
    """Higham, theorem 10.3: pivots prove positivity only up to (k + 1) u of the diagonal."""
    graph, _ = skin_graph(80, sigma=(1e-6, 1e-5))
    certificate = graph.solve("chordal").certificate
    row = 4 * graph.topology.cholesky.symbolic.largest[1]
    rounding = (row + 1) * 2.0**-53 * quadratic_form(graph).diagonal(80)[:, 1:].max()
    assert certificate.gap > 3 * 80 * rounding


@pytest.mark.parametrize("off", [-1e-2, -1e-6, -1e-12, 1e-12, 1e-6, 1e-2])
def test_definiteness_against_dense_eigenvalues(skin_graph, off):
    """With shifts far below the gaps that are certified."""
    graph, _ = skin_graph(40, seed=3)
    form = quadratic_form(graph)
    bent = np.zeros((40, 4, 4))
    bent[:, 1:, 1:] = np.random.default_rng(0).normal(size=(40, 3, 3)) * 0.1 * form.values.max()
    slack = form.add_diagonal(-(bent + np.swapaxes(bent, 1, 2)))
    smallest = np.linalg.eigvalsh(reduced(slack))[0]
    assert smallest < 0.0
    largest = slack.diagonal(40)[:, 1:].max()
    assert is_positive_definite(graph, slack, off * largest - smallest) == (off > 0)


@pytest.mark.parametrize("count", [3, 20, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("objective", ["geodesic", "chordal"])
def test_exact_graphs_are_certified(skin_graph, count, objective):
    """Where all residuals are zero the cost is zero up to rounding, and never negative."""
    graph, _ = skin_graph(count, sigma=(1e-3, 0.02))
    truth = np.array(graph.poses)
    truth[:, :3, 3] += 100.0  # far from the origin: positions are rounded
    i, j = graph.edges.T
    exact = PoseGraph(truth, graph.edges, se3.inverse(truth[i]) @ truth[j], graph.information)
    certificate = exact.solve(objective).certificate
    assert certificate.certified
    assert 0.0 <= certificate.cost <= 1e-15 * graph.solve("chordal").cost
    assert "zero up to rounding" in str(certificate)


def test_rotations_alone_are_certified(skin_graph):
    """Without information about translations, the positions have no weight and no constraint."""
    graph, _ = skin_graph(30)
    information = np.array(graph.information)
    information[:, :3] = information[:, :, :3] = 0.0
    rotations = PoseGraph(graph.poses, graph.edges, graph.measurements, information)
    assert rotations.solve("chordal").certificate.certified


def test_zero_and_singular_information_are_named(skin_graph):
    graph, _ = skin_graph(10)
    arrays = graph.poses, graph.edges, graph.measurements
    for objective, message in (
        ("geodesic", "has positive information"),
        ("chordal", "of full rank"),
    ):
        for start in ("chordal", "tree", "origin"):
            with pytest.raises(GraphError, match=message):
                PoseGraph(*arrays, np.zeros((6, 6))).solve(objective, start=start)
    singular = PoseGraph(*arrays, graph.information * np.array([1, 1, 0, 1, 1, 0]))
    with pytest.raises(GraphError, match="use objective='geodesic'"):
        singular.solve("chordal")
    for solution in (singular.solve(), singular.solve(start="tree", certify=True)):
        assert solution.is_optimal
        assert not solution.certificate.certified
        assert "zero everywhere" in str(solution.certificate)
