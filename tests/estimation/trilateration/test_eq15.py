"""Eq. 15 as printed: exact for points, wrong for discs by a known amount, honest about it."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.trilateration import eq15, trilaterate
from meshskin.estimation.uncertainty.metrics import nees


def across(world, data):
    """True distances (k,), m, of the taxels from the contacts, across the normals."""
    offset = world.truth[data.taxel] - data.points[data.contact]
    along = np.einsum("ki,ki->k", offset, data.normals[data.contact])
    return np.sqrt(np.maximum(np.einsum("ki,ki->k", offset, offset) - along**2, 0.0))


@pytest.fixture(scope="module")
def points(world):
    """Readings as eq. 12 gives them at points."""
    data = gather(world.record(), world.belief())
    ratio = across(world, data) / data.radii[data.contact]
    inside = ratio < 0.999
    pressure = data.peaks[data.contact] * np.sqrt(np.maximum(1.0 - ratio**2, 0.0))
    return replace(data, pressure=pressure).select(inside)


def test_the_distance_is_that_of_the_closed_form():
    pressure = np.array([2.0, 1.0, 0.8, 0.6, 1e-9])
    found = eq15.point_distance(pressure, np.ones(5), np.full(5, 4e-3))
    assert np.allclose(found, [0.0, 0.0, 2.4e-3, 3.2e-3, 4e-3])


def test_exact_for_readings_of_points(world, points):
    fit = eq15.estimate(points)
    assert fit.found.all()
    assert np.linalg.norm(fit.points - world.truth, axis=1).max() < 1e-7


def test_wrong_for_readings_of_discs_where_chosen_circles_are_right(world):
    data = gather(world.record(), world.belief())
    r = eq15.point_distance(data.pressure, data.peaks[data.contact], data.radii[data.contact])
    wrong = r - across(world, data)
    assert 0.8e-3 < np.sqrt(np.mean(wrong**2)) < 1.1e-3
    # the disc's mean is below the peak in the middle, and above zero beyond the edge
    assert wrong[across(world, data) < 1e-3].min() > 0.5e-3
    assert wrong[across(world, data) > 5e-3].max() < -0.5e-3
    error = np.linalg.norm(eq15.estimate(data).points - world.truth, axis=1)
    assert 0.5e-3 < np.nanmedian(error) < 2e-3
    chosen = trilaterate.three_circles(data).points
    assert np.linalg.norm(chosen - world.truth, axis=1).max() < 1e-7


@pytest.mark.deep
def test_the_covariance_holds_the_error_of_the_disc(world):
    found = [
        calibrate(world.record(noise, 0.05, seed), world.belief(noise, 0.05), method="eq15")
        for noise in (0.0, 0.01) for seed in range(3)
    ]  # fmt: skip
    square = np.concatenate([nees(c, world.skin) for c in found])
    square = square[np.isfinite(square)]
    assert 0.7 < np.median(square) < 2.8  # 1.39 for errors without bias
    assert all(c.verdict.level == "DOUBT" for c in found)
    assert all("drawn at random" in c.factors[0] for c in found)


def test_the_readings_are_drawn_at_random(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    first, again = (eq15.estimate(data).points for _ in range(2))
    assert np.array_equal(first, again, equal_nan=True)
    other = eq15.estimate(data, np.random.default_rng(5)).points
    assert np.nanmedian(np.linalg.norm(first - other, axis=1)) > 0.3e-3


def test_contacts_near_a_line_are_drawn_again(world, points):
    charts = trilaterate.chart.charts_at(points.body, world.truth)
    rows = np.argsort(points.taxel, kind="stable")
    found = eq15.point_circles(points, rows, points.taxel[rows], len(points.ids))
    three = eq15.random_three(found, charts, np.random.default_rng(0))
    assert (np.bincount(three.owner) == 3).all()
    assert trilaterate.width(three, charts).min() > trilaterate.MIN_WIDTH
    lane = points.points[np.abs(points.points[:, 1]).argmin(), 1]
    line = points.select(np.abs(points.points[points.contact, 1] - lane) < 0.2e-3)
    reasons = eq15.estimate(line).reasons
    assert set(reasons) <= {trilaterate.COLLINEAR, trilaterate.TOO_FEW}
    assert trilaterate.COLLINEAR in reasons
