"""Outlying readings and faulty taxels: detected, named, without effect on the others."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from scipy.stats import chi2, norm

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import fault_detection, outlier_rejection
from meshskin.estimation.joint.pressure import CENSORED, OBSERVED
from meshskin.estimation.joint.readings import Readings
from meshskin.estimation.uncertainty.metrics import nees, position_errors
from meshskin.recording.recording import READING_SCHEMA, Recording


@pytest.fixture(scope="module")
def clean(world):
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    found = calibrate(recording, belief)
    return recording, belief, position_errors(found, world.skin), found


def others(errors, bad, reference):
    """Mean error of the taxels that are not `bad`, relative to the clean estimate's."""
    keep = np.setdiff1d(np.arange(len(errors)), bad)
    return errors[keep].mean() / reference[keep].mean()


def test_a_sound_recording_has_no_faults_and_fits(clean):
    found = clean[3]
    assert not any(found.faults)
    assert found.fit.good
    assert 0.9 < found.fit.reduced < 1.15
    assert "fits" in found.fit.words


@pytest.mark.deep
@pytest.mark.parametrize(
    ("share", "noise"),
    [
        (0.2, 0.01),
        *(
            pytest.param(*k, marks=pytest.mark.deep)
            for k in ((0.02, None), (0.02, 0.01), (0.2, None))
        ),
    ],
)
def test_outlying_readings(world, clean, change, share, noise):
    recording, _, reference, _ = clean
    rng = np.random.default_rng(5)
    hit = rng.random(len(recording.pressure)) < share
    wild = rng.uniform(0.05, 2, len(hit)) * world.peak_reference
    bent = change(recording, pressure=np.where(hit, wild, recording.pressure))
    found = calibrate(bent, world.belief(noise, 0.05))
    error = position_errors(found, world.skin)
    # the readings that are left allow no better than 1 / sqrt(1 - share)
    assert error.mean() < 1.25 / np.sqrt(1 - share) * reference.mean()
    named = sum(int(f.split()[0]) for f in found.faults if "outlying" in f)
    assert 0.75 * hit.sum() < named < 1.15 * hit.sum()
    if noise:
        assert nees(found, world.skin).mean() < 3.0
        assert f"{named} outlying" in found.fit.words


def test_readings_that_were_lost_are_not_taken_for_silence(world, clean, change):
    recording, belief, reference, _ = clean
    keep = np.random.default_rng(5).random(len(recording.pressure)) > 0.2
    found = calibrate(change(recording, keep=keep), belief)
    assert position_errors(found, world.skin).mean() < 1.5 * reference.mean()
    assert any("missing where taxels read strongly" in why for why in found.verdict.reasons)


def test_a_stuck_taxel(world, clean):
    recording, belief, reference, _ = clean
    time = recording.time
    constant = np.full(len(time), 0.4 * world.peak_reference)
    ids = np.full(len(time), world.ids[7], dtype=np.int32)
    kept = recording.readings.filter(pa.array(recording.reading_taxel != world.ids[7]))
    table = pa.concat_tables([kept, pa.table([time, ids, constant], schema=READING_SCHEMA)])
    found = calibrate(Recording(recording.contacts, table, recording.metadata), belief)
    assert found.faults[7].startswith("stuck at 31.")
    assert not found.observed[7].any()
    assert np.isnan(found.positions[7]).all()
    assert others(position_errors(found, world.skin), [7], reference) < 1.05


def test_a_channel_that_holds_the_readings_of_another(world, clean):
    """Neither has a place; all others do."""
    recording, belief, reference, _ = clean
    near = np.argsort(np.linalg.norm(world.skin.positions - world.skin.positions[7], axis=1))[1]
    taxel, table = recording.reading_taxel, recording.readings
    column = table.column_names.index("taxel")
    copy = table.filter(pa.array(taxel == world.ids[near]))
    copy = copy.set_column(column, "taxel", pa.array(np.full(len(copy), world.ids[7], np.int32)))
    table = pa.concat_tables([table.filter(pa.array(taxel != world.ids[7])), copy])
    found = calibrate(Recording(recording.contacts, table, recording.metadata), belief)
    lost = np.flatnonzero(np.isnan(found.positions[:, 0]))
    assert set(lost) == {7, near}
    assert found.reasons[7] == f"its readings are equal to those of taxel {world.ids[near]}"
    assert others(position_errors(found, world.skin), lost, reference) < 1.1


def test_a_taxel_stuck_on_a_small_skin(world):
    recording, id_ = world.record(0.01, 0.05), world.ids[7]
    away = np.linalg.norm(world.points - world.truth[7], axis=1)
    small = away < 15e-3  # contacts spread 1.7 times as far as one is felt
    time = recording.time[small]
    others = small[recording.reading_contact] & (recording.reading_taxel != id_)
    constant = np.full(len(time), 0.5 * world.peak_reference)
    spoilt = pa.table([time, np.full(len(time), id_, np.int32), constant], schema=READING_SCHEMA)
    table = pa.concat_tables([recording.readings.filter(pa.array(others)), spoilt])
    bent = Recording(recording.contacts, table, recording.metadata)
    assert list(fault_detection.stuck_taxels(gather(bent, world.belief(0.01, 0.05))).rows) == [7]


def test_a_taxel_touched_on_a_ring_is_not_stuck(world, change):
    """All its readings are alike, and the belief has it feel less far than it does."""
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05, young=3 * world.young)
    away = np.linalg.norm(world.points - world.truth[7], axis=1)[recording.reading_contact]
    own = recording.reading_taxel == world.ids[7]
    ring = own & (np.abs(away - 5e-3) < 0.3e-3)
    alike = recording.pressure[ring]
    assert alike.std() < 3 * belief.noise_sigma
    assert alike.mean() > 3 * alike.std()
    assert not len(
        fault_detection.stuck_taxels(gather(change(recording, keep=ring | ~own), belief)).rows
    )


def test_a_taxel_that_fails_during_the_recording(world, clean, change):
    recording, belief, reference, _ = clean
    late = recording.reading_contact > len(recording.time) / 2
    keep = ~(late & (recording.reading_taxel == world.ids[9]))
    found = calibrate(change(recording, keep=keep), belief)
    assert "silent in" in found.faults[9]
    assert others(position_errors(found, world.skin), [9], reference) < 1.05


@pytest.mark.slow
def test_many_taxels_with_a_loose_wire(world, clean, change):
    recording, belief, reference, _ = clean
    dying = np.arange(0, len(world.ids), 5)
    off = recording.reading_contact % 40 > 20
    keep = ~(off & np.isin(recording.reading_taxel, world.ids[dying]))
    found = calibrate(change(recording, keep=keep), belief)
    assert found.fit.good  # what they do not say is not held against the model
    assert np.array_equal(np.flatnonzero(found.faults != ""), dying)
    assert others(position_errors(found, world.skin), dying, reference) < 1.05


def test_a_misfit_that_all_taxels_share_is_no_fault_of_any(world):
    """With twice the believed noise no taxel is further off than most."""
    found = calibrate(world.record(0.02, 0.05), world.belief(0.01, 0.05))
    assert not any(found.faults)
    assert not found.fit.good


@pytest.mark.slow
def test_drifting_taxels_with_most_readings_are_the_faulty_ones(world, clean):
    """A fifth of the taxels gives three quarters of the readings: the typical taxel is sound."""
    recording, belief, reference, _ = clean
    warm, time = np.arange(0, len(world.ids), 5), recording.time
    drift = 0.2 * world.peak_reference * np.arange(len(time)) / len(time)
    sound = ~np.isin(recording.reading_taxel, world.ids[warm])
    parts = [recording.readings.filter(pa.array(sound))]
    for k in warm:
        mine = recording.reading_taxel == world.ids[k]
        pressure = drift.copy()
        pressure[recording.reading_contact[mine]] += recording.pressure[mine]
        ids = np.full(len(time), world.ids[k], dtype=np.int32)
        parts.append(pa.table([time, ids, pressure], schema=READING_SCHEMA))
    found = calibrate(Recording(recording.contacts, pa.concat_tables(parts), {}), belief)
    assert np.array_equal(np.flatnonzero(found.faults != ""), warm)
    assert others(position_errors(found, world.skin), warm, reference) < 1.05


@pytest.mark.deep
def test_two_taxels_that_exchange_their_ids(world, clean, change, tmp_path):
    recording, belief, reference, _ = clean
    taxel, sometimes = recording.reading_taxel.copy(), recording.reading_contact % 10 > 6
    a, b = world.ids[[3, 20]]
    taxel[(recording.reading_taxel == a) & sometimes] = b
    taxel[(recording.reading_taxel == b) & sometimes] = a
    found = calibrate(change(recording, taxel=taxel), belief)
    assert f"swapped with {b}" in found.faults[3]
    assert f"swapped with {a}" in found.faults[20]
    error = position_errors(found, world.skin)
    assert error[[3, 20]].max() < 60e-6
    assert others(error, [3, 20], reference) < 1.05
    found.save(tmp_path / "c")
    again = Calibration.load(tmp_path / "c")
    assert list(again.faults) == list(found.faults)
    assert again.fit == found.fit
    assert "swapped with" in (tmp_path / "c.csv").read_text()


@pytest.mark.deep
def test_a_taxel_that_drifts(world, clean, change):
    recording, belief, reference, _ = clean
    drift = 0.2 * world.peak_reference * recording.reading_contact / len(recording.time)
    own = recording.reading_taxel == world.ids[11]
    found = calibrate(change(recording, pressure=recording.pressure + own * drift), belief)
    assert "outlying" in found.faults[11]
    assert others(position_errors(found, world.skin), [11], reference) < 1.05


@pytest.mark.deep
def test_a_wrong_model_gives_no_faults(world, clean):
    found = calibrate(clean[0], world.belief(0.01, 0.05, young=0.8 * world.young, unknown=()))
    assert not found.fit.good
    assert "does not fit" in found.fit.words
    assert not any(found.faults)


@pytest.mark.slow
def test_outlier_rejection_that_does_not_converge_is_dropped(world, clean, change, monkeypatch):
    """What was believed before is the answer, not an error."""
    recording = clean[0]
    hit = np.random.default_rng(5).random(len(recording.pressure)) < 0.02
    bent = change(recording, pressure=np.where(hit, 0.5 * world.peak_reference, recording.pressure))

    def lost(run, *_):
        run.reweight(np.full_like(run.likelihood.readings.weight, 0.5))
        raise CalibrationError("the joint estimate did not converge")

    monkeypatch.setattr(outlier_rejection, "irls", lambda *_: np.inf)
    plain = calibrate(bent, clean[1])
    monkeypatch.setattr(outlier_rejection, "irls", lost)
    found = calibrate(bent, clean[1])
    np.testing.assert_array_equal(found.positions, plain.positions)
    assert not found.fit.good


@pytest.mark.slow
def test_the_test_of_fit_is_calibrated(world):
    belief = world.belief(0.01, 0.05)
    fits = [calibrate(world.record(0.01, 0.05, seed), belief).fit for seed in range(12)]
    mean = np.mean([fit.reduced for fit in fits])
    assert abs(mean - 1) < 4 * np.sqrt(2 / fits[0].freedom / len(fits))
    unknown = calibrate(world.record(0.01, 0.05), world.belief(None, 0.05)).fit
    assert unknown.good
    assert unknown.noise == pytest.approx(0.01 * world.peak_reference, rel=0.1)


def test_mean_log_likelihood_of_a_mixture():
    """Against scipy's densities, two taxels of two and of one readings."""
    kind, taxel = np.array([OBSERVED, OBSERVED, OBSERVED, CENSORED]), np.array([0, 0, 1, 1])
    zero, one = np.zeros(4), np.ones(4)
    readings = Readings(taxel, taxel, zero, kind, taxel, one, one, np.array([0, 2, 4]))
    r, out = np.array([0.5, 30.0, -2.0, 0.0]), np.array([False, True, False, False])
    wild = 0.25  # half of the first taxel's readings, none of the second's
    sound = np.log((1 - wild) * norm.pdf([0.5, -2.0], scale=2.0))
    want = 0.25 * sound[0] + 0.25 * np.log(wild / 200.0) + 0.5 * sound[1]
    got = fault_detection.mean_log_likelihood(readings, r, 2.0, out, 200.0)
    assert got == pytest.approx(want, rel=1e-12)


@pytest.mark.deep
def test_more_outlying_readings_than_plausible_are_a_misfit(world, monkeypatch):
    """What is left must explain what was heard better than a misfit does."""
    recording = world.record(0.01, 0.05)
    seen = []

    def sift(run, suspects, scale, fixed):
        seen.append(scale)
        half = np.arange(len(run.likelihood.readings.weight)) % 2
        run.reweight(half.astype(float))  # every other reading for outlying
        return scale

    monkeypatch.setattr(outlier_rejection, "irls", sift)
    monkeypatch.setattr(fault_detection, "misfitting_taxels", lambda *_: np.arange(5))
    calibrate(recording, world.belief(0.005, 0.05))
    assert len(seen) == 2
    assert seen[0] == 1.0
    assert seen[1] > 1.5


def test_readings_just_beyond_the_noise_are_outlying(world, clean, change):
    """Five of a taxel are 5.3 standard deviations off: one of 1e7 sound readings is."""
    recording, belief, _, _ = clean
    own = np.flatnonzero(recording.reading_taxel == world.ids[18])[::10]
    exact = world.pressures()[recording.reading_contact[own], 18]
    pressure = recording.pressure.copy()
    pressure[own] = exact + 5.3 * belief.noise_sigma
    found = calibrate(change(recording, pressure=pressure), belief)
    assert list(np.flatnonzero(found.faults != "")) == [18]
    assert found.faults[18].startswith(f"{len(own)} of ")
    assert position_errors(found, world.skin)[18] < 4 * found.position_sigma[18]


@pytest.mark.deep
def test_no_more_than_a_third_of_the_readings_is_called_outlying(world, change):
    """The median breaks down at one half; before, outliers are judged by most residuals' scale."""
    world = type(world)(extent=10e-3)
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    rng = np.random.default_rng(7)
    hit = rng.random(len(recording.pressure)) < 0.45
    wild = rng.uniform(0.05, 2, len(hit)) * world.peak_reference
    found = calibrate(change(recording, pressure=np.where(hit, wild, recording.pressure)), belief)
    named = sum(int(f.split()[0]) for f in found.faults if "outlying" in f)
    assert named < 0.35 * len(hit)
    assert found.fit.good is False


def test_a_taxel_misfits_beyond_chance_and_by_more_than_the_model():
    """By the chi-square of 100 readings, two of them used up by its position."""
    count = 100
    taxel, one = np.zeros(count, dtype=int), np.ones(count)
    kind = np.full(count, OBSERVED)
    readings = Readings(taxel, taxel, one, kind, taxel, one, one, np.array([0, count]))

    def misfits(square):
        return len(fault_detection.misfitting_taxels(readings, np.full(count, square**0.5), 1.0))

    rare, common = (chi2.isf(p, count - 2) / count for p in (1e-11, 1e-7))
    assert (misfits(rare), misfits(common)) == (1, 0)


@pytest.mark.parametrize("answering", [False, True])
def test_silence_accuses_where_others_answer(answering):
    """Silent readings expected at up to 8 sigma over the threshold of 5: all that are expected at
    less than 10, and most up to 13, or 5 of 67 that are expected there."""
    one = np.ones(200)
    expected = np.concatenate([np.linspace(5.1, 13.0, 100), np.linspace(10.0, 30.0, 100)])
    if answering:
        expected = np.concatenate([np.linspace(5.1, 13.0, 5), np.linspace(5.0, 30.0, 195)])
    silent = np.arange(200) < (5 if answering else 100)
    kind = np.where(silent, CENSORED, OBSERVED)
    level = np.where(silent, 5.0, expected)
    taxel = np.arange(200) % 2
    order = np.argsort(taxel, kind="stable")
    parts = (np.arange(200), taxel, level, kind, np.arange(200), one, one)
    readings = Readings(*(part[order] for part in parts), np.array([0, 100, 200]))
    r = fault_detection.residuals(readings, expected[order], 1.0)
    left = fault_detection.beyond_edge(readings, r, 1.0)
    np.testing.assert_array_equal(left[~silent[order]], r[~silent[order]])
    if answering:
        np.testing.assert_allclose(left, r, atol=0.2)
    else:
        assert r.max() > 7.9
        assert not left[silent[order]].any()


def test_the_scale_of_the_noise_is_that_of_readings_off_edges():
    """Each other reading is over an edge, which changes it by five times the noise."""
    count, scale, edge = 400, 0.2, 5.0
    taxel, one, over = np.arange(count) % 2, np.ones(count), np.arange(count) % 4 < 2
    taxel = np.sort(taxel)
    precision = np.where(over, 1 / (1 + edge**2), 1.0)
    kind = np.full(count, OBSERVED)
    starts = np.array([0, count // 2, count])
    readings = Readings(taxel, taxel, one, kind, taxel, one, precision, starts)
    normal = norm.ppf((np.random.default_rng(1).permutation(count) + 0.5) / count)
    wide = normal * np.where(over, np.sqrt(scale**2 + edge**2), scale) * np.sqrt(precision)
    silent = np.where(over, 0.0, scale * normal)  # the model happens to hold over the edges
    for r in (wide, silent):
        for scale_of in (fault_detection.reading_scale, fault_detection.taxel_scale):
            assert scale_of(readings, r) == pytest.approx(scale, rel=0.1)
        assert not len(fault_detection.misfitting_taxels(readings, r, scale))
    np.testing.assert_allclose(np.std(wide / fault_detection.spread(readings, scale)), 1, rtol=0.1)


@pytest.mark.parametrize(("presses", "fault"), [(1, False), (2, False), (4, True)])
def test_a_taxel_that_ignores_several_presses_is_faulty(presses, fault):
    """One or two outlying silences may be lost readings, four are a dead taxel."""
    taxel, one = np.zeros(10, dtype=int), np.ones(10)
    weight = np.where(np.arange(10) < presses, 0.1, 1.0)
    kind = np.full(10, CENSORED)
    readings = Readings(taxel, taxel, one, kind, taxel, weight, one, np.array([0, 10]))
    assert fault_detection.unanswered_presses(readings).all() == fault


@pytest.fixture(scope="module")
def far_side():
    """A scene without a threshold, and its recording: half of the readings are noise, also in
    contacts under the normal of which the taxel lies on the far side of the body."""
    body = ms.Body.sphere(0.02)
    scene = ms.Scene(
        body=body,
        skin=ms.Skin.cover(body, spacing=8e-3, seed=1),
        indenter=ms.Indenter.sphere(5e-3),
        effects=[ms.effects.find("gaussian_noise")(sigma_relative=0.01)],
        law=ms.Law(force_reference=0.5),
        loop=ms.Loop(mode="quasi_static"),
        readout=ms.Readout(rate=30.0),
    )
    return scene, ms.simulate(scene, seed=1)


@pytest.mark.deep
@pytest.mark.parametrize("noise", ["known", "unknown"])
def test_noise_in_contacts_on_the_far_side_is_no_fault(far_side, noise):
    scene, recording = far_side
    belief = scene.belief() if noise == "known" else replace(scene.belief(), noise_sigma=None)
    found = ms.calibrate(recording, belief)
    assert not any(found.faults)
    assert found.verdict.level == "PASS"
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    assert np.max(error / found.position_sigma) < 4.5
