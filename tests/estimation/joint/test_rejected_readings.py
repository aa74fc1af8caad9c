"""Readings that were left out, where single taxels have many of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.joint.departures import FittedReadings
from meshskin.estimation.joint.pressure import OBSERVED
from meshskin.estimation.joint.rejected_readings import HUBER, displacements

TAXELS, EACH, SIGMA = 40, 30, 2.0


def fitted(left_out, off, seed=0):
    """Readings of taxels with two unknowns each, of which `left_out` (k,) bool have residuals
    `off` (k,) in standard deviations."""
    rng, k = np.random.default_rng(seed), TAXELS * EACH
    taxel = np.repeat(np.arange(TAXELS), EACH)
    mu, own = rng.uniform(5, 10, k), rng.normal(size=(2, k)) * 1e4
    readings = SimpleNamespace(
        kind=np.full(k, OBSERVED),
        weight=np.where(left_out, 0.0, 1.0),
        level=SIGMA * (mu + off),
        taxel=taxel,
        starts=EACH * np.arange(TAXELS + 1),
    )
    return FittedReadings(
        data=SimpleNamespace(sigma=SIGMA),
        readings=readings,
        points=np.zeros((TAXELS, 3)),
        mu=mu,
        offset=np.zeros(k),
        rate=np.zeros(k),
        curvature=np.where(left_out, 0.0, 1.0),
        own=own,
        prior=np.zeros(2),
        tangents=np.zeros((TAXELS, 3, 2)),
    )


def test_many_of_one_taxel_displace_it():
    """By the least squares of its readings, in which each of these counts with HUBER."""
    left_out = np.zeros(TAXELS * EACH, dtype=bool)
    left_out[EACH * 7 : EACH * 7 + 6] = left_out[EACH * 9] = True
    made = fitted(left_out, 9.0 * left_out)
    found = displacements(made, np.ones(TAXELS * EACH), np.ones(TAXELS * EACH))
    own = made.own[:, EACH * 7 : EACH * 8].T
    expected = np.linalg.lstsq(own, HUBER * (np.arange(EACH) < 6), rcond=None)[0]
    np.testing.assert_allclose(found[7], expected, rtol=1e-6)
    assert not np.delete(found, 7, axis=0).any()  # one of another taxel may be an accident


def test_readings_count_by_their_spread():
    """Twice as uncertain ones, with residuals cut at twice as much, pull half as much."""
    left_out = np.zeros(TAXELS * EACH, dtype=bool)
    left_out[EACH * 7 : EACH * 7 + 6] = True
    made = fitted(left_out, 9.0 * left_out)
    spread = np.full(TAXELS * EACH, 2.0)
    found = displacements(made, spread**-2, spread)
    weight = np.where(np.arange(EACH) < 6, 0.5, 1.0)
    own = made.own[:, EACH * 7 : EACH * 8].T * weight[:, None]
    expected = np.linalg.lstsq(own, HUBER * (np.arange(EACH) < 6), rcond=None)[0]
    np.testing.assert_allclose(found[7], expected, rtol=1e-6)


@pytest.mark.parametrize("fraction", [0.0, 0.02, 0.1])
def test_accidents_displace_few(fraction):
    rng = np.random.default_rng(3)
    left_out = rng.random(TAXELS * EACH) < fraction
    even = np.ones(TAXELS * EACH)
    found = displacements(fitted(left_out, 9.0 * left_out), even, even)
    assert np.sum(found.any(axis=1)) <= 1


def test_displacements_grow_as_the_noise():
    """Weights are relative to those of the readings that are kept; the noise cuts the residuals."""
    left_out = np.zeros(TAXELS * EACH, dtype=bool)
    left_out[EACH * 7 : EACH * 7 + 6] = True
    made, even = fitted(left_out, 90.0 * left_out), np.ones(TAXELS * EACH)
    once, five = (displacements(made, even, scale * even)[7] for scale in (1.0, 5.0))
    np.testing.assert_allclose(five, 5 * once, rtol=1e-9)
