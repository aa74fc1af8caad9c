"""A Panda and an iCub from the bag of a simulated robot alone: clocks, joints, forces and taxels.

The URDF files are those of the wheel `example-robot-data` (the extra `robots`).
"""

from pathlib import Path

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.kinematics.calibrate_log import calibrate_log
from meshskin.estimation.uncertainty.metrics import position_errors
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.recording.readers import read_log
from meshskin.recording.resample import log_frames
from meshskin.recording.stream import Log, Stream

from ...recording import robot_log
from ...robot.test_real_arms import urdf
from .stroking_robot import CLOCK, RADIUS, YOUNG, StrokingRobot

ROBOTS = {
    "panda.urdf": ("panda_link5", (0.5, -1.9, 0.3, 0.4, 0.2), (0.0, 0.123, -0.029)),
    "icub.urdf": ("l_forearm", (0.2, 0.9, 0.3, 0.5, -0.5, 0.1, 0.1, 0.1), (-0.057, 0.0, 0.064)),
    "xarm7.urdf": ("link5", (0.3, 1.0, 0.2, -0.2, 0.3), (0.0, -0.03, -0.131)),
}
"""Link with the skin, angles from there to the root, rad, and a point on the skin, m."""
FORCE_MAP = StreamMap("/wrench", "wrench", axis=(0, 0, 1))


def standing(name, seed, **kind):
    """The robot over an indenter that touches its skin in the middle of its postures."""
    link, posture, about = ROBOTS[name]
    robot = ms.Robot.from_urdf(urdf(name))
    hit = robot.body(link, open=True).closest(np.array([about]))
    touching = np.append(hit.point[0] + RADIUS * hit.normal[0], 1.0)
    chain = robot.contact_kinematics(link, np.zeros(3)).chain
    place = np.linalg.solve(chain.poses(np.array([posture]))[0], touching)[:3]
    return StrokingRobot(robot, link, tuple(place), posture, tuple(hit.point[0]), seed=seed, **kind)


UNKNOWN = {
    "joint_offset": np.radians(1.0),
    "joint_delay": 0.02,
    "indenter_position": 2e-3,
    "clock_offset": 0.05,
}


def calibrated(world, log, young=YOUNG):
    """The calibration of a log of the robot's; young: as its owner believes, Pa."""
    kinematics = world.robot.contact_kinematics(world.link, world.place, unknown=UNKNOWN)
    belief = ms.Belief(
        body=world.scene.body, indenter=ms.Indenter.sphere(RADIUS),
        material=ms.Material(young=young), taxel_ids=log.taxel_ids, readings="raw",
    )  # fmt: skip
    return calibrate_log(log, kinematics, belief)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda.urdf", "icub.urdf"])
def test_a_bag_with_forces_alone(tmp_path, monkeypatch, name):
    world = standing(name, 1, strokes=56)  # 40 leave nine taxels of the iCub aside
    monkeypatch.setattr(robot_log, "JOINTS", world.chain.joint_names)
    robot_log.write_mcap(tmp_path / "log.mcap", world.streams(force=True))
    count = len(world.scene.skin)
    skin = StreamMap("/skin", "taxels", length=count)
    log_map = LogMap((StreamMap("/joint_states", "joints"), skin, FORCE_MAP))
    log = log_frames(read_log(tmp_path / "log.mcap", log_map), log_map).skin_log
    true_force = np.interp(log.time - robot_log.EPOCH, world.motion[0], world.motion[3])
    late = log.clock_offset
    assert np.abs(np.median((log.force - true_force)[true_force > 2.5])) < 0.02
    found = calibrated(world, log)
    assert found.calibration.verdict.level == "PASS"
    value, sigma = found.unknowns["clock_offset"]
    assert abs(value + late - CLOCK) < 2e-3
    assert abs(value + late - CLOCK) < 4 * sigma
    offsets = zip(found.joint_offsets.items(), world.offsets, strict=True)
    told = 0
    for (joint, (value, sigma)), truth in offsets:
        assert abs(value - truth) < 4 * sigma, joint
        if sigma < np.radians(0.05):  # the first joint turns arm and indenter alike
            told += 1
            assert abs(value - truth) < np.radians(0.1), joint
    assert told == len(world.offsets) - 1
    errors = position_errors(found.calibration, world.scene.skin)
    assert np.isfinite(errors).sum() >= 0.85 * count
    assert np.sqrt(np.nanmean(errors**2)) < 8e-5


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "mass"), [(1, 1.2), (2, 2.5)])
def test_a_bag_with_the_forces_of_a_sensor_that_carries_a_weight(tmp_path, monkeypatch, seed, mass):
    """A weight that turns with the arm, 4 and 8 times the force of a contact, and zeros of the
    joints that are off by a degree."""
    world, weight = standing("panda.urdf", seed), mass * 9.80665
    monkeypatch.setattr(robot_log, "JOINTS", world.chain.joint_names)
    robot_log.write_mcap(tmp_path / "log.mcap", world.streams(weight=weight))
    skin = StreamMap("/skin", "taxels", length=len(world.scene.skin))
    wrench = StreamMap("/wrench", "wrench")
    log_map = LogMap((StreamMap("/joint_states", "joints"), skin, wrench))
    frames = log_frames(read_log(tmp_path / "log.mcap", log_map), log_map, world.robot)
    (note,) = [words for words in frames.notes if "carries" in words]
    assert float(note.split(" kg")[0].split()[-1]) == pytest.approx(mass, rel=0.02)
    log = frames.skin_log
    true_force = np.interp(log.time - robot_log.EPOCH, world.motion[0], world.motion[3])
    off = (log.force - true_force)[true_force > 2.5]
    assert np.sqrt(np.nanmean(off**2)) < 0.1
    found = calibrated(world, log)
    assert found.calibration.verdict.level == "PASS"
    errors = position_errors(found.calibration, world.scene.skin)
    assert np.isfinite(errors).sum() >= 0.85 * len(world.scene.skin)
    assert np.sqrt(np.nanmean(errors**2)) < 1e-4
    assert np.nanmax(errors / found.calibration.position_sigma) < 4


def log_without_forces(world):
    """The log of the robot's joints and skin."""
    streams, count = world.streams(), len(world.scene.skin)
    fields = {"/joint_states": world.chain.joint_names, "/skin": tuple(map(str, range(count)))}
    log_map = LogMap(
        (StreamMap("/joint_states", "joints"), StreamMap("/skin", "taxels", length=count))
    )
    log = Log(
        Path("log.mcap"),
        tuple(
            Stream(m.topic, "", *streams[m.topic], fields[m.topic], m.kind, m.unit)
            for m in log_map.streams
        ),
    )
    return log_frames(log, log_map).skin_log


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda.urdf", "icub.urdf"])
@pytest.mark.parametrize("beat", [0.5, 3.0, 10.0])
def test_a_log_without_forces(name, beat):
    world = standing(name, 1, beat=beat, strokes=56)  # as many as all taxels of the iCub need
    log = log_without_forces(world)
    found = calibrated(world, log)
    assert found.calibration.verdict.level == "PASS"
    value, sigma = found.unknowns["clock_offset"]
    assert abs(value + log.clock_offset - CLOCK) < 4 * sigma
    errors = position_errors(found.calibration, world.scene.skin)
    assert np.isfinite(errors).sum() >= 0.85 * len(world.scene.skin)
    assert np.nanmax(errors / found.calibration.position_sigma) < 4
    assert np.sqrt(np.nanmean(errors**2)) < 2e-4


@pytest.mark.slow
def test_contacts_chosen_on_another_clock_delay_no_joint():
    """Without forces the contacts whose force still rises are told by their heights, on a clock."""
    world = standing("xarm7.urdf", 7, spread=0.25, taxels=37, strokes=36)
    log = log_without_forces(world)
    found = calibrated(world, log, young=2e5)
    truth = {"clock_offset": CLOCK - log.clock_offset}
    for label, (value, sigma) in found.unknowns.items():
        if label.startswith(("joint_delay", "clock_offset")):
            assert abs(value - truth.get(label, 0.0)) < 3 * sigma, label
