"""Outlying displacements."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import UnknownNameError
from meshskin.estimation.posegraph import PoseGraph
from meshskin.estimation.posegraph import minimize as functions


def with_outliers(graph, share, seed=0):
    """A `share` of the displacements replaced by random ones of the skin's size."""
    rng, m = np.random.default_rng(seed), len(graph.edges)
    bad = rng.choice(m, int(share * m), replace=False)
    measured = np.array(graph.measurements)
    measured[bad] = se3.transform(
        se3.exp_so3(rng.normal(size=(len(bad), 3))), 0.02 * rng.normal(size=(len(bad), 3))
    )
    return PoseGraph(graph.poses, graph.edges, measured, graph.information), bad


def error(solution, truth):
    aligned = solution.poses[:, :3, 3] @ (t := se3.align(solution.poses[:, :3, 3], truth))[:3, :3].T
    return np.linalg.norm(aligned + t[:3, 3] - truth, axis=1).mean()


@pytest.mark.parametrize(
    ("robust", "share", "limit"), [("gnc", 0.3, 1.25), ("huber", 0.1, 1.6), ("cauchy", 0.1, 1.3)]
)
def test_outliers_hardly_matter(skin_graph, robust, share, limit):
    graph, truth = skin_graph(80, seed=1)
    spoilt, bad = with_outliers(graph, share)
    truth = truth[:, :3, 3]
    clean = error(graph.solve(), truth)
    solution = spoilt.solve(robust=robust)
    assert solution.is_optimal
    assert error(solution, truth) < limit * clean
    assert error(spoilt.solve(), truth) > 2.0 * limit * clean
    good = np.setdiff1d(np.arange(len(graph.edges)), bad)
    assert np.median(solution.weights[bad]) < 0.3
    assert np.median(solution.weights[good]) > 0.6


def test_without_outliers_little_is_lost(skin_graph):
    graph, truth = skin_graph(80, seed=2)
    clean = error(graph.solve(), truth[:, :3, 3])
    for robust in ("gnc", "huber", "cauchy"):
        solution = graph.solve(robust=robust)
        assert solution.is_optimal
        assert error(solution, truth[:, :3, 3]) < 1.2 * clean


@pytest.mark.parametrize("robust", ["gnc", "cauchy"])
def test_too_few_iterations_are_not_optimal_and_the_weights_are_those_of_the_poses(
    skin_graph, robust
):
    spoilt, _ = with_outliers(skin_graph(30, seed=1)[0], 0.1)
    ended, whole = spoilt.solve(robust=robust, limit=4), spoilt.solve(robust=robust)
    assert whole.is_optimal
    assert not ended.is_optimal
    assert "allow more iterations" in ended.status
    weighted = PoseGraph(
        spoilt.poses, spoilt.edges, spoilt.measurements,
        spoilt.information * ended.weights[:, None, None],
    )  # fmt: skip
    at_rest = weighted.solve(start=ended.poses)
    assert ended.cost == pytest.approx(at_rest.cost, rel=1e-6)


def test_unknown_name(skin_graph):
    with pytest.raises(UnknownNameError, match="did you mean huber"):
        skin_graph(10)[0].solve(robust="hubert")


@pytest.mark.parametrize(
    ("weight", "cost"),
    [
        (functions.geman_mcclure, lambda x, c: 3 * c * x / (3 * c + x)),
        (functions.huber, lambda x, c: x if x < c else 2 * np.sqrt(c * x) - c),
        (functions.cauchy, lambda x, c: c * np.log(1 + x / c)),
    ],
)
def test_weights_are_the_derivatives_of_robust_costs(weight, cost):
    """Then a fixed point of reweighting is a stationary point of the robust cost."""
    limit, h = 16.8, 1e-4
    for x in (0.1, 5.0, 16.0, 20.0, 500.0):
        slope = (cost(x + h, limit) - cost(x - h, limit)) / (2 * h)
        assert np.isclose(weight(np.array(x), np.array(limit), 3.0), slope, rtol=1e-6)
