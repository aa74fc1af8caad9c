"""Meshes and poses of links for pictures."""

from pathlib import Path

import numpy as np

from meshskin.robot.link_meshes import ROD_RADIUS, LinkPoses, link_meshes, rod
from meshskin.robot.robot import Robot
from meshskin.robot.urdf import UrdfTree

from ..real_data import DATA, needs_icub

SHAPES = """<robot name="shapes">
  <link name="base">
    <visual><origin xyz="0 0 1" rpy="0 1.5707963267948966 0"/>
      <geometry><box size="0.2 0.4 0.6"/></geometry></visual>
    <visual><geometry><sphere radius="0.1"/></geometry></visual>
    <visual><geometry><mesh filename="lost.stl"/></geometry></visual>
  </link>
  <joint name="j" type="revolute"><parent link="base"/><child link="tip"/>
    <origin xyz="0 0 2"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>
  <link name="tip">
    <collision><geometry><cylinder radius="0.05" length="0.3"/></geometry></collision>
  </link>
</robot>"""


def test_shapes_are_placed_and_missing_meshes_left_out():
    found = link_meshes(UrdfTree(SHAPES))
    low, high = found["base"].vertices.min(axis=0), found["base"].vertices.max(axis=0)
    np.testing.assert_allclose(low, [-0.3, -0.2, -0.1], atol=1e-9)
    np.testing.assert_allclose(high, [0.3, 0.2, 1.1], atol=1e-9)
    np.testing.assert_allclose(np.ptp(found["tip"].vertices, axis=0), [0.1, 0.1, 0.3], atol=2e-3)


def test_links_without_shapes_are_rods_to_their_joints(arm):
    found = link_meshes(arm.tree)
    assert set(found) == set(arm.tree.links) - {arm.tip}  # the tip carries nothing
    upper = found["link2"].vertices  # to the elbow, 0.4318 m away
    assert np.linalg.norm(upper, axis=1).max() > 0.4318


def test_a_rod_goes_from_the_origin_to_its_end():
    end = np.array([0.1, -0.2, 0.3])
    made = rod(end)
    along = made.vertices @ end / np.linalg.norm(end)
    np.testing.assert_allclose([along.min(), along.max()], [0, np.linalg.norm(end)], atol=1e-12)
    off = made.vertices - along[:, None] * end / np.linalg.norm(end)
    assert np.linalg.norm(off, axis=1).max() <= ROD_RADIUS * (1 + 1e-9)


def test_poses_of_links_are_those_of_the_arm(arm):
    robot = Robot(arm.name, Path(), arm.urdf, arm.tree)
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 6)):
        poses = LinkPoses(robot, [arm.tip, "base"]).at(dict(zip(arm.joint_names, q, strict=True)))
        np.testing.assert_allclose(poses[arm.tip], arm.pose(q), atol=1e-12)
        np.testing.assert_allclose(poses["base"], np.eye(4), atol=1e-12)


def test_joints_that_are_not_given_are_at_zero(arm):
    robot = Robot(arm.name, Path(), arm.urdf, arm.tree)
    poses = LinkPoses(robot, [arm.tip]).at({arm.joint_names[0]: 0.3})
    np.testing.assert_allclose(poses[arm.tip], arm.pose([0.3, 0, 0, 0, 0, 0]), atol=1e-12)


@needs_icub
def test_the_links_of_the_icub_have_their_meshes():
    folder = DATA / "icub_body"
    robot = Robot.from_urdf(next(folder.glob("*.urdf")), folder / "meshes")
    found = link_meshes(robot.tree, robot.folders)
    body = robot.body("l_forearm", open=True).mesh
    np.testing.assert_allclose(
        found["l_forearm"].vertices.mean(axis=0), body.vertices.mean(axis=0), atol=0.02
    )
