"""Level at rest, drift, polarity, noise and contacts of readings whose truth is known."""

import numpy as np
import pytest

from meshskin.core.arrays import runs
from meshskin.core.errors import RecordingError
from meshskin.recording.tare import _fill_rest, segment, tare, thresholds

from .robot_log import RobotLog


def skin(**changes):
    """Times, raw counts, and what they would be less their level at rest, rising."""
    log = RobotLog(**changes)
    times, counts = log.streams()["/skin"]
    return log, times, counts, log.rest - log.counts_at(times - log.late)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("drift", [0.0, 15.0])
def test_raw_counts_become_readings_that_rise_from_zero(sign, drift):
    log, times, counts, truth = skin(drift=drift, contacts=20)
    found = tare(times, sign * counts)
    assert found.falling == (sign > 0)
    error = found.readings - truth
    assert abs(error.mean()) < 0.15
    assert error.std() == pytest.approx(np.hypot(log.noise, 1 / np.sqrt(12)), rel=0.05)
    assert found.noise == pytest.approx(np.hypot(log.noise, 1 / np.sqrt(12)), rel=0.2)
    assert found.drift.mean() == pytest.approx(0.8 * drift, abs=4)  # between middles of blocks


def test_a_reading_between_two_at_rest_is_their_mean():
    readings = np.array([[1.0, 1.0, 9.0], [np.nan] * 3, [3.0, 9.0, 3.0], [0.0] * 3])
    _fill_rest(readings, np.isnan(readings), np.full(3, 5.0))
    np.testing.assert_array_equal(readings[1], [2.0, np.nan, np.nan])


def test_lost_readings_at_rest_are_at_rest():
    log, times, counts, truth = skin(contacts=20)
    whole = tare(times, counts)
    lost = np.random.default_rng(1).random(counts.shape) < 0.004
    lost[300:340, 7] = True
    found = tare(times, np.where(lost, np.nan, counts))
    np.testing.assert_array_equal(found.in_contact, whole.in_contact)
    left = np.isnan(found.readings)
    assert left[301:339, 7].all()
    alone = lost & ~np.roll(lost, 1, axis=0) & ~np.roll(lost, -1, axis=0)
    assert left[alone & (truth > 20)].all()
    filled = lost & ~left
    assert filled[alone].mean() > 0.8
    error = (found.readings - truth)[filled]
    assert np.abs(error).max() < 5 * log.noise
    np.testing.assert_allclose(found.readings[~lost], whole.readings[~lost], atol=0.2)


def test_contacts_are_those_of_the_force():
    log, times, counts, _ = skin(contacts=20)
    force = log.force_at(times - log.late)
    found = tare(times, counts).in_contact
    assert len(runs(found)) == 20
    assert not np.any(found & (force == 0))
    assert np.mean(found[force > 0.7]) > 0.98


def test_a_taxel_that_is_pressed_for_most_of_the_time_keeps_its_level():
    rng = np.random.default_rng(2)
    times = np.arange(3000) / 50
    pressed = (times % 2.0) < 1.2
    counts = 100 + rng.normal(0, 1, (3000, 2))
    counts[:, 0] += np.where(pressed, 30 + 10 * np.sin(9 * times), 0.0)
    found = tare(times, counts)
    assert not found.falling
    np.testing.assert_allclose(found.readings[~pressed, 0].mean(), 0.0, atol=0.2)
    assert np.mean(found.in_contact == pressed) > 0.97


def test_noise_alone_feigns_no_contact():
    """The false-alarm rate is 1 % a log, and less since a contact takes two frames."""
    rng = np.random.default_rng(3)
    times = np.arange(2000) / 50
    for _ in range(20):
        with pytest.raises(RecordingError, match="never answers: no reading exceeds its noise"):
            tare(times, rng.normal(0, 3, (2000, 16)))
    with pytest.raises(RecordingError, match="never answers: no reading ever changes; check the"):
        tare(times, np.full((2000, 16), 240))


def test_readings_that_go_both_ways_have_no_polarity():
    rng = np.random.default_rng(4)
    times = np.arange(2000) / 50
    counts = rng.normal(0, 1, (2000, 2))
    counts[500:560, 0] += 30
    counts[900:960, 1] -= 30
    with pytest.raises(RecordingError, match=r"not clear, got .*; give polarity"):
        tare(times, counts)
    assert len(runs(tare(times, counts, "rising").in_contact)) == 1


def test_thresholds_have_the_stated_false_alarm_rate():
    on, off = thresholds(1000, 10)
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(200_000, 10)).max(axis=1)
    assert np.mean(noise > off) == pytest.approx(0.01, rel=0.1)
    assert on == pytest.approx(4.753, abs=1e-3)  # of a normal variable, 1e-6 above


def test_segments_need_two_frames_above_the_upper_threshold():
    strongest = np.array([0, 4, 6, 4, 0, 0, 6, 6, 4, 4, 1, 4, 4.0])
    assert runs(segment(strongest, 5, 3)) == [slice(6, 10)]


def test_missing_readings_stay_missing():
    _, times, counts, truth = skin(contacts=6)
    holed = counts.copy()
    holed[40:60, 3] = np.nan
    holed[:, 7] = np.nan
    found = tare(times, holed)
    assert np.isnan(found.readings[40:60, 3]).all()
    assert np.isnan(found.readings).sum() == 20 + len(times)
    assert found.noise[7] == 0
    known = np.isfinite(found.readings)
    np.testing.assert_allclose(found.readings[known], truth[known], atol=8)


@pytest.mark.parametrize("taxels", [3, slice(None)])
@pytest.mark.parametrize("frame", [0, 1, 300, -1])
def test_a_damaged_reading_is_left_out(frame, taxels):
    _, times, counts, _ = skin(contacts=6)
    sound, damaged = tare(times, counts), counts.copy()
    damaged[frame, taxels] = 65535
    found = tare(times, damaged)
    lost = np.isnan(found.readings)
    assert lost[frame, taxels].all()
    assert found.glitches == lost.sum() == (1 if taxels == 3 else 25)
    assert found.falling
    np.testing.assert_allclose(found.noise, sound.noise, rtol=0.05)
    assert len(runs(found.in_contact)) == len(runs(sound.in_contact))


def test_strong_readings_of_one_frame_in_a_stroke_are_kept():
    """A fast stroke presses every taxel for a frame."""
    rng = np.random.default_rng(6)
    counts = 100 + rng.normal(0, 1, (2000, 16))
    for start in range(100, 2000, 200):
        counts[start + np.arange(16), np.arange(16)] += 80
    found = tare(np.arange(2000) / 50, counts)
    assert found.glitches == 0
    assert len(runs(found.in_contact)) == 10


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("hold", [12, 20, 30, 45])
def test_a_contact_that_is_held_is_no_level_at_rest(hold, sign):
    """Over a drift of ten standard deviations a minute."""
    rng = np.random.default_rng(7)
    times = np.arange(0, 200, 0.02)
    starts = 10.0 + 45 * np.arange(4)
    truth = 100.0 * ((times[:, None] > starts) & (times[:, None] < starts + min(hold, 44)))
    counts = 200 + 0.25 * times[:, None] + rng.normal(0, 1.5, truth.shape)
    found = tare(times, counts + sign * truth, "rising" if sign > 0 else "falling")
    np.testing.assert_allclose((found.readings - truth).mean(axis=0), 0.0, atol=0.5)
    assert np.abs(found.readings - truth).max() < 9
    assert np.array_equal(found.in_contact, truth.any(axis=1))
    assert not len(found.jumps)


def test_a_level_that_jumps_for_good_is_told():
    rng = np.random.default_rng(8)
    times = np.arange(0, 100, 0.02)
    counts = 200 + rng.normal(0, 1.5, (5000, 4))
    counts[(times % 8) < 0.6, 1] += 50
    counts[times > 45, 2] += 80
    found = tare(times, counts)
    assert 35 <= found.jumps[0] <= 55
    assert len(found.jumps) == 1
    np.testing.assert_allclose(found.readings[times > 60, 2].mean(), 0.0, atol=0.5)


def test_a_log_of_two_frames_is_refused():
    with pytest.raises(RecordingError, match="never answers: it has 2 frames"):
        tare(np.arange(2.0), np.ones((2, 3)))


@pytest.mark.parametrize("kind", [np.int8, np.int16, np.float32])
def test_ranges_of_whole_numbers_do_not_wrap(kind):
    """From -100 to 100, which is more than the largest int8."""
    times = 0.02 * np.arange(3000)
    pressed = (np.arange(3000) // 100) % 3 == 1
    counts = np.where(pressed, 100, -100) + np.random.default_rng(0).integers(-2, 3, 3000)
    found = tare(times, counts.astype(kind)[:, None], "rising", "skin")
    assert found.glitches == 0
    assert np.mean(found.in_contact == pressed) > 0.99
