"""An unknown noise is estimated without bias, and the estimate then is as with a known noise."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.calibrate import Estimation, calibrate
from meshskin.estimation.joint.noise import edge_parts, neighbour_scatter, neighbours
from meshskin.estimation.joint.readings import Readings

NOISE = 0.05
"""Relative to the peak, as is the threshold: readings from one standard deviation on."""


@pytest.fixture(scope="module")
def low(world):
    """By seed: a recording with the threshold at one standard deviation, and its calibration by a
    belief that does not know the noise."""

    @functools.cache
    def made(seed):
        recording = world.record(NOISE, NOISE, seed)
        return recording, calibrate(recording, world.belief(None, NOISE))

    return made


@pytest.mark.slow
def test_the_noise_is_unbiased_with_the_threshold_at_one_standard_deviation(world, low):
    every = [low(seed)[1] for seed in range(3)]
    ratio = [found.fit.noise / (NOISE * world.peak_reference) for found in every]
    spread = 1 / np.sqrt(2 * sum(found.fit.pairs for found in every))
    assert spread < 0.03
    assert abs(np.mean(ratio) - 1) < 3 * spread


def test_the_estimate_names_the_noise(low):
    _, found = low(0)
    pairs = found.fit.pairs
    assert pairs > 100
    words = [factor for factor in found.factors if factor.startswith("noise of")]
    assert len(words) == 1
    assert "neighbouring contacts" in words[0]


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.deep) for k in (1, 2))])
def test_positions_and_deviations_are_those_of_a_known_noise(world, low, seed):
    recording, unknown = low(seed)
    known = calibrate(recording, world.belief(NOISE, NOISE))
    found = np.isfinite(known.positions[:, 0])
    assert np.array_equal(found, np.isfinite(unknown.positions[:, 0]))
    apart = np.linalg.norm(unknown.positions - known.positions, axis=1)[found]
    assert np.all(apart < 0.5 * known.position_sigma[found])
    ratio = unknown.position_sigma[found] / known.position_sigma[found]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    assert unknown.fit.good
    assert unknown.verdict.level == "PASS"


@pytest.mark.deep
def test_untouched_taxels_that_read_noise_are_not_placed(world, low):
    """Contacts over half of the skin only: the taxels of the other half read noise."""
    from meshskin.recording.recording import Recording

    recording, _ = low(0)
    keep = np.flatnonzero(recording.points[:, 0] < 0)
    time = recording.time[keep]
    rows = np.isin(recording.readings.column("time").to_numpy(), time)
    half = Recording(recording.contacts.take(keep), recording.readings.filter(rows), {})
    found = calibrate(half, world.belief(None, NOISE))
    error = np.linalg.norm(found.positions - world.truth, axis=1)
    far = world.truth[:, 0] > 8e-3
    assert far.sum() >= 5
    assert (found.readings[far] > 10).all()
    assert not np.isfinite(error[far]).any()
    assert not np.any((error > 0.3e-3) & (error > 5 * found.position_sigma))


def test_a_threshold_that_is_not_declared_is_the_smallest_reading(world):
    """Silences below the true threshold of 5 % would contradict a threshold of zero."""
    recording = world.record(0.01, 0.05)
    found = calibrate(recording, world.belief(None, 0.0))
    assert found.fit.good
    assert abs(found.modulus / world.modulus - 1) < 4 * found.modulus_sigma / world.modulus
    data = Estimation(recording, world.belief(None, 0.0)).data
    assert data.threshold == recording.pressure.min()
    assert data.threshold > 0.04 * world.peak_reference


def test_ideal_data_have_no_noise_to_estimate(world):
    found = calibrate(world.record(), world.belief())
    assert not any(factor.startswith("noise of") for factor in found.factors)
    assert np.nanmax(found.position_sigma) < 1e-6


def test_neighbours_are_pairs_of_one_taxel():
    contact = np.array([0, 1, 2, 9, 0, 1])
    readings = replace(
        Readings.none(), contact=contact, taxel=np.array([0, 0, 0, 0, 1, 1]), weight=np.ones(6)
    )
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1.5, 0, 0], *[[9, 9, 9]] * 6, [5, 0, 0]]) * 1e-3
    near, following = neighbours(readings, points, np.arange(6))
    assert sorted(zip(*map(list, near), strict=True)) == [(1, 2), (4, 5)]
    assert sorted(zip(*map(list, following), strict=True)) == [(0, 1), (4, 5)]


def test_the_scatter_of_white_noise_is_unbiased():
    """Neighbours in space and in time scatter alike: the smaller variance is 5 % too small."""
    rng, scale = np.random.default_rng(0), []
    taxel, contact = (x.ravel() for x in np.mgrid[0:4, 0:50])
    readings = replace(Readings.none(), contact=contact, taxel=taxel, weight=np.ones(200))
    for _ in range(400):
        points, white = rng.normal(size=(50, 3)), rng.normal(size=200)
        found = neighbour_scatter(
            readings, points, white, np.arange(200), lambda a, b: np.full(len(a), 2.0)
        )
        scale.append(found.scale**2)
    assert abs(np.mean(scale) - 1) < 3 * np.std(scale) / np.sqrt(len(scale))


def test_what_wanders_in_time_is_no_scatter():
    """Neighbours in time tell the noise where the residuals of returning passes differ."""
    rng = np.random.default_rng(0)
    taxel, contact = (x.ravel() for x in np.mgrid[0:4, 0:200])
    readings = replace(Readings.none(), contact=contact, taxel=taxel, weight=np.ones(800))
    wander = rng.normal(size=800) + 0.05 * contact
    found = neighbour_scatter(
        readings, rng.normal(size=(200, 3)), wander, np.arange(800), lambda a, b: np.full(len(a), 2)
    )
    assert found.scale == pytest.approx(1.0, abs=3 / np.sqrt(2 * found.pairs))


def test_edges_that_no_residuals_tell_err_as_the_others_at_most():
    """They had all of the expected variance, whatever the others showed."""
    expected, least = np.full(5, 100.0), np.array([10.0, 10.0, 10.0, 80.0, 80.0])
    sound, bad = np.array([5.0, 0.0, -3.0, 70.0, 500.0]), np.array([5.0, 30.0, -3.0, 70.0, 0.0])
    np.testing.assert_allclose(edge_parts(sound, least, expected), [0, 0, 0, 0.1, 0.1])
    np.testing.assert_allclose(edge_parts(bad, least, expected), [0, 0.4, 0, 0.4, 0.4])
    few = np.array([80.0, 80.0, 80.0, 10.0, 10.0])
    np.testing.assert_allclose(edge_parts(bad, few, expected), [1, 1, 1, 0.8, 0])
