"""The online calibration against the batch estimate of the same contacts."""

import pickle
from collections import Counter
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError, ConfigError, RecordingError
from meshskin.estimation.online.frames import RecordedFrames
from meshskin.estimation.online.status import Judge
from meshskin.geometry.region import Disc

NOISE, THRESHOLD = 0.01, 0.05


@pytest.fixture(scope="module")
def frames(world):
    """Every fifth contact of the world, in random order: frames, readings (B, n), their rows."""
    rows = np.random.default_rng(0).permutation(len(world.points))[: len(world.points) // 5]
    readings = recorded(world, 1)[rows]
    return ms.ContactFrames(world.points[rows], world.force[rows]), readings


def recorded(world, seed):
    """Noisy readings (m, n) of all contacts of the world."""
    exact = world.pressures()
    noise = np.random.default_rng(seed).normal(size=exact.shape)
    return np.maximum(exact + NOISE * world.peak_reference * noise, 0.0)


def run(world, frames, readings, block=10, previous=None):
    """An online calibration of the frames, in blocks."""
    online = ms.OnlineCalibration(world.belief(NOISE, THRESHOLD), previous)
    for begin in range(0, len(frames), block):
        rows = slice(begin, begin + block)
        online.update(frames.take(rows), readings[rows])
    return online


@pytest.fixture(scope="module")
def online(world, frames):
    """All frames in blocks, settled."""
    online = run(world, *frames)
    online.settle()
    return online


@pytest.fixture(scope="module")
def batch(online):
    """What `ms.calibrate` makes of the same contacts."""
    return ms.calibrate(online.recording(), online.belief)


def sigmas_apart(online, calibration):
    """Distances (n,) of online positions from those of a calibration, in standard deviations."""
    gap = np.linalg.norm(online.positions - calibration.positions, axis=1)
    return gap / calibration.position_sigma


@pytest.mark.deep
def test_the_running_estimate_is_the_batch_estimate(online, batch):
    found = np.isfinite(batch.positions[:, 0])
    assert np.array_equal(np.isfinite(online.positions[:, 0]), found)
    assert found.sum() > 0.8 * len(found)
    assert sigmas_apart(online, batch)[found].max() < 0.01
    assert np.allclose(online.position_sigma[found], batch.position_sigma[found], rtol=0.02)
    ours, theirs = online.status.unknowns["modulus"], batch.unknowns["modulus"]
    assert abs(ours[0] - theirs[0]) < 0.01 * theirs[1]
    assert ours[1] == pytest.approx(theirs[1], rel=0.01)
    status = online.status
    assert (status.used, status.rejected) == (len(online.recording().time), 0)
    assert status.determined + status.weak + status.unseen == len(online.ids)
    assert status.waiting == 0
    assert status.median_sigma == pytest.approx(np.median(online.position_sigma[found]))


@pytest.mark.deep
def test_one_by_one_in_another_order_gives_the_same(world, frames, batch):
    contacts, readings = frames
    contacts, readings = contacts.take(slice(None, None, -1)), readings[::-1]
    other = run(world, contacts.take(slice(0, 50)), readings[:50], block=1)
    for begin in (50, 100, 150):
        rows = slice(begin, begin + 50 if begin < 150 else None)
        other.update(contacts.take(rows), readings[rows])
    other.settle()
    found = np.isfinite(batch.positions[:, 0])
    assert sigmas_apart(other, batch)[found].max() < 0.01


@pytest.mark.deep
def test_lane_after_lane_it_stays_at_the_batch_estimate(world):
    """Frame by frame without `settle`, as contacts come in an exploration."""
    lanes = np.lexsort((world.points[:, 1], np.round(world.points[:, 0] / 5e-3)))[::4]
    contacts = ms.ContactFrames(world.points[lanes], world.force[lanes])
    online = run(world, contacts, recorded(world, 1)[lanes], block=1)
    batch = ms.calibrate(online.recording(), online.belief)
    assert (online.status.waiting, online.status.verdict) == (0, "done")
    assert np.isfinite(online.positions[:, 0]).sum() > 0.95 * len(world.ids)
    assert np.nanmax(sigmas_apart(online, batch)) < 0.006  # 0.0105 at a TOLERANCE of 0.003


@pytest.mark.slow
def test_frames_without_contacts_catch_up_with_the_batch_estimate(world, frames, batch):
    """Contacts in random order move more taxels than a frame estimates anew."""
    online = run(world, *frames, block=1)
    assert online.status.waiting > 10
    pause, readings = frames[0].take(slice(0, 0)), frames[1][:0]
    for _ in range(500):  # 10 s
        online.update(pause, readings)
    assert online.status.waiting == 0
    found = np.isfinite(batch.positions[:, 0])
    assert np.array_equal(np.isfinite(online.positions[:, 0]), found)
    assert sigmas_apart(online, batch)[found].max() < 0.006


def test_the_final_calibration_is_that_of_the_batch_estimator(online, batch):
    final = online.calibration()
    found = np.isfinite(batch.positions[:, 0])
    gap = np.linalg.norm(final.positions - batch.positions, axis=1)[found]
    assert (gap < 0.01 * batch.position_sigma[found]).all()


@pytest.mark.deep
def test_outliers_and_dead_taxels_are_left_out_and_counted(world, frames, batch):
    contacts, readings = frames
    rng, readings = np.random.default_rng(3), readings.copy()
    hit = np.argwhere(readings > THRESHOLD * world.peak_reference)
    bad = hit[rng.random(len(hit)) < 0.02]
    readings[tuple(bad.T)] = world.peak_reference * rng.uniform(0.2, 1.0, len(bad))
    readings[:, 3] = 0.0
    online = run(world, contacts, readings)
    status = online.settle()
    assert status.unseen == 1
    assert status.outlying + status.rejected > 0.5 * len(bad)
    assert not np.isfinite(online.positions[3]).any()
    found = np.isfinite(online.positions[:, 0])
    assert found.sum() > 0.8 * np.isfinite(batch.positions[:, 0]).sum()
    error = np.linalg.norm(online.positions - world.truth, axis=1)[found]
    assert (error < 5 * online.position_sigma[found]).all()


@pytest.mark.deep
def test_an_unknown_noise_is_estimated_on_the_way(world, frames):
    contacts, readings = frames
    online = ms.OnlineCalibration(world.belief(None, THRESHOLD))
    for begin in range(0, len(contacts), 50):
        rows = slice(begin, begin + 50)
        status = online.update(contacts.take(rows), readings[rows])
    assert status.verdict != "model misfit"
    online.settle()
    batch = ms.calibrate(online.recording(), online.belief)
    found = np.isfinite(batch.positions[:, 0])
    assert np.array_equal(np.isfinite(online.positions[:, 0]), found)
    assert sigmas_apart(online, batch)[found].max() < 0.01
    assert np.allclose(online.position_sigma[found], batch.position_sigma[found], rtol=0.05)
    noise = online.estimate.store.template.noise
    assert noise == pytest.approx(batch.fit.noise, rel=0.02)
    assert noise == pytest.approx(NOISE * world.peak_reference, rel=0.15)


def test_normal_equations_are_those_of_another_unit(world, frames):
    """Rescaled there and back."""
    belief = world.belief(NOISE, THRESHOLD, unknown=("modulus", "gain", "offset"))
    online = ms.OnlineCalibration(belief)
    online.update(frames[0].take(slice(0, 60)), frames[1][:60])
    info = online.estimate.information
    rows = np.flatnonzero(info.placed)
    points, before = info.points(rows), pickle.loads(pickle.dumps(info))
    info.rescale(0.5)
    assert np.allclose(info.prior, before.prior * [1, 1, 1, 4])
    assert np.allclose(info.nuisance[:, 1], before.nuisance[:, 1] / 2)
    assert info.covariance[rows, 0, 0].min() > before.covariance[rows, 0, 0].min()
    info.rescale(2.0)
    assert np.allclose(info.points(rows), points, atol=1e-9)
    assert np.allclose(info.covariance[rows], before.covariance[rows], rtol=1e-6)


@pytest.mark.deep
def test_a_recalibration_serves_as_the_previous_calibration(sphere):
    few = sphere.with_(skin=ms.Skin(sphere.skin.poses[:12], sphere.skin.ids[:12]))
    found = ms.recalibrate(few.skin, ms.press(few, few.skin.positions), few.belief())
    assert ms.OnlineCalibration(few.belief(), found).previous is found.calibration


def test_taxels_that_moved_are_named(online, batch):
    shifted = batch.poses.copy()
    shifted[:4, :3, 3] += 0.5e-3 * shifted[:4, :3, 0]
    everywhere = np.ones(len(online.ids), dtype=bool)
    for previous, moved in ((batch, 0), (replace(batch, poses=shifted), 4)):
        judge = Judge(online.ids, previous, everywhere, 1e-4)
        judge.look(online.estimate, Counter())
        known = np.isfinite(batch.positions[:4, 0]).sum() if moved else 0
        assert judge.moved.sum() == judge.moved[:4].sum() == known
        verdict = judge.verdict(online.position_sigma, everywhere)[0]
        assert (verdict == "moved since the last calibration") == bool(moved)


@pytest.mark.deep
def test_a_wrong_noise_is_a_misfit_and_widens_the_covariances(world, frames):
    contacts, readings = frames
    online = ms.OnlineCalibration(world.belief(NOISE / 3, THRESHOLD))
    rows = slice(0, 100)
    status = online.update(contacts.take(rows), readings[rows])
    assert status.verdict == "model misfit"
    assert "times the noise" in status.why
    found = np.isfinite(online.positions[:, 0])
    error = np.linalg.norm(online.positions - world.truth, axis=1)[found]
    assert (error < 4 * online.position_sigma[found]).all()


@pytest.mark.deep
def test_it_goes_on_after_pickling(world, frames):
    contacts, readings = frames
    first = run(world, contacts.take(slice(0, 30)), readings[:30])
    again = pickle.loads(pickle.dumps(first))
    rows = slice(30, 40)
    for online in (first, again):
        online.update(contacts.take(rows), readings[rows])
        online.settle()
    assert np.allclose(first.provisional, again.provisional, rtol=0, atol=1e-8, equal_nan=True)
    assert str(first.status) == str(again.status)


@pytest.mark.slow
def test_the_contacts_of_a_recording_are_those_of_its_frames(world):
    world = type(world)(extent=10e-3, step=1e-3)
    recording, belief = world.record(NOISE, THRESHOLD), world.belief(NOISE, THRESHOLD)
    first, again = ms.OnlineCalibration(belief), ms.OnlineCalibration(belief)
    dense = np.zeros((len(recording.time), len(world.ids)))
    dense[recording.reading_contact, np.searchsorted(world.ids, recording.reading_taxel)] = (
        recording.pressure
    )
    contacts = ms.ContactFrames(recording.points, recording.force, time=recording.time)
    assert str(first.update_recording(recording)) == str(again.update(contacts, dense))
    np.testing.assert_array_equal(first.positions, again.positions)
    assert first.status.determined > 0


def test_recordings_that_calibrate_refuses_are_refused(world):
    recording = world.record(NOISE, THRESHOLD)
    copied = pa.concat_tables([recording.readings, recording.readings.slice(0, 3)])
    online = ms.OnlineCalibration(world.belief(NOISE, THRESHOLD))
    with pytest.raises(RecordingError, match=r"read twice in one contact, .* 3 in all"):
        online.update_recording(replace(recording, readings=copied))
    few = world.belief(NOISE, THRESHOLD, taxel_ids=world.ids[:-2])
    with pytest.raises(CalibrationError, match=r"does not know, got ids .* limit: \d+ ids from"):
        ms.OnlineCalibration(few).update_recording(recording)
    with pytest.raises(ConfigError, match="recording of an update must be"):
        online.update_recording(world.points)
    assert online.frames == 0


def test_frames_of_another_shape_are_refused():
    """Arrays that were transposed have the right size."""
    points = np.zeros((3, 3))
    with pytest.raises(RecordingError, match=r"contact points must be vectors, got shape \(3, 2\)"):
        ms.ContactFrames(np.zeros((3, 2)), 3.0)
    with pytest.raises(RecordingError, match=r"errors of contact frames, got shape \(3, 2\)"):
        ms.ContactFrames(points[:2], 3.0, errors=np.zeros((3, 2)))
    with pytest.raises(RecordingError, match=r"headings of contact frames, got shape"):
        ms.ContactFrames(points, 3.0, headings=np.zeros((9, 3)))
    one = ms.ContactFrames(points[0], 3.0, headings=np.eye(3), time=0.5, errors=points[0])
    assert one.points.shape == one.errors.shape == (1, 3)
    assert (one.headings.shape, one.time.shape) == ((1, 3, 3), (1,))
    with pytest.raises(RecordingError, match=r"forces of contact frames, got shape \(2,\)"):
        ms.ContactFrames(points, [3.0, 3.0])
    with pytest.raises(RecordingError, match="headings of contact frames"):
        ms.ContactFrames(points, 3.0, headings=[np.eye(3), np.eye(2), np.eye(3)])


def test_readings_and_beliefs_that_only_a_batch_can_use_are_refused(world):
    online = ms.OnlineCalibration(world.belief(NOISE, THRESHOLD))
    with pytest.raises(RecordingError, match="a reading of every taxel"):
        online.update(ms.ContactFrames([0.0, 0.0, -0.1], 3.0), np.zeros(7))
    with pytest.raises(CalibrationError, match="first"):
        online.calibration()
    for change in ({"readings": "raw"}, {"contact": "learned"}, {"module_slots": np.zeros((4, 3))}):
        with pytest.raises(CalibrationError, match=r"ms\.calibrate"):
            ms.OnlineCalibration(world.belief(NOISE, THRESHOLD, **change))
    with pytest.raises(ConfigError, match="the previous calibration must be"):
        ms.OnlineCalibration(world.belief(NOISE, THRESHOLD), previous=world.truth)
    far = ms.ContactFrames([0.0, 0.0, -100.0], 3.0)
    with pytest.raises(CalibrationError, match="not on the believed body"):
        online.update(far, np.zeros(len(world.ids)))


@pytest.mark.slow
def test_no_false_alarm_over_seeds(world):
    rows = np.random.default_rng(0).permutation(len(world.points))[:200]
    contacts = ms.ContactFrames(world.points[rows], world.force[rows])
    previous, alarms = None, []
    for seed in range(20):
        online = run(world, contacts, recorded(world, seed)[rows], previous=previous)
        alarms += [online.status.verdict] * (online.status.verdict not in ("keep going", "done"))
        online.settle()
        previous = online.calibration()
    assert not alarms  # 39 tests of 1e-3: an alarm with a probability of 4 %


def on_capsule(noise=0.01):
    """A capsule, whose end caps are round and whose side is not, with readings of its side: scene,
    contact points, readings (m, n)."""
    body = ms.Body.capsule(0.03, 0.1)
    skin = ms.Skin.cover(body, spacing=7e-3, count=12, seed=1, region=Disc((0.03, 0, 0), 0.03))
    scene = ms.Scene.load("sphere").with_(body=body, skin=skin)
    rng = np.random.default_rng(0)
    near = skin.positions[rng.integers(12, size=150)] + rng.normal(scale=5e-3, size=(150, 3))
    recording = ms.press(scene, body.closest(near).point, seed=1)
    return scene, recording


@pytest.mark.deep
def test_a_contact_model_that_the_first_contact_suggests_gives_way():
    """The first contact is on the end cap, where Hertz' circle holds, all others are not."""
    scene, recording = on_capsule()
    belief = scene.belief(contact="auto", noise_sigma=100.0, threshold=500.0)
    online = ms.OnlineCalibration(belief)
    online.update(ms.ContactFrames([0.0, 0.0, 0.08], 3.0), np.zeros(12))
    assert online.estimate.store.template.model.name == "hertz"
    status = online.update_recording(recording)
    assert online.estimate.store.template.model.name == "elliptic"
    assert (status.used, status.rejected) == (len(recording.time) + 1, 0)
    assert (np.diff(online.recording().time) > 0).all()


@pytest.mark.deep
def test_a_light_first_contact_does_not_set_the_priors(sphere):
    """Of a force offset that is unknown: its prior is relative to the reference force."""
    skin, rng = ms.Skin.cover(sphere.body, spacing=6e-3, count=7, seed=1), np.random.default_rng(0)
    near = skin.positions[rng.integers(7, size=100)] + rng.normal(scale=4e-3, size=(100, 3))
    force = np.append(0.02, rng.uniform(1.0, 4.0, 99))
    scene = sphere.with_(skin=skin)
    recording = ms.press(scene, sphere.body.closest(near).point, force, seed=1)
    belief = scene.belief(
        unknown=("modulus", "force_offset"), force_reference=None, noise_sigma=100.0,
        threshold=500.0,
    )  # fmt: skip
    online, frames = ms.OnlineCalibration(belief), RecordedFrames(recording, scene.skin.ids)
    for k in range(100):
        online.update(*frames.part(k, k + 1))
    prior = online.estimate.parameters.sigma[1]
    assert prior == pytest.approx(0.3 * np.median(force), rel=0.1)
    assert online.estimate.information.weight[1] == pytest.approx(prior**-2)
    online.settle()
    batch = ms.calibrate(online.recording(), belief)
    assert sigmas_apart(online, batch).max() < 0.01
    ours, theirs = (x.unknowns["force_offset"] for x in (online.status, batch))
    assert abs(ours[0] - theirs[0]) < 0.01 * theirs[1]


@pytest.mark.parametrize(
    ("off", "why"), [(True, "contacts are rejected, off the believed body"), (False, "do not fit")]
)
def test_a_misfit_is_said_when_most_data_are_bad(world, frames, off, why):
    """Most contacts off the body; readings of other frames."""
    contacts, readings = frames
    at, m = contacts.points[:120].copy(), 120
    if off:
        at[30:] *= 1.5
    else:
        readings = readings[np.random.default_rng(0).permutation(m)]
    status = run(world, ms.ContactFrames(at, contacts.force[:m]), readings[:m]).status
    assert status.verdict == "model misfit"
    assert why in status.why


@pytest.mark.deep
def test_contacts_that_were_rejected_too_early_come_back(world, frames):
    """Under an E* of three times the true one, sound contacts contradict the first estimates."""
    contacts, readings = frames
    wrong = replace(world.belief(NOISE, THRESHOLD).material, young=3 * world.young)
    online = ms.OnlineCalibration(world.belief(NOISE, THRESHOLD, material=wrong))
    for k in range(len(contacts)):
        status = online.update(contacts.take(slice(k, k + 1)), readings[k])
    before = status.rejected
    assert before > 0
    assert online.settle().rejected < before / 3


@pytest.mark.deep
def test_the_first_lane_is_no_misfit():
    """Of a lane, taxels can be on either side: one on the wrong side does not fit."""
    scene = ms.Scene.load("sphere_noisy")
    log = ms.simulate(scene, seed=3)
    online = ms.OnlineCalibration(scene.belief())
    frames = RecordedFrames(log, online.belief.taxel_ids)
    for begin in range(0, 200, 2):
        assert online.update(*frames.part(begin, begin + 2)).verdict == "keep going"


@pytest.mark.deep
def test_late_readings_are_a_misfit(world):
    """By two frames; lanes go to and fro."""
    every = np.arange(len(world.points)).reshape(12, -1)[:, ::2]
    every[1::2] = every[1::2, ::-1]
    lanes = every[:9].ravel()
    contacts = ms.ContactFrames(world.points[lanes], world.force[lanes])
    status = run(world, contacts, np.roll(recorded(world, 1)[lanes], 2, axis=0)).status
    assert status.verdict == "model misfit"
    assert "2 frames too late" in status.why


def test_noise_above_a_threshold_of_zero_is_no_response(world):
    """Half of the untouched taxels have readings of noise in each frame."""
    rows = np.arange(len(world.points))[:600:4]
    online, said = ms.OnlineCalibration(world.belief(NOISE, 0.0)), set()
    readings = recorded(world, 2)[rows]
    for begin in range(0, len(rows), 10):
        part = rows[begin : begin + 10]
        frames = ms.ContactFrames(world.points[part], world.force[part])
        said.add(online.update(frames, readings[begin : begin + 10]).verdict)
    assert said == {"keep going"}
    assert online.status.unseen > 5
    assert np.sum(readings > 0, axis=0).min() > 20
    error = np.linalg.norm(online.positions - world.skin.positions, axis=1)
    assert np.nanmax(error / online.position_sigma) < 5


def test_a_reading_that_is_not_finite_is_lost(world, frames):
    contacts, readings = frames
    readings = readings[:60].copy()
    readings[5, np.argmax(readings[5])] = np.inf
    online = run(world, contacts.take(slice(0, 60)), readings)
    read = online.estimate.store.counts > 0
    assert np.isfinite(online.estimate.store.means[read]).all()
    assert (online.update(contacts.take(slice(0, 0)), [])).used == 60


def test_large_ids_are_kept(world, frames):
    ids = np.asarray(world.ids) + 3_000_000_000
    online = ms.OnlineCalibration(world.belief(NOISE, THRESHOLD, taxel_ids=ids))
    online.update(frames[0].take(slice(0, 20)), frames[1][:20])
    assert set(online.recording().reading_taxel) <= set(ids.tolist())
