"""Solving: published optima, every start, optimality, disconnected graphs."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import GraphError, UnknownNameError
from meshskin.estimation.posegraph import PoseGraph

from ...real_data import DATA

OPTIMA = {  # file: certified optimum, cost of the chordal start (see the data's README)
    "tinyGrid3D": (18.51936642, 28.6765),
    "smallGrid3D": (1025.398056, 1561.38),
    "sphere2500": (1687.005814, 1971.18),
    "torus3D": (24227.04556, 24669.2),
}


def standard(name):
    path = DATA / "g2o" / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"needs the g2o benchmark {name}.g2o, not found at {path}")
    return PoseGraph.load(path)


def cost(graph, poses, objective):
    """The objective, from its definition."""
    i, j = graph.edges.T
    step = se3.inverse(poses[i]) @ poses[j]
    shift = step[:, :3, 3] - graph.measurements[:, :3, 3]
    if objective == "chordal":
        tau = 3 / np.trace(np.linalg.inv(graph.information[:, :3, :3]), axis1=1, axis2=2)
        kappa = 1.5 / np.trace(np.linalg.inv(graph.information[:, 3:, 3:]), axis1=1, axis2=2)
        turn = np.sum((step[:, :3, :3] - graph.measurements[:, :3, :3]) ** 2, axis=(1, 2))
        return float(kappa @ turn + tau @ np.sum(shift**2, axis=1))
    missed = np.swapaxes(graph.measurements[:, :3, :3], 1, 2) @ step[:, :3, :3]
    e = np.concatenate([shift, se3.log_so3(missed)], axis=1)
    return 0.5 * float(np.einsum("ea,eab,eb->", e, graph.information, e))


@pytest.mark.deep
@pytest.mark.parametrize("name", OPTIMA)
def test_certified_optima(name):
    graph = standard(name)
    solution = graph.solve(objective="chordal")
    optimum, _ = OPTIMA[name]
    assert solution.is_optimal
    assert abs(solution.cost / optimum - 1) < 1e-6
    assert solution.certificate.certified
    assert np.isclose(solution.cost, cost(graph, solution.poses, "chordal"), rtol=1e-9)


@pytest.mark.deep
@pytest.mark.parametrize("name", OPTIMA)
def test_chordal_start_is_the_published_one(name):
    from meshskin.estimation.posegraph.start import chordal

    graph = standard(name)
    assert abs(cost(graph, chordal(graph), "chordal") / OPTIMA[name][1] - 1) < 1e-5


@pytest.mark.parametrize("objective", ["geodesic", "chordal"])
@pytest.mark.parametrize("start", ["tree", "origin", "truth"])
def test_every_start_finds_the_same_poses(skin_graph, objective, start):
    graph, truth = skin_graph(80, seed=3)
    reference = graph.solve(objective)
    other = graph.solve(objective, truth if start == "truth" else start)
    assert reference.is_optimal
    assert other.is_optimal
    assert np.isclose(reference.cost, cost(graph, reference.poses, objective), rtol=1e-9)
    assert np.isclose(other.cost, reference.cost, rtol=1e-7)
    assert np.allclose(other.poses, reference.poses, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_origin_start_on_the_papers_task(skin_graph, seed):
    graph, truth = skin_graph(80, seed=seed)
    solution = graph.solve(start="origin", keep_iterates=True)
    assert solution.is_optimal
    assert np.isclose(solution.cost, graph.solve().cost, rtol=1e-7)
    error = np.linalg.norm(solution.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert error.mean() < 3e-3
    assert np.allclose(solution.iterates[0], truth[0])
    assert np.array_equal(solution.iterates[-1], solution.poses)
    assert len(solution.iterates) == solution.iterations + 1


def test_without_a_compiler_the_result_is_the_same(skin_graph, monkeypatch):
    from meshskin.core import codegen
    from meshskin.estimation.posegraph import cholesky, edge_assembly, problem

    fast = skin_graph(40, seed=1)[0].solve()
    edge_assembly.library.cache_clear()
    cholesky.library.cache_clear()
    codegen._warn_once.cache_clear()
    monkeypatch.setattr(problem, "topology_cache", problem.TopologyCache(1))
    monkeypatch.setenv("MESHSKIN_COMPILER", "none")
    with pytest.warns(RuntimeWarning, match="interpreted"):
        slow = skin_graph(40, seed=1)[0].solve()
    edge_assembly.library.cache_clear()
    cholesky.library.cache_clear()
    assert slow.iterations == fast.iterations
    assert np.allclose(slow.poses, fast.poses, atol=1e-12)


def test_a_topology_is_built_once(skin_graph, monkeypatch):
    from meshskin.estimation.posegraph import problem

    monkeypatch.setattr(problem, "topology_cache", problem.TopologyCache(edges=1000))
    graphs = [skin_graph(40, seed=s)[0] for s in range(2)]
    other = skin_graph(50)[0]
    assert graphs[0].problem("log") is graphs[1].problem("log")
    assert graphs[0].problem("log") is not graphs[0].problem("vec")
    assert graphs[0].problem("log") is not other.problem("log")
    first = graphs[0].problem("log")
    assert [g.solve().is_optimal for g in graphs] == [True, True]
    for count in range(60, 80):  # dropped once newer ones fill the cache
        skin_graph(count)[0].problem("log")
    assert graphs[0].problem("log") is not first


def test_units_change_nothing(skin_graph):
    metres, _ = skin_graph(60, seed=2)
    millimetres = metres.measurements.copy(), metres.poses.copy(), metres.information.copy()
    millimetres[0][:, :3, 3] *= 1e3
    millimetres[1][:, :3, 3] *= 1e3
    millimetres[2][:, :3, :3] *= 1e-6
    a = metres.solve()
    b = PoseGraph(millimetres[1], metres.edges, millimetres[0], millimetres[2]).solve()
    c = PoseGraph(
        metres.poses, metres.edges, metres.measurements, 1e-9 * metres.information
    ).solve()
    assert a.iterations == b.iterations == c.iterations
    assert np.isclose(a.cost, b.cost, rtol=1e-8)
    assert np.isclose(1e-9 * a.cost, c.cost, rtol=1e-8)
    assert np.allclose(a.poses[:, :3, 3], 1e-3 * b.poses[:, :3, 3], atol=1e-9)


def test_without_noise_the_truth_is_found(skin_graph, skin_poses):
    truth = skin_poses(60, np.random.default_rng(5))
    graph, _ = skin_graph(poses=truth, sigma=(1e-30, 1e-30))
    graph = PoseGraph(graph.poses, graph.edges, graph.measurements, np.eye(6))
    for start in ("chordal", "tree", "origin"):
        solution = graph.solve(start=start)
        assert solution.is_optimal
        assert np.allclose(solution.poses, truth, atol=1e-9)


def test_components_are_anchored_one_by_one(skin_graph):
    a, _ = skin_graph(30, seed=1)
    b, _ = skin_graph(20, seed=2)
    isolated = np.eye(4)[None]
    both = PoseGraph(
        np.concatenate([a.poses, isolated, b.poses]),
        np.concatenate([a.edges, b.edges + 31]),
        np.concatenate([a.measurements, b.measurements]),
        np.concatenate([a.information, b.information]),
    )
    assert both.anchors.tolist() == [0, 30, 31]
    solution = both.solve()
    assert solution.is_optimal
    assert np.allclose(solution.poses[:30], a.solve().poses, atol=1e-6)
    assert np.array_equal(solution.poses[30], isolated[0])
    assert np.allclose(solution.poses[31:], b.solve().poses, atol=1e-6)
    assert np.allclose(both.solve(start="tree").poses, solution.poses, atol=1e-6)


def test_given_poses_elsewhere_start_at_the_anchor(skin_graph):
    graph, _ = skin_graph(30, seed=1)
    moved = se3.transform(se3.exp_so3(np.array([0.3, -2.0, 1.0])), np.array([0.1, 5.0, -1.0]))
    usual = graph.solve()
    solution = graph.solve(start=moved @ usual.poses)
    assert np.array_equal(solution.poses[0], graph.poses[0])
    assert np.allclose(solution.poses, usual.poses, atol=1e-6)
    assert solution.iterations <= 1


def test_edges_both_ways_and_twice(skin_graph):
    graph, _ = skin_graph(30, seed=4)
    i, j = graph.edges.T
    doubled = PoseGraph(
        graph.poses,
        np.concatenate([graph.edges, np.stack([j, i], axis=1), graph.edges]),
        np.concatenate([graph.measurements, se3.inverse(graph.measurements), graph.measurements]),
        np.eye(6),
    )
    solution = doubled.solve("chordal")
    assert solution.is_optimal
    assert np.isclose(solution.cost, cost(doubled, solution.poses, "chordal"), rtol=1e-9)


def test_singular_information_is_accepted(skin_graph):
    graph, truth = skin_graph(60, seed=6, sigma=(1e-5, 1e-4))
    information = graph.information.copy()
    information[::2, 3:, :] = information[::2, :, 3:] = 0.0  # every second edge: position only
    information[1::2, 0, :] = information[1::2, :, 0] = 0.0  # the others: nothing along x
    singular = PoseGraph(graph.poses, graph.edges, graph.measurements, information)
    solution = singular.solve()
    assert solution.is_optimal
    assert np.isclose(solution.cost, cost(singular, solution.poses, "geodesic"), rtol=1e-8)
    assert np.allclose(solution.poses[:, :3, 3], truth[:, :3, 3], atol=2e-4)


def test_one_pose_and_no_edges():
    graph = PoseGraph(np.eye(4)[None], np.empty((0, 2)), np.empty((0, 4, 4)), np.empty((0, 6, 6)))
    for start in ("chordal", "tree", "origin"):
        solution = graph.solve(start=start)
        assert solution.is_optimal
        assert solution.cost == 0.0
        assert np.array_equal(solution.poses, graph.poses)


def test_unknown_names(skin_graph):
    graph, _ = skin_graph(10)
    with pytest.raises(UnknownNameError, match="did you mean chordal"):
        graph.solve(start="cordal")
    with pytest.raises(UnknownNameError, match="did you mean geodesic"):
        graph.solve("geodesics")
    with pytest.raises(GraphError, match="start poses"):
        graph.solve(start=graph.poses[:-1])
    start = graph.poses.copy()
    start[4, 0, 3] = np.nan
    with pytest.raises(GraphError, match="start poses must be finite, got row 4"):
        graph.solve(start=start)
    for limit in (0, 2.5, True):
        with pytest.raises(GraphError, match="limit of iterations"):
            graph.solve(limit=limit)
