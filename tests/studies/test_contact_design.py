"""Optimal design of contacts and its lower bound."""

from dataclasses import replace

import contact_design
import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.uncertainty import metrics
from meshskin.estimation.uncertainty.observability import mean_distance
from meshskin.geometry.region import Cap


@pytest.fixture(scope="module")
def scene():
    """Seven taxels on the ellipsoid, E* known."""
    whole = ms.Scene.load("ellipsoid")
    skin = ms.Skin.cover(whole.body, count=7, spacing=5e-3, region=Cap((0.0, -1.0, 0.0)))
    return whole.with_(skin=skin)


@pytest.fixture(scope="module")
def belief(scene):
    return scene.belief(unknown=())


@pytest.fixture(scope="module")
def found(scene, belief):
    return contact_design.optimal_design(belief, scene.skin.positions, 6e-3)


def test_the_expected_error_is_that_of_the_cramer_rao_bound(scene, belief):
    rng = np.random.default_rng(0)
    taxels = scene.skin.positions
    points = taxels[rng.integers(0, 7, 60)] + rng.uniform(-4e-3, 4e-3, (60, 3))
    recording = ms.press(scene, points)
    bound = metrics.cramer_rao(recording, belief, scene.skin)
    told = contact_design.expected_error(belief, taxels, recording.points)
    assert told == pytest.approx(bound.mean, rel=2e-3)


def test_the_slope_is_that_of_the_mean_error():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 2, 2))
    total = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2)
    total[0] = np.eye(2) * 3.0  # round: the elliptic integrals' limit
    value, slope = contact_design.mean_error(total)
    assert value == pytest.approx(mean_distance(np.linalg.inv(total)).mean())
    for _ in range(5):
        way = rng.normal(size=(5, 2, 2))
        way = 1e-5 * (way + np.swapaxes(way, 1, 2))
        ahead, behind = (
            mean_distance(np.linalg.inv(total + sign * way)).mean() for sign in (1, -1)
        )
        assert -np.sum(slope * way) == pytest.approx((ahead - behind) / 2, rel=1e-6)


@pytest.mark.deep
def test_the_bound_is_met_and_no_design_is_below_it(scene, belief, found):
    taxels = scene.skin.positions
    assert found.weights.sum() == pytest.approx(1.0)
    assert found.error * (1 - 2 * contact_design.GAP) < found.bound <= found.error
    told = contact_design.information(belief, taxels, found.points)
    assert contact_design.mean_error(told.total(found.weights))[0] == pytest.approx(found.error)
    rng = np.random.default_rng(2)
    for _ in range(20):  # drawn from the best one, and blind
        drawn = found.points[rng.choice(len(found.points), 200, p=found.weights)]
        blind = taxels[rng.integers(0, 7, 200)] + rng.uniform(-4e-3, 4e-3, (200, 3))
        near, far = (
            contact_design.expected_error(belief, taxels, points) * np.sqrt(200)
            for points in (drawn, blind)
        )
        assert found.bound < near < 1.15 * found.bound
        assert far > 1.05 * found.bound


def test_the_best_weights_are_those_of_a_general_solver(scene, belief):
    """The same convex problem over few places, by sequential quadratic programming."""
    from scipy.optimize import minimize

    taxels = scene.skin.positions[:3]
    rng = np.random.default_rng(3)
    places = taxels[rng.integers(0, 3, 24)] + rng.uniform(-4e-3, 4e-3, (24, 3))
    told = contact_design.information(belief, taxels, places)
    mine = contact_design.optimal_weights(told, np.full(24, 1.0 / 24))

    def error(weights):
        return 1e3 * mean_distance(np.linalg.inv(told.total(weights))).mean()

    theirs = minimize(
        error, np.full(24, 1.0 / 24), bounds=[(0, 1)] * 24, method="SLSQP", tol=1e-12,
        constraints={"type": "eq", "fun": lambda weights: weights.sum() - 1.0},
    )  # fmt: skip
    assert theirs.success
    assert 1e3 * mine[1] == pytest.approx(theirs.fun, rel=contact_design.GAP)


def test_taxels_that_no_contact_determines_are_refused(scene, belief):
    deaf = replace(belief, threshold=1e9)
    with pytest.raises(CalibrationError, match="no contact determines"):
        contact_design.optimal_design(deaf, scene.skin.positions, 6e-3)
