"""A skin, joint offsets and a clock offset from joint angles and raw counts alone."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError, ConfigError, LeftOutWarning, RecordingError
from meshskin.estimation.calibrate import Estimation, calibrate
from meshskin.estimation.kinematics import calibrate_log as log_module
from meshskin.estimation.kinematics.calibrate_log import calibrate_log
from meshskin.estimation.kinematics.clock import first_offset, timed_by_the_fastest
from meshskin.estimation.kinematics.heights import Heights
from meshskin.estimation.uncertainty.metrics import cramer_rao, nees, position_errors
from meshskin.recording.log_contacts import at_clock, contact_frames, joint_path, recording_of

from .simulated_log import CLOCK, explore

KNOWN = {
    "joint_offset": np.radians(1.0),
    "joint_delay": 0.02,
    "indenter_position": 2e-4,
    "clock_offset": 0.05,
}


@pytest.fixture(scope="module")
def small():
    """37 taxels, at three headings, 25 frames a second."""
    return explore(headings=(0, 90, 210), taxels=37, frame=0.04)


def belief(exploration, **changes):
    values = {"readings": "raw", "contact": "learned", "noise_sigma": None, "threshold": 0.0}
    return exploration.scene.belief(**values | changes)


def check(exploration, found, ratio, already=0.0):
    """Clock to 2 ms, joints to 0.1 degree, taxels to `ratio` of the bound that knows both.

    already: offset of the clocks that the log was corrected by, s.
    """
    for label, (value, sigma) in found.unknowns.items():
        truth = exploration.truth(label) - (already if label == "clock_offset" else 0.0)
        assert abs(value - truth) < 4 * sigma, label
    value, sigma = found.unknowns["clock_offset"]
    assert abs(value + already - exploration.truth("clock_offset")) < 2e-3
    assert sigma < 2e-3
    for name, (value, sigma) in found.joint_offsets.items():
        truth = exploration.truth(f"joint_offset {name}")
        assert abs(value - truth) < np.radians(0.1), name
        assert sigma < np.radians(0.1), name
    bound = cramer_rao(
        exploration.recording,
        exploration.scene.belief(unknown=("modulus", "gain", "offset")),
        exploration.scene.skin,
    )
    errors = position_errors(found.calibration, exploration.scene.skin)
    assert np.sqrt(np.mean(errors**2)) < ratio * bound.rms
    assert np.mean(nees(found.calibration, exploration.scene.skin)) < 3.0


@pytest.mark.deep
def test_an_indenter_deeper_than_its_radius_is_refused(small):
    kinematics = small.kinematics(**KNOWN)
    raised = replace(kinematics, indenter=kinematics.indenter + np.array([0, 0, 0.01]))
    with pytest.raises(CalibrationError, match=r"deeper than the indenter, got 1.* mm, limit: its"):
        calibrate_log(small.log, raised, belief(small))


@pytest.fixture(scope="module")
def explored(small):
    """The calibration of the small exploration, and the clocks that its rounds began with."""
    clocks = []

    def spied(log, offset):
        clocks.append(offset)
        return at_clock(log, offset)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("meshskin.estimation.kinematics.calibrate_log.at_clock", spied)
        return calibrate_log(small.log, small.kinematics(**KNOWN), belief(small)), clocks


@pytest.mark.deep
def test_a_small_exploration(small, explored):
    found, clocks = explored
    assert clocks[-1] == pytest.approx(CLOCK, abs=0.01)  # contacts are chosen where they happened
    check(small, found, 1.2)
    assert found.rounds <= 3
    assert np.median(found.calibration.position_sigma) < 1e-4
    assert np.median(np.abs(found.heights)) < 5e-5
    assert np.median(np.abs(found.heights_before)) > 1e-3
    assert found.contradictions == ()
    assert found.calibration.verdict.level == "PASS"
    assert found.moved == 0.0
    (contradiction,) = replace(found, moved=4e-4).contradictions
    assert contradiction.startswith(
        f"contacts still moved by 0.4 mm in the last of {found.rounds} round"
    )
    # without a determined taxel nothing warns of an empty median
    lost = replace(
        found.calibration, covariances=np.full_like(found.calibration.covariances, np.inf)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert replace(found, calibration=lost).contradictions == ()
    doubted = replace(found.kinematics, unknown=KNOWN | {"clock_offset": 5e-3})
    tight = replace(found, kinematics=doubted)
    (contradiction,) = tight.contradictions
    assert contradiction.startswith("clock_offset is 0.03")
    times = found.unknowns["clock_offset"][0] / 5e-3
    assert contradiction.endswith(f"{times:.2g} times its believed standard deviation of 0.005")
    values = found.calibration.parameter_values
    assert values["joint_offset joint4"][2] == "rad"
    assert values["clock_offset"][1:] == (found.unknowns["clock_offset"][1], "s")


@pytest.mark.deep
def test_contacts_of_a_small_exploration_are_where_they_happened(small, explored):
    """The same counts with the contacts as computed from the true angles' offsets and clock."""
    found, _ = explored
    frames = contact_frames(small.log)
    frames = frames[np.isin(small.log.time[frames], found.recording.time)]
    assert len(frames) > 440  # but for those in the gap between two passes, and averaged ones
    assert len(found.recording.time) > 480
    rows = np.flatnonzero(np.isin(small.frames, frames))
    happened = small.recording
    truth = recording_of(
        small.log, frames, happened.points[rows], happened.normals[rows], happened.force[rows]
    )
    own = np.isin(found.recording.time, small.log.time[frames])
    apart = np.linalg.norm(found.recording.points[own] - truth.points, axis=1)
    assert np.median(apart) < 2.5e-4
    alone = calibrate(truth, belief(small))
    assert any("follow from joint angles, whose errors" in why for why in alone.verdict.reasons)
    known = position_errors(alone, small.scene.skin)
    errors = position_errors(found.calibration, small.scene.skin)
    assert np.sqrt(np.mean(errors**2)) < 1.3 * np.sqrt(np.mean(known**2))


@pytest.mark.slow
def test_a_first_offset_that_comes_out_as_before_is_no_round_more(small, monkeypatch):
    """The readings say that the clock is 0.6 ms off, and the first offset is the same again."""
    begin = small.log.time[contact_frames(replace(small.log, force=None))][0]
    clock = CLOCK - 6e-4

    def again(model, path, time, readings, s):
        return clock - (begin - time[0])

    monkeypatch.setattr("meshskin.estimation.kinematics.calibrate_log.first_offset", again)
    monkeypatch.setattr("meshskin.estimation.kinematics.calibrate_log.APART", 2e-5)
    found = calibrate_log(small.log, small.kinematics(**KNOWN), belief(small))
    assert found.moved == 0.0
    assert found.calibration.verdict.level == "PASS"
    check(small, found, 1.2)


def rounds_that(monkeypatch, *given):
    """Let the rounds of a log end as given: by the displacement, m, that the linear table does not
    have, or by an error."""
    heights = SimpleNamespace(mesh_error=SimpleNamespace(sigma=0.0))
    found, ends = SimpleNamespace(unknowns={}, position_sigma=np.full(5, 1e-4)), iter(given)

    def estimated(*args):
        end = next(ends)
        if isinstance(end, Exception):
            raise end
        return log_module._Round(found, "recording", heights, end, 0.0, 1e-5, end)

    monkeypatch.setattr(log_module, "_started", lambda *args: ("log", 0.0, heights, 0.0))
    monkeypatch.setattr(log_module, "_estimated", estimated)
    log, known = SimpleNamespace(force=np.ones(3)), ms.Scene.load("sphere").belief(readings="raw")
    return log_module._last_round(log, None, None, known, None)


def test_a_round_that_fails_leaves_the_one_before(monkeypatch):
    last, rounds, failure = rounds_that(monkeypatch, 2e-5, 1e-5, CalibrationError("no end"))
    assert (last.x, rounds, failure) == (1e-5, 2, "no end")
    last, rounds, failure = rounds_that(monkeypatch, 2e-5, 1e-6)
    assert (last.x, rounds, failure) == (1e-6, 2, "")


def test_the_larger_displacement_is_that_of_a_round_that_is_not_at_rest():
    for moved, shift, expected in ((4e-6, 6e-4, 6e-4), (4e-6, 1e-5, 4e-6), (1e-6, 1e-5, 0.0)):
        last = log_module._Round(None, None, None, None, 0.0, shift, moved)
        assert last.unrest == expected


@pytest.mark.parametrize("before", [[], [1e-3]])
def test_a_round_that_fails_is_an_error_where_none_before_holds(monkeypatch, before):
    with pytest.raises(CalibrationError, match="no end"):
        rounds_that(monkeypatch, *before, CalibrationError("no end"))


def test_an_estimate_that_does_not_converge_fails_with_what_the_heights_tell(small, monkeypatch):
    """Every estimate counts as one that has steps left. A taxel that is far noisier than others has
    no readings."""
    log, taxel = small.log, int(small.log.taxel_ids[3])
    log = replace(log, noise=log.noise * np.where(log.taxel_ids == taxel, 20.0, 1.0))
    monkeypatch.setattr("meshskin.estimation.learned.estimate.MAX_DECREASE", -1.0)
    with pytest.warns(LeftOutWarning, match="the estimate did not converge"):
        found = calibrate_log(log, small.kinematics(**KNOWN), belief(small))
    calibration = found.calibration
    noisy = calibration.ids == taxel
    assert calibration.reasons[noisy] == [log_module.TOO_NOISY]
    assert not calibration.readings[noisy].any()
    assert calibration.verdict.level == "FAIL"
    assert "did not converge, got steps still decrease" in calibration.verdict.reasons[0]
    assert np.isnan(calibration.poses).all()
    assert calibration.touched[~noisy].all()
    assert found.contradictions == ()
    value, sigma = found.unknowns["clock_offset"]
    assert abs(value - small.truth("clock_offset")) < 4 * sigma
    for label, (value, sigma) in found.unknowns.items():
        assert abs(value - small.truth(label)) < 4 * sigma, label


@pytest.mark.slow
def test_the_round_before_one_that_failed_is_a_doubt(small, monkeypatch):
    calls = []

    def failing(*args, **kwargs):
        calls.append(args)
        if len(calls) > 1:
            raise CalibrationError("no end")
        return Estimation(*args, **kwargs)

    monkeypatch.setattr(log_module, "Estimation", failing)
    monkeypatch.setattr(log_module, "_clock_error", lambda *args: 0.0)
    found = calibrate_log(small.log, small.kinematics(**KNOWN), belief(small))
    assert found.calibration.verdict.level == "DOUBT"
    assert any("no end" in words for words in found.calibration.verdict.reasons)
    errors = position_errors(found.calibration, small.scene.skin)
    assert np.nanmax(errors / found.calibration.position_sigma) < 5


@pytest.mark.slow
def test_contacts_that_have_not_come_to_rest_are_a_doubt(small, monkeypatch):
    monkeypatch.setattr("meshskin.estimation.kinematics.calibrate_log.MAX_ROUNDS", 1)
    found = calibrate_log(small.log, small.kinematics(**KNOWN), belief(small))
    assert found.moved > 2e-6
    assert found.calibration.verdict.level != "PASS"
    assert any("contacts still moved" in words for words in found.calibration.verdict.reasons)


@pytest.mark.slow
def test_clocks_far_apart_give_a_start(small):
    """Readings moved by twelve frames, 0.48 s."""
    log, model = small.log, small.kinematics(**KNOWN)
    path = joint_path(log, model.chain.joint_names)
    late = replace(
        log, readings=np.roll(log.readings, 12, axis=0), in_contact=np.roll(log.in_contact, 12)
    )
    later = replace(
        log, readings=np.roll(log.readings, 75, axis=0), in_contact=np.roll(log.in_contact, 75)
    )  # by 3 s of frames, and by 0.6 s of each gap between that a frame passed
    for moved, offset in ((log, CLOCK), (late, CLOCK + 0.48), (later, CLOCK + 3.0)):
        rows = contact_frames(moved)
        none = np.zeros(len(model.labels))
        found = first_offset(model, path, log.time[rows], moved.readings[rows], none)
        assert found == pytest.approx(offset, abs=0.03)
    known = small.kinematics(joint_offset=0.01)
    none = np.zeros(len(known.labels))
    assert first_offset(known, path, log.time[rows], late.readings[rows], none) == 0.0


@pytest.mark.slow
def test_clocks_far_apart_are_found_and_named():
    exploration = explore(headings=(0, 90, 210), taxels=37, frame=0.04, clock=0.5)
    found = calibrate_log(exploration.log, exploration.kinematics(**KNOWN), belief(exploration))
    value, sigma = found.unknowns["clock_offset"]
    assert abs(value - 0.5) < min(4 * sigma, 2e-3)
    assert "clock_offset is 0.5, 10 times its believed" in found.contradictions[0]
    assert found.calibration.verdict.level != "PASS"


@pytest.mark.slow
def test_the_whole_exploration():
    exploration = explore()
    found = calibrate_log(exploration.log, exploration.kinematics(**KNOWN), belief(exploration))
    check(exploration, found, 1.2)


def stamped_late(exploration, delays):
    """The log with the stamps of its joints late by `delays` (6,), s."""
    log = exploration.log
    angles = log.joint_angles.copy()
    for k in np.flatnonzero(delays):
        early = exploration.robot.at(log.time - delays[k])[0]
        angles[:, k] += (early - exploration.robot.at(log.time)[0])[:, k]
    return replace(log, joint_angles=angles)


@pytest.mark.slow
@pytest.mark.parametrize("delays", [(0, 0, 5e-3, 0, 0, 0), (0.037, 0.037, 0.037, 0, 0, 0)])
def test_joints_stamped_at_different_times(small, delays):
    """One joint late by 5 ms, and joints of two clocks."""
    log = stamped_late(small, delays)
    found = calibrate_log(log, small.kinematics(**KNOWN), belief(small))
    assert found.kinematics.delayed == ("joint6", "joint5", "joint4", "joint2", "joint1")
    for joint in found.kinematics.delayed:
        value, sigma = found.unknowns[f"joint_delay {joint}"]
        true = delays[small.log.joint_names.index(joint)] - delays[2]
        assert abs(value - true) < min(4 * sigma, 2e-3), joint
    value, sigma = found.unknowns["clock_offset"]
    assert abs(value - CLOCK + delays[2]) < min(4 * sigma, 2e-3)
    errors = position_errors(found.calibration, small.scene.skin)
    assert np.sqrt(np.mean(errors**2)) < 2.5e-5
    assert np.mean(nees(found.calibration, small.scene.skin)) < 3.5


def test_heights_alone_find_a_late_joint(small):
    """And those of the readings of which the joints hardly move leave the heights as they are."""
    model = small.kinematics(joint_offset=np.radians(1.0), joint_delay=0.02)
    path = joint_path(stamped_late(small, (0, 0.03, 0, 0, 0, 0)), model.chain.joint_names)
    time, body = small.log.time[small.frames] - CLOCK, small.scene.body
    inside = path.covers(time)
    time, depth = time[inside], np.full(inside.sum(), 1e-3)
    given = replace(model, delayed=("joint3",))
    assert timed_by_the_fastest(given, path, time, body) is given
    model = timed_by_the_fastest(model, path, time, body)
    heights = Heights(model, path, time, body, small.scene.indenter.radius, depth)
    fit = heights.linearized(heights.fit())
    found = dict(zip(model.labels, fit.mean, strict=True))
    assert found["joint_delay joint2"] == pytest.approx(0.03, abs=1e-3)
    for joint in ("joint1", "joint4", "joint5"):
        assert abs(found[f"joint_delay {joint}"]) < 1e-3


def test_heights_alone_find_the_joints(small):
    """All but the joints' and the indenter's common motion about the base, and within 4 sigma."""
    model = small.kinematics(joint_offset=np.radians(1.0), mount=1e-3)
    path = joint_path(small.log, model.chain.joint_names)
    time = small.log.time[small.frames] - small.truth("clock_offset")
    hit = small.scene.body.closest(small.recording.points)
    depth = small.scene.model.patches(
        force=small.recording.force,
        curvature=hit.curvature,
        indenter_radius=small.scene.indenter.radius,
        effective_modulus=small.scene.material.effective_modulus,
    ).depth
    body, radius = small.scene.body, small.scene.indenter.radius
    heights = Heights(model, path, time, body, radius, depth)
    x = heights.fit()
    fit = heights.linearized(x)
    sigma = np.sqrt(np.diag(fit.covariance))
    truth = np.array([small.truth(label) for label in model.labels])
    assert np.abs((fit.mean - truth) / sigma).max() < 4
    found = dict(zip(model.labels, sigma, strict=True))
    for name in ("joint2", "joint3", "joint4", "joint5"):
        assert found[f"joint_offset {name}"] < np.radians(0.1)
    # the last joint turns the body as its mount does: their sum alone is determined
    assert found["joint_offset joint6"] > np.radians(0.3)
    assert np.median(np.abs(heights.residuals(x)[0])) < 2e-5
    np.testing.assert_allclose(fit.root @ fit.root.T, fit.covariance, atol=1e-18)


@pytest.mark.deep
def test_heights_of_a_stroke_share_the_error_of_its_force(small):
    """Where the force of each stroke is wrong, offsets of joints are farther off, in their standard
    deviations, if contacts are taken for touches of their own. Those with strokes are too small,
    too, in these three passes (errors of 2.2 standard deviations, rms)."""
    model = small.kinematics(joint_offset=np.radians(1.0))
    path = joint_path(small.log, model.chain.joint_names)
    time = small.log.time[small.frames] - small.truth("clock_offset")
    depth = small.scene.model.patches(
        force=small.recording.force,
        curvature=small.scene.body.closest(small.recording.points).curvature,
        indenter_radius=small.scene.indenter.radius,
        effective_modulus=small.scene.material.effective_modulus,
    ).depth
    stroke = np.arange(len(time)) * 40 // len(time)
    body, radius = small.scene.body, small.scene.indenter.radius
    truth, errors = np.array([small.truth(label) for label in model.labels]), []
    for seed in range(10, 14):
        wrong = depth + 3e-5 * np.random.default_rng(seed).normal(size=40)[stroke]
        for touch in (stroke, np.empty(0, dtype=int)):
            heights = Heights(model, path, time, body, radius, wrong, touch=touch)
            fit = heights.linearized(heights.fit())
            errors.append((fit.mean - truth) / np.sqrt(np.diag(fit.covariance)))
    strokes, alone = (np.sqrt(np.mean(np.square(errors[k::2]))) for k in range(2))
    assert 1.8 * strokes < alone


@pytest.mark.slow
def test_what_a_log_cannot_tell_apart_is_named():
    """The mount turned about the axis of the last joint, and that joint's offset."""
    small = explore(headings=(0, 90, 210), taxels=19, frame=0.04)
    unknown = {"joint_offset": np.radians(1.0), "mount": 1e-3, "clock_offset": 0.05}
    found = calibrate_log(small.log, small.kinematics(**unknown), belief(small))
    words = " | ".join(found.calibration.undetermined)
    assert "joint_offset joint6" in words
    assert "mount rotation" in words
    for label, (value, sigma) in found.unknowns.items():
        assert abs(value - small.truth(label)) < 4.5 * sigma, label
    assert abs(found.unknowns["clock_offset"][0] - small.truth("clock_offset")) < 2e-3


@pytest.mark.slow
def test_pressures_and_forces_under_the_contact_model(small):
    unknown = {"joint_offset": np.radians(1.0), "clock_offset": 0.05}
    known = small.scene.belief(unknown=("modulus", "force_scale"))
    found = calibrate_log(small.pressures(), small.kinematics(**unknown), known)
    check(small, found, 1.2)
    assert found.calibration.fit.good
    # frames scatter by 0.01 mm with the noise of the joint angles, their means by less
    assert 1.0 <= found.calibration.fit.noise / known.noise_sigma < 1.08
    value, sigma = found.calibration.unknowns["force_scale"]
    assert abs(value) < 4 * sigma


@pytest.mark.deep
def test_bad_logs_are_refused_in_one_line(small):
    model, log = small.kinematics(**KNOWN), small.log
    renamed = replace(log, joint_names=("elbow", *log.joint_names[1:]))
    with pytest.raises(RecordingError, match=r"lacks angles of .*, got joint1, limit: .*elbow"):
        calibrate_log(renamed, model, belief(small))
    silent = replace(log, readings=np.full_like(log.readings, np.nan))
    with pytest.raises(RecordingError, match="no contact that a taxel reads"):
        calibrate_log(silent, model, belief(small))
    pulled = replace(log, force=np.full(len(log.time), -3.0))
    with pytest.raises(RecordingError, match="forces of the log are negative"):
        calibrate_log(pulled, model, belief(small))
    degrees = replace(log, joint_angles=np.degrees(log.joint_angles))
    with pytest.raises(
        CalibrationError, match=r"not on the body, got .* mm off it .*; joint angles in degrees"
    ):
        calibrate_log(degrees, model, belief(small))
    with pytest.raises(CalibrationError, match="pressures without forces"):
        calibrate_log(log, model, belief(small, readings="pressure"))
    with pytest.raises(ConfigError, match="what is calibrated must be a SkinLog"):
        calibrate_log(small.recording, model, belief(small))


@pytest.mark.slow
@pytest.mark.parametrize("height", [-3e-3, 3e-3])
def test_an_indenter_at_another_height_is_a_doubt(small, height):
    known = small.kinematics(**KNOWN)
    moved = replace(known, indenter=np.add(known.indenter, [0.0, 0.0, height]))
    found = calibrate_log(small.log, moved, belief(small))
    assert any("indenter's height" in words for words in found.contradictions)
    assert found.calibration.verdict.level != "PASS"
    assert set(found.contradictions) <= set(found.calibration.verdict.reasons)
