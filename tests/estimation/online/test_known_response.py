"""The online calibration of raw readings under forces that were not measured."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.online.frames import RecordedFrames
from meshskin.estimation.online.known_response import KnownResponse
from meshskin.recording.recording import NOMINAL

COUNTS = 1e-2
"""Counts per Pa."""
COUNT = 60
"""Contacts."""
FORCE = 0.3
"""Standard deviation of ln F, which the robot does not know."""


@pytest.fixture(scope="module")
def raw(noisy):
    """Seven taxels pressed 60 times under unknown forces, the recording and the belief."""
    rng = np.random.default_rng(3)
    middle = noisy.skin.positions[40]
    off = np.linalg.norm(noisy.skin.positions - middle, axis=1)
    rows = np.sort(np.argsort(off)[:7])
    skin = ms.Skin(noisy.skin.poses[rows], noisy.skin.ids[rows], noisy.skin.disc_radius)
    scene = noisy.with_(skin=skin)
    points = skin.positions.mean(axis=0) + rng.normal(scale=4e-3, size=(COUNT, 3))
    forces = 3.0 * np.exp(FORCE * rng.normal(size=len(points)))
    pressed = ms.press(scene, points, forces, seed=1)
    counts = pressed.with_columns(force=np.ones(COUNT), pressure=COUNTS * pressed.pressure)
    metadata = {"taxel_ids": skin.ids.tolist(), "readings": "raw", "force": NOMINAL}
    recording = replace(counts, metadata=metadata)
    belief = replace(
        scene.belief(), readings="raw", noise_sigma=None, threshold=0.0, force_reference=None
    )
    return ms.calibrate(recording, belief), recording, skin, forces


@pytest.fixture(scope="module")
def replayed(raw):
    """What is known of the recording, and the online calibration of all its contacts."""
    found, recording, _, _ = raw
    known = KnownResponse.of(found, recording)
    online = known.online()
    frames = RecordedFrames(known.recording, online.ids, known.errors)
    for begin in range(0, COUNT, 4):
        online.update(*frames.part(begin, begin + 4))
    online.settle()
    return known, online


def test_taxels_are_where_the_batch_estimate_puts_them(raw, replayed):
    found, online = raw[0], replayed[1]
    apart = np.linalg.norm(online.positions - found.positions, axis=1)
    assert (apart < 0.3 * found.position_sigma).all()
    assert online.status.used == COUNT


def test_without_the_errors_of_the_forces_the_places_are_others(raw, replayed):
    found, (known, _) = raw[0], replayed
    online = known.online()
    frames = RecordedFrames(known.recording, online.ids)
    online.update(*frames.part(0, COUNT))
    online.settle()
    apart = np.linalg.norm(online.provisional - found.positions, axis=1)
    assert (apart > 0.5 * found.position_sigma).any()


def test_the_estimated_errors_are_those_of_the_forces(raw):
    found, _, _, forces = raw
    errors = found.contact_errors[:, 2]
    told = np.abs(errors) > 0.02  # contacts that no taxel reads keep the prior mean
    assert np.corrcoef(errors[told], np.log(forces)[told])[0, 1] > 0.9


def test_sigmas_hold_what_the_places_are_off(raw, replayed):
    skin, online = raw[2], replayed[1]
    off = np.linalg.norm(online.positions - skin.positions, axis=1)
    assert np.sqrt(np.mean((off / online.position_sigma) ** 2)) < 1.5
    assert np.median(online.position_sigma / raw[0].position_sigma) == pytest.approx(1, abs=0.05)


def test_a_calibration_without_learned_response_is_refused(noisy):
    recording = ms.press(noisy, noisy.skin.positions[:3].repeat(3, axis=0), seed=1)
    with pytest.warns(ms.LeftOutWarning):
        found = ms.calibrate(recording, noisy.belief(), method="centroid")
    with pytest.raises(CalibrationError, match="no learned response"):
        KnownResponse.of(found, recording)


@pytest.fixture(scope="module")
def past(noisy):
    """Seven taxels with hysteresis, read at 50 Hz: the recording, and its calibration."""
    middle = noisy.skin.positions[40]
    off = np.linalg.norm(noisy.skin.positions - middle, axis=1)
    rows = np.sort(np.argsort(off)[:7])
    skin = ms.Skin(noisy.skin.poses[rows], noisy.skin.ids[rows], noisy.skin.disc_radius)
    lagging = ms.effects.find("hysteresis")(share=0.5, width_relative=0.1)
    slow = ms.Loop(mode="quasi_static")
    scene = noisy.with_(
        skin=skin,
        effects=(*noisy.effects, lagging),
        loop=slow,
        readout=replace(noisy.readout, rate=50.0),
    )
    recording = ms.simulate(scene, seed=1)
    return ms.calibrate(recording, replace(scene.belief(), contact="learned")), recording


def replay(known):
    """The online calibration of the contacts of a known response."""
    online = known.online()
    frames = RecordedFrames(known.recording, online.ids, known.errors)
    for begin in range(0, len(known.recording.points), 10):
        online.update(*frames.part(begin, min(begin + 10, len(known.recording.points))))
    online.settle()
    return online


@pytest.mark.deep
def test_readings_are_shown_without_what_the_past_adds(past):
    found, recording = past
    assert found.response.hysteresis[0] > 0.2
    known = KnownResponse.of(found, recording)
    online = replay(known)
    apart = np.linalg.norm(online.positions - found.positions, axis=1) / found.position_sigma
    assert (apart < 1).all()
    assert online.status.verdict == "done"
    nothing = found.additions * [1, 1, 0]
    as_read = replay(KnownResponse.of(replace(found, additions=nothing), recording))
    moved = np.linalg.norm(as_read.provisional - found.positions, axis=1) / found.position_sigma
    assert np.median(moved) > 3 * np.median(apart)


def test_hysteresis_takes_from_rising_readings_and_adds_to_falling_ones(past):
    found = past[0]
    added, response = found.additions[:, 2], found.response
    most = np.prod(response.hysteresis) * response.references[2]  # share and width of the play
    assert added.max() == pytest.approx(most, rel=0.2)
    assert added.min() == pytest.approx(-most, rel=0.2)


def test_saturated_readings_of_a_past_are_lost(past):
    found, recording = past
    end = 0.9 * float(recording.pressure.max())
    belief = replace(found.belief, saturation=end)
    known = KnownResponse.of(replace(found, belief=belief), recording)
    full = int(np.sum(recording.pressure >= end))
    assert full > 10
    assert np.isnan(known.recording.pressure).sum() == full


def test_contacts_that_the_batch_left_out_are_left_out(raw):
    """Three contacts whose readings are nonsense, which the batch did not use."""
    found, recording, _, _ = raw
    bad = [5, 20, 41]
    errors = found.contact_errors.copy()
    errors[bad] = np.nan
    at = np.isin(recording.readings["time"].to_numpy(), recording.time[bad])
    counts = np.where(at, 3.0 * recording.pressure.max(), recording.pressure)
    spoilt = recording.with_columns(pressure=counts)
    known = KnownResponse.of(replace(found, contact_errors=errors), spoilt)
    kept = np.setdiff1d(np.arange(COUNT), bad)
    assert at.any()
    np.testing.assert_array_equal(known.recording.time, recording.time[kept])
    np.testing.assert_array_equal(known.errors, found.contact_errors[kept])
    assert not np.isin(known.recording.readings["time"], recording.time[bad]).any()
    online = replay(known)
    assert online.status.used == len(kept)
    apart = np.linalg.norm(online.positions - found.positions, axis=1)
    assert (apart < 0.5 * found.position_sigma).all()
    assert len(KnownResponse.of(found, spoilt).recording.time) == COUNT
