"""Contacts held out and localized, on a cap of a sphere whose readings NumPy alone makes."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.estimation import cross_validation
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.cross_validation import blocks
from meshskin.estimation.data.gather import gather
from meshskin.estimation.localization import CalibratedSkin

from .learned.test_estimate import (
    DISC,
    FORCE,
    PEAK,
    RADIUS,
    TAXELS,
    TRUTH,
    A,
    bell,
    hertz,
    recording,
    world,
)
from .learned.test_estimate import belief as known

NOISE = 0.01
"""Of a reading, relative to the peak."""


def record(profile=hertz, unit=1.0, lag=0.0):
    """Contacts along a spiral of ten turns; readings in Pa / `unit`, of which the part `lag` stays
    behind the pressure by 0.2 peaks."""

    def lagging(pressure, rng):
        read, state, width = pressure.copy(), np.zeros(TAXELS), 0.2 * PEAK
        for k, now in enumerate(pressure):
            state = np.clip(state, now - width, now + width)
            read[k] += lag * (state - now)
        return read

    points, force, contact, taxel, level = world(profile, contacts=400, noise=NOISE, read=lagging)
    return recording(points, force, contact, taxel, level / unit)


@pytest.fixture(scope="module")
def physical():
    """A recording under Hertz's model, its calibration and the cross-validation."""
    recording = record()
    calibration = calibrate(recording, known(contact="hertz"))
    return recording, calibration, calibration.cross_validate(recording)


def rms(x):
    return float(np.sqrt(np.nanmean(x**2)))


def predicted(points):
    """Rms error, m, of contacts that the true skin localizes under this noise (k readings)."""
    error = []
    for point in points:
        r = np.linalg.norm(TRUTH - point, axis=1)
        along = (TRUTH - point) / np.maximum(r, 1e-9)[:, None]
        near = r < A + DISC
        node = np.linspace(-1, 1, 41)
        grid = np.stack(np.meshgrid(node, node), -1).reshape(-1, 2)
        grid = DISC * grid[np.sum(grid**2, axis=1) < 1]

        def mean(d, grid=grid):
            return np.mean(hertz(np.hypot(d[:, None] + grid[:, 0], grid[:, 1]), FORCE), axis=1)

        slope = (mean(r[near] + 1e-4) - mean(r[near] - 1e-4)) / 2e-4 / (NOISE * PEAK)
        gradient = along[near] * slope[:, None]
        information = gradient.T @ gradient + np.outer(point, point) / RADIUS**2 * 1e20
        error.append(np.trace(np.linalg.inv(information)))
    return float(np.sqrt(np.mean(error)))


def test_contacts_are_localized_as_well_as_the_noise_allows(physical):
    recording, _, found = physical
    sound = np.isfinite(found.errors)
    assert sound.sum() > 0.9 * np.sum(np.bincount(recording.reading_contact) >= 3)
    bound = predicted(recording.points[sound])
    assert 0.9 * bound < rms(found.errors) < 1.4 * bound
    assert rms(found.errors) < 0.1 * rms(found.centroid_errors)
    metrics = found.metrics()
    assert metrics["error_mm"]["rms"] == pytest.approx(1e3 * rms(found.errors))
    assert metrics["error_mm"]["p95"] > metrics["error_mm"]["rms"]
    assert 4.0 < metrics["taxel_pitch_mm"] < 5.5
    normal = -np.log(NOISE * PEAK) - (1 + np.log(2 * np.pi)) / 2  # were the skin known exactly
    assert normal - 0.2 < metrics["log_likelihood_per_reading"] < normal + 0.02


def test_two_exchanged_taxels_are_seen(physical):
    recording, calibration, found = physical
    data = gather(recording, known(contact="hertz"))
    held = np.flatnonzero(found.fold == 0)
    poses = calibration.poses.copy()
    poses[[3, 4]] = poses[[4, 3]]
    exchanged = CalibratedSkin.of(replace(calibration, poses=poses), data)
    skin = CalibratedSkin.of(calibration, data)
    off = [rms((s.localize(held) - data.points)[held]) for s in (skin, exchanged)]
    likelihood = [s.log_likelihoods(held)[0].sum() for s in (skin, exchanged)]
    assert off[1] > 3 * off[0]
    assert likelihood[1] < likelihood[0] - 1000


@pytest.mark.slow
def test_a_learned_response_localizes_raw_readings():
    recording = record(bell, unit=150.0)
    calibration = calibrate(recording, known(readings="raw"))
    found = calibration.cross_validate(recording, folds=3)
    assert np.isfinite(found.errors).sum() > 300
    assert rms(found.errors) < 0.25 * rms(found.centroid_errors)
    noise = NOISE * PEAK / 150.0
    normal = -np.log(noise) - (1 + np.log(2 * np.pi)) / 2
    found = found.metrics()["log_likelihood_per_reading"]
    assert found == pytest.approx(normal, abs=0.2)


@pytest.mark.deep
def test_held_out_contacts_do_not_calibrate(physical, monkeypatch):
    recording, calibration, found = physical
    parts = []

    def calibrated(part, belief, method):
        assert method == calibration.method
        parts.append((part, belief))
        return calibration

    monkeypatch.setattr(cross_validation, "calibrate", calibrated)
    headings = np.tile(np.eye(3), (len(recording.time), 1, 1))
    given = known(contact="hertz", headings=headings)
    again = cross_validation.cross_validate(calibration, recording, 5, given)
    assert np.array_equal(again.fold, found.fold)
    for k, (part, belief) in enumerate(parts):
        others = found.fold != k
        assert np.array_equal(part.time, recording.time[others])
        assert len(part.pressure) == others[recording.reading_contact].sum()
        assert len(belief.headings) == others.sum()


def test_blocks_are_of_consecutive_contacts():
    line = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert blocks(line, 2.5).tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert blocks(line[[0, 9, 1, 8]], 2.5).tolist() == [0, 1, 2, 3]
    scatter = 0.1 * np.random.default_rng(0).standard_normal((50, 3))
    assert not blocks(scatter, 5.0).any()
    circle = np.column_stack([np.cos(np.arange(63) / 10), np.sin(np.arange(63) / 10), np.zeros(63)])
    assert blocks(circle, 2.5)[-1] == 2


def test_what_cannot_be_cross_validated(physical, tmp_path):
    recording, calibration, _ = physical
    calibration.save(tmp_path / "skin")
    loaded = Calibration.load(tmp_path / "skin")
    with pytest.raises(CalibrationError, match="does not know the scene"):
        loaded.cross_validate(recording)
    with pytest.raises(CalibrationError, match="number of folds"):
        calibration.cross_validate(recording, folds=1)
    with pytest.raises(CalibrationError, match="too few blocks"):
        calibration.cross_validate(recording, folds=200)


@pytest.mark.deep
def test_a_loaded_calibration_is_cross_validated_alike(physical, tmp_path):
    recording, calibration, found = physical
    calibration.save(tmp_path / "skin")
    loaded = Calibration.load(tmp_path / "skin")
    again = loaded.cross_validate(recording, belief=known(contact="hertz"))
    assert np.allclose(again.errors, found.errors, equal_nan=True)


@pytest.mark.slow
def test_hysteresis_is_in_the_localization():
    recording = record(lag=0.5)
    calibration = calibrate(recording, known(contact="learned"))
    assert calibration.response.hysteresis[0] == pytest.approx(0.5, abs=0.1)
    found = calibration.cross_validate(recording, folds=3, belief=known(contact="learned"))
    strong = recording.pressure > 0.25 * PEAK  # what lags is 0.1 of it, in taxels at rest
    pressed = np.bincount(recording.reading_contact[strong], minlength=400) >= 3
    assert np.isfinite(found.errors)[pressed].mean() > 0.9
    assert rms(found.errors[pressed]) < 0.5e-3
    skin = CalibratedSkin.of(calibration, gather(recording, known(contact="learned")))
    normal = -np.log(NOISE * PEAK) - (1 + np.log(2 * np.pi)) / 2
    total, count = skin.log_likelihoods(np.arange(400))
    assert total.sum() / count.sum() == pytest.approx(normal, abs=0.3)
    total, count = replace(skin, past=None).log_likelihoods(np.arange(400))
    assert total.sum() / count.sum() < normal - 2.0
