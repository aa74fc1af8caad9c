"""Contact forces by a sensor that carries a tool, against pinocchio's kinematics."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from scipy.spatial.transform import Rotation

import meshskin as ms
from meshskin.recording.contact_force import contact_force
from meshskin.recording.log_map import StreamMap
from meshskin.recording.stream import Stream
from meshskin.robot.urdf import UrdfTree

PUMA = Path(__file__).parents[2] / "bodies" / "puma560.urdf"
GIVEN = StreamMap("/wrench", "wrench")
NAMES = tuple(f"joint{k}" for k in range(1, 7))


def stroking(seed, mass=0.8, sign=1.0, vertical=(0.0, 0.0, 1.0)):
    """Frames (n,) of a robot that moves from posture to posture and is touched in every second one,
    in contact or not, true forces, wrenches (n, 6), and joint angles (n, 6)."""
    rng = np.random.default_rng(seed)
    postures = rng.normal(0.2, 0.4, (61, 6))
    time = np.arange(0, 60, 0.02)
    way, turn = np.modf(time)
    way = np.clip(2 * way, 0, 1)[:, None]
    way, turn = 0.5 - 0.5 * np.cos(np.pi * way), turn.astype(int)
    angles = postures[turn] + way * (postures[turn + 1] - postures[turn])
    phase = np.mod(time, 2) - 1.6
    force = np.where((turn % 2 == 1) & (phase >= 0) & (phase < 0.3), 3.0, 0.0)
    model = pinocchio.buildModelFromUrdf(str(PUMA))
    data = model.createData()
    wrench = np.zeros((len(time), 6))
    mounted = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    for k, q in enumerate(angles):
        pinocchio.forwardKinematics(model, data, q)
        down = -data.oMi[5].rotation.T @ vertical  # of the link before the last
        wrench[k, :3] = sign * mounted @ (9.81 * mass * down)
    push = rng.normal(size=(61, 3))
    push /= np.linalg.norm(push, axis=1)[:, None]
    wrench[:, :3] += force[:, None] * push[turn] + [1.0, -2.0, 4.0]
    wrench[:, :3] += rng.normal(0, 0.02, (len(time), 3))
    return time, force > 0, force, wrench, angles


def found(world, robot):
    time, touched, _, wrench, angles = world
    stream = Stream("/wrench", "", time, wrench, tuple("abcdef"), "wrench", "N")
    force, notes = contact_force(time, touched, [(stream, GIVEN)], robot, NAMES, angles)
    return force, notes


@pytest.mark.parametrize(
    "kind", [{}, {"sign": -1.0}, {"vertical": (0.0, 1.0, 0.0)}], ids=["floor", "sign", "wall"]
)
def test_the_weight_of_a_tool_is_subtracted(kind):
    world = stroking(1, **kind)
    touched, truth = world[1], world[2]
    world[4][100:120] = np.nan  # a gap of the joints
    force, notes = found(world, ms.Robot.from_urdf(PUMA))
    assert np.flatnonzero(np.isnan(force)).tolist() == list(range(100, 120))
    force[100:120] = truth[100:120]
    error = (force - truth)[touched]
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert np.median(force[~touched]) < 0.05
    (note,) = notes
    assert note.startswith("/wrench carries 0.8 kg that turn with the link link5")


def test_zeros_of_joints_and_a_tilted_base_are_found_with_the_weight():
    """Joints that are a degree off turn the weight by 0.14 N, a base on its feet by as much."""
    world = stroking(4, vertical=(0.012, -0.012, np.sqrt(1 - 2 * 0.012**2)))
    touched, truth = world[1], world[2]
    world[4][:] -= np.radians([1, -1, 1, 1, -1, 1])
    force, (note,) = found(world, ms.Robot.from_urdf(PUMA))
    assert note.startswith("/wrench carries 0.8 kg")
    touch = np.cumsum(np.diff(np.flatnonzero(touched), prepend=0) > 1)
    errors = (force - truth)[touched]
    shared = [np.median(errors[touch == k]) for k in np.unique(touch)]
    assert np.sqrt(np.mean(np.square(shared))) < 0.02


def test_without_the_robot_the_weight_is_named_as_a_cause():
    world = stroking(2)
    force, (note,) = found(world, None)
    assert np.sqrt(np.mean((force - world[2])[world[1]] ** 2)) > 1.0
    assert "N off its level at rest in the median" in note
    assert note.endswith("a calibration with the URDF subtracts")


def test_a_sensor_without_a_tool_is_left_as_it_is():
    world = stroking(3, mass=0.0)
    with_robot, notes = found(world, ms.Robot.from_urdf(PUMA))
    assert notes == []
    np.testing.assert_array_equal(with_robot, found(world, None)[0])


def test_joints_that_the_weight_does_not_need_do_not_matter():
    """A gripper that never reports, and a base that floats."""
    time, touched, truth, wrench, angles = stroking(1)
    cart = '<joint name="cart" type="floating"><parent link="{}"/><child link="cart"/></joint>'
    robot = ms.Robot.from_urdf(PUMA)
    text = robot.text.replace("</robot>", f'<link name="cart"/>{cart.format(robot.root)}</robot>')
    robot = replace(robot, text=text, tree=UrdfTree(text))
    stream = Stream("/wrench", "", time, wrench, tuple("abcdef"), "wrench", "N")
    more = np.column_stack([angles, np.full(len(time), np.nan)])
    names = (*NAMES, "gripper")
    force, notes = contact_force(time, touched, [(stream, GIVEN)], robot, names, more)
    assert "carries 0.8" in notes[0]
    assert np.sqrt(np.mean((force - truth)[touched] ** 2)) < 0.1


def test_the_level_of_a_short_last_block_is_not_that_of_a_contact_beside_the_taxels():
    """Half a second after the last whole block, of which most is pressed where no taxel answers."""
    world = stroking(1, mass=0.0)
    some = world[0] < 40.5
    world = [part[some] for part in world]
    pressed = world[0] > 40.1
    world[3][pressed, :3] += [0.0, 0.0, 3.0]
    force, _ = found(world, None)
    assert np.median(force[pressed]) == pytest.approx(3.0, abs=0.1)
