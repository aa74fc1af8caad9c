"""Recordings of logs whose contacts are computed: frames, joints and readings."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import RecordingError
from meshskin.recording.log_contacts import (
    at_clock,
    contact_frames,
    joint_path,
    recording_of,
    without_noise,
)
from meshskin.recording.skin_log import SkinLog


@pytest.fixture
def log():
    readings = np.array([[np.nan, 3.0], [np.nan, np.nan], [5.0, 7.0], [1.0, np.nan]])
    return SkinLog(
        time=np.array([0.0, 0.1, 0.2, 0.3]),
        joint_names=("elbow", "wrist"),
        joint_angles=np.arange(8.0).reshape(4, 2),
        taxel_ids=np.array([12, 40]),
        readings=readings,
        noise=np.ones(2),
        in_contact=np.array([True, True, True, False]),
    )


def test_frames_in_contact_have_readings_and_forces(log):
    assert contact_frames(log).tolist() == [0, 2]
    pressed = replace(log, force=np.array([-1.0, 2.0, 3.0, 4.0]))
    assert contact_frames(pressed).tolist() == [2]
    with pytest.raises(RecordingError, match="sign of the forces"):
        contact_frames(replace(log, force=np.zeros(4)))


@pytest.mark.parametrize(
    ("scale", "words"), [(-1.0, "forces of the log are negative"), (0.0, "no force where taxels")]
)
def test_forces_of_the_wrong_sign_or_axis_are_named(scale, words):
    """Few frames have a force above zero by its noise alone: they are not taken for contacts."""
    rng, pressed = np.random.default_rng(1), np.sin(np.linspace(0.0, 20.0, 400)) > 0
    log = SkinLog(
        time=0.02 * np.arange(400),
        joint_names=(),
        joint_angles=np.empty((400, 0)),
        taxel_ids=np.arange(1),
        readings=np.where(pressed, 9.0, np.nan)[:, None],
        noise=np.ones(1),
        in_contact=pressed,
        force=rng.normal(0.0, 0.02, 400) + 3.0 * pressed,
    )
    assert len(contact_frames(log)) == pressed.sum()
    with pytest.raises(RecordingError, match=words):
        contact_frames(replace(log, force=log.force - 3.0 * (1 - scale) * pressed))


def test_forces_are_those_of_the_time_of_the_contact(log):
    """0.1 s ago; where they rise from nothing within a frame they are not known."""
    time = 0.1 * np.arange(8)
    force = np.array([0.0, 0.0, 2.0, 3.0, 3.2, 3.0, 0.0, 0.0])
    angles, readings = np.zeros((8, 2)), np.ones((8, 2))
    log = replace(log, time=time, joint_angles=angles, readings=readings,
                  in_contact=force > 0, force=force)  # fmt: skip
    assert at_clock(log, 0.0) is log
    found = at_clock(log, 0.1).force
    np.testing.assert_allclose(found, [0, 0, 0, np.nan, 3, 3.2, np.nan, 0], atol=1e-12)
    pulled = at_clock(replace(log, force=-force), 0.1).force  # refused later, not unknown
    np.testing.assert_allclose(pulled, -found, atol=1e-12)


def test_joints_are_those_asked_for_in_their_order(log):
    angles, rates = joint_path(log, ("wrist", "elbow")).at(np.array([0.1, 0.25]))
    np.testing.assert_allclose(angles, [[3.0, 2.0], [6.0, 5.0]], atol=1e-12)
    np.testing.assert_allclose(rates, 20.0, atol=1e-9)
    with pytest.raises(RecordingError, match=r"lacks angles .*, got wrst, limit: .*wrist"):
        joint_path(log, ("wrst",))
    single = replace(
        log, time=log.time[:1], joint_angles=log.joint_angles[:1], readings=log.readings[:1],
        in_contact=log.in_contact[:1],
    )  # fmt: skip
    without = replace(log, joint_names=(), joint_angles=np.empty((4, 0)))
    with pytest.raises(RecordingError, match='kind = "joints" with elbow, wrist'):
        joint_path(without, ("wrist", "elbow"))
    with pytest.raises(RecordingError, match="two frames"):
        joint_path(single, ("elbow",))


def test_a_recording_has_the_contacts_and_their_readings(log, tmp_path):
    points, normals = np.eye(3)[:2], np.eye(3)[[2, 2]]
    recording = recording_of(log, contact_frames(log), points, normals, np.array([1.0, 2.0]))
    assert recording.time.tolist() == [0.0, 0.2]
    np.testing.assert_array_equal(recording.points, points)
    assert recording.reading_contact.tolist() == [0, 1, 1]
    assert recording.reading_taxel.tolist() == [40, 12, 40]
    assert recording.pressure.tolist() == [3.0, 5.0, 7.0]
    assert recording.metadata["readings"] == "raw"
    recording.save(tmp_path / "log")
    assert type(recording).load(tmp_path / "log").pressure.tolist() == [3.0, 5.0, 7.0]


def test_a_recording_without_forces_says_so(log):
    frames = contact_frames(log)
    points, normals = np.zeros((len(frames), 3)), np.tile([0.0, 0.0, 1.0], (len(frames), 1))
    force = np.ones(len(frames))
    assert not recording_of(log, frames, points, normals, force).force_measured
    measured = replace(log, force=np.ones(len(log.time)))
    assert recording_of(measured, frames, points, normals, force).force_measured


def test_missing_readings_are_no_silences(log):
    """Of taxels that nearly every frame has; another one is recorded only where it answers."""
    frames = 12
    readings = np.full((frames, 6), 2.0)
    readings[:, 5] = np.nan
    readings[[3, 8], 5] = 9.0
    readings[3, 1] = np.nan
    readings[7, :3] = np.nan
    longer = replace(
        log, time=0.1 * np.arange(frames), joint_angles=np.zeros((frames, 2)),
        taxel_ids=np.arange(6), noise=np.ones(6), readings=readings,
        in_contact=np.ones(frames, dtype=bool),
    )  # fmt: skip
    used = contact_frames(longer)
    assert used.tolist() == [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11]  # frame 7 lacks half of them
    at = np.tile([0.0, 0.0, 1.0], (len(used), 1))
    recording = recording_of(longer, used, at, at, np.ones(len(used)))
    lost = np.isnan(recording.pressure)
    assert recording.reading_taxel[lost].tolist() == [1]
    assert recording.time[recording.reading_contact[lost]] == pytest.approx([0.3])
    assert np.sum(recording.reading_taxel == 5) == 2


def test_a_path_has_no_angles_in_gaps_of_a_joint(log):
    time = 0.1 * np.arange(40)
    angles = np.stack([time, 2 * time], axis=1)
    angles[10:20, 1] = np.nan
    longer = replace(
        log, time=time, joint_angles=angles, readings=np.zeros((40, 2)),
        in_contact=np.ones(40, dtype=bool),
    )  # fmt: skip
    path = joint_path(longer, ("elbow", "wrist"))
    assert path.covers(np.array([-0.1, 0.05, 0.9, 1.5, 2.0, 3.9, 4.0])).tolist() == [
        False, True, True, False, True, True, False,
    ]  # fmt: skip
    assert joint_path(longer, ("elbow",)).covers(np.array([1.5])).all()
    angles[1:, 1] = np.nan
    with pytest.raises(RecordingError, match="check the joint wrist, which has fewest"):
        joint_path(replace(longer, joint_angles=angles), ("elbow", "wrist"))


def test_readings_of_taxels_that_are_far_noisier_than_others_are_left_out(log):
    """Not where the noise is small against the readings, or that of all taxels."""
    readings, ids = np.ones((len(log.time), 5)) * [100.0, 100.0, 100.0, 900.0, 100.0], np.arange(5)
    for noise, expected in (
        ([1.0, 1.0, 1.0, 5.0, 5.0], [0, 0, 0, 0, 1]),
        ([1.0, 1.0, 1.0, 20.0, 0.0], [0, 0, 0, 1, 0]),
        ([5.0, 5.0, 5.0, 5.0, 5.0], [0, 0, 0, 0, 0]),
        ([0.0, 0.0, 0.0, 0.0, 0.0], [0, 0, 0, 0, 0]),
    ):
        given = replace(log, taxel_ids=ids, readings=readings, noise=np.array(noise))
        kept, noisy = without_noise(given)
        np.testing.assert_array_equal(noisy, expected)
        np.testing.assert_array_equal(np.isnan(kept.readings).all(axis=0), expected)
