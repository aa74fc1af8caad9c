"""The baseline: weighted means of contact points, their covariance, and what they cannot say."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.contact.indenter import Indenter
from meshskin.contact.material import Material
from meshskin.core.errors import CalibrationError
from meshskin.estimation import centroid
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.uncertainty.metrics import position_errors
from meshskin.geometry.body import Body
from meshskin.scene.belief import Belief


def test_the_mean_and_covariance_of_three_points():
    points = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [0.0, 2.0, 1.0], [9.0, 9.0, 9.0]])
    weights = np.array([1.0, 1.0, 2.0, -5.0])  # a negative reading weighs nothing
    mean, spread, covariance = centroid.centroids(points, np.array([1, 1, 1, 1]), weights, 3)
    np.testing.assert_allclose(mean[1], [1.0, 1.0, 1.0])
    # sum of w (x - m)^2 over 1 - sum of w^2, with w = 1/4, 1/4, 1/2: 3 / (5/8)
    np.testing.assert_allclose(np.diag(spread[1]), [4.8, 1.6, 0.0])
    assert spread[1, 0, 1] == pytest.approx(-1 / 0.625)
    np.testing.assert_allclose(covariance[1], spread[1] * 0.375)
    assert np.isnan(mean[[0, 2]]).all()


def test_the_covariance_is_that_of_means_of_random_points():
    rng, many, each = np.random.default_rng(0), 4000, 12
    points = rng.normal(size=(many * each, 3)) * [1.0, 2.0, 0.0]
    taxel = np.repeat(np.arange(many), each)
    mean, _, stated = centroid.centroids(points, taxel, rng.uniform(0, 1, len(taxel)), many)
    np.testing.assert_allclose(np.diag(stated.mean(axis=0)), mean.var(axis=0), rtol=0.08, atol=0)


def test_the_unit_of_the_readings_does_not_matter(world):
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    found = calibrate(recording, belief, method="centroid")
    other = recording.with_columns(pressure=0.2 * recording.pressure)
    again = calibrate(other, world.belief(0.01, 0.2 * 0.05), method="centroid")
    np.testing.assert_allclose(again.positions, found.positions, atol=1e-12)
    assert position_errors(found, world.skin).mean() < 0.1e-3
    assert np.linalg.norm(found.positions, axis=1) == pytest.approx(0.1, abs=1e-9)


def test_one_sided_contacts_shift_it(world):
    """The mean moves to where the contacts are, and the statement does not cover that."""
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    taxel = {int(k): row for row, k in enumerate(world.ids)}
    rows = np.array([taxel[int(k)] for k in recording.reading_taxel])
    off = recording.points[recording.reading_contact] - world.truth[rows]
    half = replace(recording, readings=recording.readings.filter(pa.array(off[:, 0] > 0)))
    found = calibrate(half, belief, method="centroid")
    shift = (found.positions - world.truth)[:, 0]
    assert np.nanmean(shift) > 1e-3


def test_too_few_readings(world):
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    mine = np.flatnonzero(recording.reading_taxel == world.ids[7])
    keep = np.ones(len(recording.pressure), dtype=bool)
    keep[mine[2:]] = False
    cut = replace(recording, readings=recording.readings.filter(pa.array(keep)))
    found = calibrate(cut, belief, method="centroid")
    assert found.reasons[7] == "fewer than three readings"
    assert np.isnan(found.positions[7]).all()
    assert np.isfinite(np.delete(found.positions, 7, axis=0)).all()


@pytest.mark.deep
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_raw_counts_of_either_sign_give_the_same_means(world, sign):
    """Every taxel is read in every frame, as counts about a level at rest of its own."""
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    level = np.zeros((len(recording.time), len(world.ids)))
    taxel = np.searchsorted(world.ids, recording.reading_taxel)
    level[recording.reading_contact, taxel] = recording.pressure / recording.pressure.max()
    rest = 100.0 + np.arange(len(world.ids))
    counts = np.round(rest + sign * 80 * level)
    readings = pa.table(
        {
            "time": np.repeat(recording.time, len(world.ids)),
            "taxel": pa.array(np.tile(world.ids, len(recording.time)), pa.int32()),
            "pressure": counts.ravel(),
        }
    )
    raw = replace(recording, readings=readings)
    own = Belief(
        body=Body.sphere(radius=0.1), indenter=Indenter.sphere(0.01),
        material=Material(0.2e6, 0.49, None), taxel_ids=world.ids, readings="raw",
    )  # fmt: skip
    found = calibrate(raw, own, method="centroid")
    model = calibrate(recording, belief, method="centroid")
    off = np.linalg.norm(found.positions - model.positions, axis=1)
    assert np.isfinite(found.positions).all()
    assert off.mean() < 0.05e-3
    assert position_errors(found, world.skin).mean() < 0.15e-3
    with pytest.raises(CalibrationError, match=r"trilateration needs pressures.*joint, centroid"):
        calibrate(raw, own, method="trilateration")
