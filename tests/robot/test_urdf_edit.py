"""Shapes of a link written elsewhere, read back by other people's readers."""

from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ArmError, UnknownNameError
from meshskin.core.se3 import exp_so3, transform, transform_points
from meshskin.estimation.kinematics.log_calibration import LogCalibration
from meshskin.robot.urdf_edit import with_moved_shapes

TEXT = """<?xml version="1.0"?>
<robot name="arm"><!-- of 2019 -->
  <link name="base"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>
  <link name="palm">
    <visual name="a &amp; b"><origin rpy="0.3 -0.2 0.5" xyz="0.01 0.02 -0.03"></origin>
      <geometry><mesh filename="palm.stl" scale="0.001 0.001 0.001"/></geometry></visual>
    <collision><geometry><box size="0.1 0.2 0.3"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="palm"/>
    <origin xyz="0 0 0.5" rpy="0 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
POSE, SCALE = transform(exp_so3([0.2, -0.4, 0.1]), [3e-3, -5e-3, 7e-3]), 1.02


@pytest.fixture
def robot(tmp_path):
    trimesh.creation.box([40, 60, 90]).export(tmp_path / "palm.stl")
    (tmp_path / "arm.urdf").write_text(TEXT)
    return ms.Robot.from_urdf(tmp_path / "arm.urdf")


def similar(points):
    return transform_points(POSE, SCALE * points)


def read_back(robot):
    robot.save(robot.path.with_name("corrected.urdf"))
    return ms.Robot.from_urdf(robot.path.with_name("corrected.urdf"))


def test_shapes_are_where_the_pose_and_the_scale_put_them(robot):
    corrected = robot.with_moved_shapes("palm", POSE, SCALE)
    moved = read_back(corrected)
    before, *after = (r.body("palm").mesh.vertices for r in (robot, corrected, moved))
    for vertices in after:
        np.testing.assert_allclose(vertices, similar(before), atol=1e-9)
    pairs = zip(robot.text.splitlines(), moved.text.splitlines(), strict=True)
    assert [k for k, (a, b) in enumerate(pairs) if a != b] == [4, 5, 6]
    assert 'filename="palm.stl" scale="0.00102' in moved.text
    with pytest.raises(UnknownNameError, match="did you mean palm"):
        robot.with_moved_shapes("plam", POSE)
    with pytest.raises(ArmError, match="rigid transform"):
        robot.with_moved_shapes("palm", 2 * POSE)
    with pytest.raises(ArmError, match="scale of shapes"):
        robot.with_moved_shapes("palm", POSE, 0.0)


def test_pinocchio_and_yourdfpy_read_them(robot):
    pin, yourdfpy = pytest.importorskip("pinocchio"), pytest.importorskip("yourdfpy")
    moved = read_back(robot.with_moved_shapes("palm", POSE, SCALE))
    found = []
    for one in (robot, moved):
        model = pin.buildModelFromUrdf(str(one.path))
        shapes = pin.buildGeomFromUrdf(model, str(one.path), pin.GeometryType.COLLISION)
        shape = shapes.geometryObjects[0]
        rest = model.frames[shape.parentFrame].placement  # of the link in the frame of its joint
        box = yourdfpy.URDF.load(str(one.path)).link_map["palm"].collisions[0].geometry.box
        found.append(((rest.inverse() * shape.placement).homogeneous, np.array(box.size)))
    (before, size), (after, bigger) = found
    np.testing.assert_allclose(bigger, SCALE * size)
    np.testing.assert_allclose(after[:3, :3], POSE[:3, :3] @ before[:3, :3], atol=1e-12)
    np.testing.assert_allclose(after[:3, 3], similar(before[None, :3, 3])[0], atol=1e-12)


def test_a_corrected_robot_has_the_estimated_mount_and_size(robot):
    mount = transform(exp_so3([0.0, 0.3, 0.0]), [0.0, 0.0, 0.04])
    kinematics = robot.contact_kinematics(
        "palm", [0, 0, 1], mount=mount, unknown={"joint_offset": 0.1, "mount": 1, "mesh_scale": 1}
    )
    values = dict(zip(kinematics.labels, [0.05, *POSE[:3, 3], 0.2, -0.4, 0.1, 0.02], strict=True))
    found = LogCalibration(
        SimpleNamespace(unknowns={k: (v, 0.0) for k, v in values.items()}),
        None, kinematics, np.zeros(1), np.zeros(1), 1,
    )  # fmt: skip
    np.testing.assert_allclose(found.mount, mount @ POSE, atol=1e-15)
    corrected = read_back(found.corrected(robot, "palm"))
    in_body = transform_points(np.linalg.inv(mount), robot.body("palm").mesh.vertices)
    np.testing.assert_allclose(
        corrected.body("palm").mesh.vertices,
        transform_points(found.mount, np.exp(0.02) * in_body), atol=1e-9,
    )  # fmt: skip
    turned = corrected.chain("base", "palm").poses(np.zeros((1, 1)))[0]
    np.testing.assert_allclose(turned[:2, 0], [np.cos(0.05), np.sin(0.05)], atol=1e-12)


def test_attributes_that_hold_an_angle_bracket_are_kept():
    text = (
        '<robot name="r"><link name="l"><visual name="a>b"><geometry>'
        "<mesh scale='1 1 1' filename='c>d.stl'/></geometry></visual></link></robot>"
    )
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.2, 0.3]
    edited = with_moved_shapes(text, "l", pose, 2.0)
    visual = ElementTree.fromstring(edited).find("link/visual")
    assert visual.get("name") == "a>b"
    assert visual.find("origin").get("xyz") == "0.1 0.2 0.3"
    mesh = visual.find("geometry/mesh")
    assert (mesh.get("filename"), mesh.get("scale")) == ("c>d.stl", "2.0 2.0 2.0")
