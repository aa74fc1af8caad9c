"""Mistakes that put the contacts of a log off the body are named before any estimate."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from meshskin import Body, Robot
from meshskin.core.errors import CalibrationError
from meshskin.estimation.kinematics.calibrate_log import calibrate_log
from meshskin.estimation.kinematics.plausible import check_on_body
from meshskin.recording.log_contacts import contact_frames, joint_path

from .simulated_log import PUMA, explore
from .test_calibrate_log import KNOWN, belief


@pytest.fixture(scope="module")
def exploration():
    return explore(headings=(0, 90, 210), taxels=10, frame=0.1)


def reversed_joint(angles):
    return angles * [1, -1, 1, 1, 1, 1]


def moved_zero(angles):
    return angles - np.radians([0, 0, 12, 0, 0, 0])


def exchanged(angles):
    return angles[:, [0, 2, 1, 3, 4, 5]]


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (np.degrees, r'joint angles in degrees \(unit = "deg" in the map\) may be the cause: '),
        (reversed_joint, "the other sign of the joint joint2 may"),
        (moved_zero, "12 degrees added to the joint joint3 may"),
        (exchanged, "joint3 and joint2 exchanged may"),
    ],
)
def test_mistakes_in_joint_angles_are_named(exploration, mistake, words):
    log = exploration.log
    log = replace(log, joint_angles=mistake(log.joint_angles))
    with pytest.raises(CalibrationError, match=words):
        calibrate_log(log, exploration.kinematics(**KNOWN), belief(exploration))


def test_an_indenter_in_mm_is_named(exploration):
    known = exploration.kinematics(**KNOWN)
    known = replace(known, indenter=1e3 * known.indenter)
    with pytest.raises(CalibrationError, match="indenter's place in mm taken for m may"):
        calibrate_log(exploration.log, known, belief(exploration))


def test_a_wrong_link_near_the_origin_is_not_a_unit(exploration):
    """Near the axes that all links share, an indenter a thousand times nearer would fit."""
    known = exploration.kinematics(**KNOWN)
    robot = Robot.from_urdf(PUMA)
    first = robot.contact_kinematics("link1", known.indenter, unknown=KNOWN)
    log = exploration.log
    time = log.time[contact_frames(log)]
    path = joint_path(log, first.chain.joint_names)
    origin = replace(first, indenter=np.zeros(3)).centres(path, time, np.zeros(len(first.labels)))
    ball = trimesh.creation.icosphere(3, radius=0.05)
    ball.apply_translation(np.add(np.median(origin[0], axis=0), [0.0, 0.0, 0.1]))
    where = path, time, Body.from_mesh(ball), 0.05
    with pytest.raises(CalibrationError, match="check the body's link and mount"):
        check_on_body(first, *where, named=False)


def test_an_indenter_in_m_is_named(exploration):
    known = exploration.kinematics(**KNOWN)
    known = replace(known, indenter=1e-3 * known.indenter)
    with pytest.raises(CalibrationError, match="indenter's place in m taken for mm may"):
        calibrate_log(exploration.log, known, belief(exploration))


@pytest.mark.deep
def test_what_no_single_mistake_explains_is_refused_without_a_name(exploration):
    log, known, scene = exploration.log, exploration.kinematics(**KNOWN), exploration.scene
    known = replace(known, indenter=known.indenter + np.array([0.1, 0.15, -0.2]))
    time = log.time[contact_frames(log)]
    where = joint_path(log, known.chain.joint_names), time, scene.body, scene.indenter.radius
    check_on_body(known, *where, named=True)
    with pytest.raises(CalibrationError, match="mm; check the body's link and mount"):
        check_on_body(known, *where, named=False)


def test_a_sound_log_is_not_refused(exploration):
    log, known, scene = exploration.log, exploration.kinematics(**KNOWN), exploration.scene
    time = log.time[contact_frames(log)]
    path = joint_path(log, known.chain.joint_names)
    check_on_body(known, path, time, scene.body, scene.indenter.radius, named=False)
