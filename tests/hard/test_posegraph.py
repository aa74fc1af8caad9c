"""Hard pose graphs: a right answer with its uncertainty, or an error with a remedy."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshskin.core import se3
from meshskin.core.errors import GraphError
from meshskin.estimation.posegraph import PoseGraph, problem, start

SIGMA = np.repeat([1e-4, 0.02], 3)


def measured(truth, edges, sigma, seed=0):
    """Displacements (m, 4, 4) with local deviations `sigma` (6,)."""
    rng = np.random.default_rng(seed)
    noise = sigma * rng.normal(size=(len(edges), 6))
    steps = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    steps[:, :3, 3] += noise[:, :3]
    steps[:, :3, :3] = steps[:, :3, :3] @ se3.exp_so3(noise[:, 3:])
    return steps


def skin(count=60, sigma=SIGMA, seed=0):
    """Taxels on a sphere of 30 mm, displacements to neighbours; the graph and the true poses."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, k * np.pi * (3 - np.sqrt(5))
    normals = np.stack([*(np.sqrt(1 - z**2) * [np.cos(angle), np.sin(angle)]), z], axis=1)
    tangents = np.cross(np.random.default_rng(seed).normal(size=(count, 3)), normals)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    rotations = np.stack([tangents, np.cross(normals, tangents), normals], axis=2)
    truth = se3.transform(rotations, 0.03 * normals)
    edges = cKDTree(normals).query_pairs(0.9, output_type="ndarray")
    return PoseGraph(truth, edges, measured(truth, edges, sigma, seed), np.diag(sigma**-2)), truth


def error(solution, truth):
    """Distances (n,) of the poses from the true ones, m."""
    return np.linalg.norm(solution.poses[:, :3, 3] - truth[:, :3, 3], axis=1)


def whitened(solution, truth):
    """Mean chi-square of the free poses' errors by their covariances: 6 if these are right."""
    miss = se3.inverse(truth[1:]) @ solution.poses[1:]
    e = np.concatenate([miss[:, :3, 3], se3.log_so3(miss[:, :3, :3])], axis=1)
    return np.einsum("ia,iab,ib->i", e, np.linalg.inv(solution.covariances()[1:]), e).mean()


@pytest.mark.parametrize("off", [0.0, 1e-12, 1e-6, 1e-2])
@pytest.mark.parametrize("start", ["chordal", "tree", "origin"])
def test_rotations_at_and_near_pi(off, start):
    """Every displacement rotates by pi, or nearly, where Log is discontinuous."""
    count = 24
    axes = np.random.default_rng(1).normal(size=(count, 3))
    axes *= (np.pi - off) / np.linalg.norm(axes, axis=1)[:, None]
    steps = se3.transform(
        se3.exp_so3(axes), 0.01 * np.random.default_rng(2).normal(size=(count, 3))
    )
    truth = [np.eye(4)]
    for step in steps[:-1]:
        truth.append(truth[-1] @ step)
    truth = np.array(truth)
    edges = np.array([(k, k + s) for s in (1, 2, 3) for k in range(count - s)])
    graph = PoseGraph(truth, edges, measured(truth, edges, SIGMA), np.diag(SIGMA**-2))
    solution = graph.solve(start=start, certify=True)
    assert solution.is_optimal
    assert solution.certificate.certified
    assert 2.0 < whitened(solution, truth) < 14.0


@pytest.mark.parametrize("about", [0, 1, 2])
@pytest.mark.parametrize("objective", ["geodesic", "chordal"])
def test_eight_poses_flipped(about, objective):
    graph, truth = skin()
    start = truth.copy()
    turn = np.zeros(3)
    turn[about] = np.pi
    start[5:13, :3, :3] = start[5:13, :3, :3] @ se3.exp_so3(turn)
    solution = graph.solve(objective, start, certify=True)
    assert solution.is_optimal
    assert solution.certificate.certified
    assert np.isclose(solution.cost, graph.solve(objective).cost, rtol=1e-6)
    assert error(solution, truth).max() < 1e-3


def winding_ring(count=20):
    """A ring of equal orientations, and a start that winds around once: a local minimum."""
    truth = np.tile(np.eye(4), (count, 1, 1))
    edges = np.array([(k, (k + 1) % count) for k in range(count)])
    graph = PoseGraph(truth, edges, measured(truth, edges, 1e-3 * np.ones(6)), np.eye(6))
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None] * [0, 0, 1.0]
    return graph, se3.transform(se3.exp_so3(angles), np.zeros(3))


def test_a_local_minimum_is_not_certified_and_certify_leaves_it():
    graph, start = winding_ring()
    stuck = graph.solve("chordal", start)
    assert stuck.is_optimal
    assert not stuck.certificate.certified
    assert str(stuck.certificate).startswith("not certified")
    freed = graph.solve("chordal", start, certify=True)
    assert freed.certificate.certified
    assert freed.cost < 1e-3 * stuck.cost
    bound = stuck.certificate.cost - stuck.certificate.gap
    assert bound <= freed.certificate.cost * (1 + 1e-9)


@pytest.mark.deep
def test_a_relaxation_that_is_not_tight_is_not_certified():
    """Rotations that are nearly random: the relaxation is not tight."""
    certified = []
    for seed in range(6):
        graph, _ = skin(30, np.repeat([1e-4, 2.5], 3), seed)
        solution = graph.solve("chordal", "tree", certify=True)
        proof = solution.certificate
        certified.append(proof.certified)
        assert proof.certified == (proof.gap <= proof.limit)
        assert str(proof).startswith("certified" if proof.certified else "not certified")
        assert 0.0 <= proof.gap <= proof.cost
    assert not all(certified)


def test_disconnected_graph():
    a, true_a = skin(30, seed=1)
    b, true_b = skin(20, seed=2)
    shift = se3.transform(se3.exp_so3([0.3, 0.2, -1.0]), [1.0, 2.0, 3.0])
    both = PoseGraph(
        np.concatenate([a.poses, shift @ b.poses]),
        np.concatenate([a.edges, b.edges + 30]),
        np.concatenate([a.measurements, b.measurements]),
        np.concatenate([a.information, b.information]),
    )
    solution = both.solve()
    assert solution.is_optimal
    assert solution.certificate.certified
    assert both.anchors.tolist() == [0, 30]
    covariances = solution.covariances()
    assert np.allclose(covariances[[0, 30]], 0.0)
    assert np.allclose(covariances[:30], a.solve().covariances(), rtol=1e-4, atol=1e-14)
    assert error(solution, np.concatenate([true_a, shift @ true_b])).max() < 1e-3


def test_no_anchor():
    """Displacements do not determine the gauge: the first pose stays where it was given."""
    graph, _ = skin(30)
    move = se3.transform(se3.exp_so3([1.0, -0.5, 2.0]), [5.0, -3.0, 1.0])
    moved = PoseGraph(move @ graph.poses, graph.edges, graph.measurements, graph.information)
    here, there = graph.solve(), moved.solve()
    assert np.array_equal(there.poses[0], moved.poses[0])
    assert np.allclose(move @ here.poses, there.poses, atol=1e-7)
    assert np.allclose(here.covariances(), there.covariances(), rtol=1e-3, atol=1e-12)
    assert here.undetermined == there.undetermined == ()


@pytest.mark.parametrize("start", ["chordal", "tree", "origin"])
def test_position_only_edges(start):
    """No rotation is measured; the rotations of the measurements are wrong."""
    graph, truth = skin(sigma=np.repeat([1e-5, 0.02], 3))
    i, j = graph.edges.T
    both = np.concatenate([graph.edges, np.stack([j, i], axis=1)])
    steps = measured(truth, both, np.repeat([1e-5, 0.0], 3))
    steps[:, :3, :3] = np.eye(3)
    information = np.diag(np.repeat([1e10, 0.0], 3))
    solution = PoseGraph(graph.poses, both, steps, information).solve(start=start, certify=True)
    assert solution.is_optimal
    assert solution.undetermined == ()
    assert error(solution, truth).max() < 1e-4
    assert 1.5 < whitened(solution, truth) < 14.0  # one sample: the poses are correlated


def test_information_of_condition_1e12():
    graph, truth = skin(30)
    rng = np.random.default_rng(3)
    vectors = np.linalg.qr(rng.normal(size=(len(graph.edges), 6, 6)))[0]
    values = np.logspace(-2, 10, 6)
    information = (vectors * values) @ np.swapaxes(vectors, 1, 2)
    noise = np.einsum("mab,mb->ma", vectors * values**-0.5, rng.normal(size=(len(vectors), 6)))
    noise *= 1e-2  # else the weakest directions turn by many radians
    steps = se3.inverse(truth[graph.edges[:, 0]]) @ truth[graph.edges[:, 1]]
    steps[:, :3, 3] += noise[:, :3]
    steps[:, :3, :3] = steps[:, :3, :3] @ se3.exp_so3(noise[:, 3:])
    graph = PoseGraph(truth, graph.edges, steps, 1e4 * information)
    solution = graph.solve(start=truth)
    assert solution.is_optimal
    assert solution.undetermined == ()
    assert 3.0 < whitened(solution, truth) < 12.0


@pytest.fixture
def fresh_problems(monkeypatch):
    """An empty cache: problems built in a test are not used by others."""
    monkeypatch.setattr(problem, "topology_cache", problem.TopologyCache(1))


def test_ipopt_in_restoration_failure(fresh_problems, monkeypatch):
    monkeypatch.setitem(problem.IPOPT_OPTIONS, "start_with_resto", "yes")
    graph, _ = skin(30)
    solution = graph.solve()
    assert solution.solver_status != "Solve_Succeeded"
    assert not solution.is_optimal
    assert f"IPOPT: {solution.solver_status}" in solution.status
    assert "start from 'chordal'" in solution.status
    assert np.isfinite(solution.poses).all()


def test_iteration_limit_of_1():
    graph, truth = skin()
    start = truth.copy()
    start[1:] = start[1:] @ se3.transform(se3.exp_so3([0.3, 0.3, 0.3]), [2e-3, 0, 0])
    solution = graph.solve(start=start, limit=1)
    assert solution.iterations == 1
    assert not solution.is_optimal
    assert "allow more iterations" in solution.status
    assert graph.solve(start=start).is_optimal
    assert graph.solve(start="origin", limit=1, robust="gnc").iterations == 1


@pytest.mark.parametrize("spread", [1e3, 1e8, 1e14])
def test_weights_far_apart(spread):
    """Two parts of strong displacements, joined by weak ones only."""
    graph, truth = skin(30)
    i, j = graph.edges.T
    between = (i < 15) != (j < 15)
    information = graph.information.copy()
    information[~between] *= spread
    solution = PoseGraph(graph.poses, graph.edges, graph.measurements, information).solve()
    assert solution.is_optimal
    assert error(solution, truth).max() < 1e-3


def test_a_chordal_start_that_cannot_be_computed_is_an_error(monkeypatch):
    monkeypatch.setattr(start, "REGULARIZATION", -1.0)
    graph, _ = skin(30)
    with pytest.raises(GraphError, match=r"weights too far apart.*start from 'tree'"):
        graph.solve()
    assert graph.solve(start="tree").is_optimal


def test_numbers_too_large_to_compute_with():
    graph, _ = skin(30)
    parts = graph.poses, graph.edges, graph.measurements
    with pytest.raises(GraphError, match=r"too large .* scale all information matrices down"):
        PoseGraph(*parts, 1e308 * np.eye(6))
    far = graph.measurements.copy()
    far[:, :3, 3] *= 1e120
    with pytest.raises(GraphError, match="the cost must be finite"):
        PoseGraph(graph.poses, graph.edges, far, 1e100 * np.eye(6)).solve(start="tree")
