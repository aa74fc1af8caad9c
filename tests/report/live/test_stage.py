"""Where body, indenter, patch and links are on the live page."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.se3 import inverse
from meshskin.recording.skin_log import SkinLog
from meshskin.report.live.stage import Stage


def test_body_and_links_are_where_the_arm_holds_them(noisy, touched, stage):
    motion = touched.motion
    q = np.stack([motion.column(f"q{k + 1}").to_numpy() for k in range(6)], axis=1)
    tip = noisy.arm.pose(q)  # by CasADi; the links' poses are by the numeric chain
    np.testing.assert_allclose(stage.carrier.body, tip @ noisy.mount_pose, atol=1e-12)
    for row in (0, 7):
        mount = stage.carrier.link_poses(row)["mount"]
        np.testing.assert_allclose(mount, tip[row], atol=1e-12)


def test_a_body_that_moved_without_the_arm_is_where_its_motion_says(noisy, touched):
    import pyarrow as pa

    times = touched.motion.column("time")
    states = {name: np.zeros(len(times)) for name in ("x", "y", "z", "qw", "qx", "qy", "qz")}
    states |= {"z": np.arange(10) / 10, "qw": np.ones(10)}
    moved = replace(touched, motion=pa.table({"time": times} | states))
    stage = Stage.of_scene(moved, noisy, noisy.belief())
    assert not stage.carrier.links
    np.testing.assert_allclose(stage.carrier.body[:, 2, 3], states["z"], atol=1e-12)


def test_the_mount_reaches_from_the_tip_to_the_body(noisy, stage):
    rod = stage.carrier.links["mount"].vertices
    in_body = rod @ inverse(noisy.mount_pose)[:3, :3].T + inverse(noisy.mount_pose)[:3, 3]
    assert np.abs(noisy.body.closest(in_body).distance).min() < 1e-3
    assert np.linalg.norm(rod, axis=1).min() < 0.021


def test_the_indenter_is_pressed_in_by_the_depth(noisy, stage):
    contact = stage.contact(4)
    gap = noisy.body.closest(contact.indenter[None, :3, 3]).distance[0]
    patch = ms.contact.solve(
        force=3.0, curvature=10.0, indenter_radius=0.01, modulus=2e5, poisson=0.49
    )
    assert gap == pytest.approx(0.01 - patch.depth, rel=0.02)
    np.testing.assert_allclose(contact.semi_axes, patch.semi_axes, rtol=0.02)


def test_the_patch_lies_on_the_surface(noisy, touched, stage):
    contact = stage.contact(4)
    np.testing.assert_allclose(contact.patch[:3, 3], touched.points[4], atol=1e-5)
    normal = noisy.body.closest(touched.points[4:5]).normal[0]
    np.testing.assert_allclose(contact.patch[:3, 2], normal, atol=1e-9)


def test_without_a_robot_the_indenter_comes_along_the_normal(noisy, touched):
    stage = Stage.of_recording(replace(touched, motion=None), noisy.belief())
    assert stage.carrier is None
    contact = stage.contact(2)
    np.testing.assert_allclose(contact.indenter[:3, 2], -contact.patch[:3, 2], atol=1e-9)


def test_a_contact_outside_the_range_of_every_model_has_no_patch(noisy, touched):
    belief = noisy.belief(contact="layered", material=ms.Material(2e5, 0.49, 1e-5))
    stage = Stage(touched, belief)
    assert np.isnan(stage.contact(0).semi_axes).all()


def test_a_log_with_joint_angles_shows_its_robot(arm, noisy, touched):
    rng = np.random.default_rng(5)
    time = np.sort(np.concatenate([touched.time, touched.time + 1e-3, touched.time - 1e-3]))
    angles, ids = rng.uniform(-1, 1, (30, 6)), np.arange(80)
    log = SkinLog(
        time, arm.joint_names[::-1], angles[:, ::-1], ids, np.zeros((30, 80)), np.ones(80),
        np.ones(30, dtype=bool),
    )  # fmt: skip
    robot = ms.Robot(arm.name, Path("puma560.urdf"), arm.urdf, arm.tree)
    stage = Stage.of_log(touched, noisy.belief(), robot, "link4", log)
    row = 6
    q = angles[np.argmin(np.abs(time - touched.time[row]))]
    poses = stage.carrier.link_poses(row)
    assert "link4" not in poses  # it is the body
    down = robot.chain("link4", arm.tip).poses([q[4:]])[0]
    np.testing.assert_allclose(stage.carrier.body[row] @ down, arm.pose(q), atol=1e-12)
