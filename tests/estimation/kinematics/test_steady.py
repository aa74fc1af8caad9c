"""The steady contacts of a dense log."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.kinematics import steady as module
from meshskin.estimation.kinematics.steady import steady
from meshskin.recording.skin_log import SkinLog
from meshskin.robot.contact_kinematics import JointPath

RADIUS, DEPTH = 10e-3, 1.6e-3
"""Of the indenter and of a contact, m: its radius is 4 mm."""


def presses(force=None):
    """Two presses of 8 frames down, 10 at rest and 8 up, at 0 and 20 mm, with the centres."""
    down = np.linspace(0.0, 1.0, 8, endpoint=False)
    stroke = np.concatenate([down, np.ones(10), 1 - down])
    height = RADIUS - DEPTH * np.tile(stroke, 2)
    centres = np.column_stack([np.repeat([0.0, 0.02], 26), np.zeros(52), height])
    frames = np.concatenate([np.arange(5, 31), np.arange(40, 66)])
    rng, count = np.random.default_rng(1), 70
    readings = np.zeros((count, 2))
    readings[frames] = 100 * np.tile(stroke, 2)[:, None] + rng.normal(scale=2.0, size=(52, 2))
    readings[frames, 1] = np.nan
    log = SkinLog(
        time=0.02 * np.arange(count), joint_names=("a",), joint_angles=np.zeros((count, 1)),
        taxel_ids=np.array([4, 5]), readings=readings, noise=np.full(2, 2.0),
        in_contact=np.isin(np.arange(count), frames),
        force=None if force is None else np.full(count, force),
    )  # fmt: skip
    return log, frames, centres


def steadied(log, frames, centres, angles=None):
    """The steady contacts, and their path, of joint angles (n, 1) that are those of the log."""
    path = JointPath(log.time, log.joint_angles if angles is None else angles)
    return steady(log, path, frames, centres, centres[:, 2], DEPTH, RADIUS)


def test_the_frames_at_rest_of_each_press_are_one_contact():
    log, frames, centres = presses()
    found, _ = steadied(log, frames, centres)
    # the hold, with the frames at 7/8 of the depth before and after it
    deepest = found.readings[:, 0] > 95
    assert deepest.sum() == 2
    assert len(found.time) <= 6
    assert found.readings[:, 0].min() > 60
    assert np.abs(found.readings[deepest, 0] - 100).max() < 4 * 2.0 / np.sqrt(10)
    assert np.isnan(found.readings[:, 1]).all()
    assert found.in_contact.all()
    assert (np.diff(found.time) > 0).all()


def test_measured_forces_keep_the_frames_on_the_way():
    log, frames, centres = presses(force=3.0)
    found, _ = steadied(log, frames, centres)
    assert found.readings[:, 0].min() < 20
    assert found.force == pytest.approx(3.0)


def test_contacts_far_apart_stay_and_many_are_thinned(monkeypatch):
    log, frames, centres = presses(force=3.0)
    centres = centres + 1e-3 * np.arange(52)[:, None]
    every, _ = steadied(log, frames, centres)
    assert np.array_equal(every.readings[:, 0], log.readings[frames, 0])
    monkeypatch.setattr(module, "MAX_CONTACTS", 52)
    assert len(steadied(log, frames, centres)[0].time) == 52
    monkeypatch.setattr(module, "MAX_CONTACTS", 20)
    few, _ = steadied(log, frames, centres)
    assert 15 <= len(few.time) <= 20


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_frames_about_a_turn_of_the_path_are_a_contact_at_their_mean_place(late):
    """A joint that moves the contact to and fro, and readings that tell where it is; late: of the
    stamps of the frames, s."""
    log, frames, centres = presses(force=3.0)
    angles = 1e-4 * np.abs((log.time - late)[:, None] / 0.02 - 17.0)  # 0.1 mm in each frame
    place = JointPath(log.time, angles).at(log.time + late)[0]
    inside = frames + round(late / 0.02) < len(log.time)
    frames, centres = frames[inside], centres[inside]
    log = replace(log, readings=np.repeat(place, 2, axis=1))
    found, path = steadied(log, frames, np.pad(place[frames], ((0, 0), (0, 2))), angles)
    averaged = path.at(found.time + late)[0][:, 0]
    np.testing.assert_allclose(averaged, found.readings[:, 0], atol=1e-12)
    at_mean_time = JointPath(log.time, angles).at(found.time + late)[0][:, 0]
    assert np.abs(at_mean_time - found.readings[:, 0]).max() > 5e-5
