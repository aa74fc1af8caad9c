"""Arms with fewer than six joints or parallel axes: the spin about the normal is solved."""

from dataclasses import fields

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.se3 import exp_so3, inverse, transform
from meshskin.exploration.lane_plan import reachable_nodes
from meshskin.geometry.geodesics import any_tangents
from meshskin.geometry.region import Cap
from meshskin.robot import posture
from meshskin.robot.arm import Arm
from meshskin.robot.contact_rig import ContactRig
from meshskin.robot.turntable import on_turntable
from meshskin.scene import shipped_scenes

from .test_real_arms import urdf

CENTRE, AXIS = np.array([0.3, -0.2, 0.5]), np.array([0.6, 0.0, 0.8])
FINGER = (  # an index finger on its wrist: the axes of all but two joints are parallel
    ("0 -0.01 0.213", "0 1 0", -0.524, 0.175),
    ("0 0 0.034", "1 0 0", -0.698, 0.489),
    ("0.033 0 0.095", "0 -1 0", -0.349, 0.349),
    ("0 0 0", "1 0 0", -0.262, 1.571),
    ("0 0 0.045", "1 0 0", 0.0, 1.571),
    ("0 0 0.025", "1 0 0", 0.0, 1.571),
)


def finger():
    shape = '<collision><geometry><cylinder radius="0.006" length="0.012"/></geometry></collision>'
    links = "".join(f'<link name="l{k}">{shape}</link>' for k in range(len(FINGER) + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" velocity="2" effort="10"/></joint>'
        for k, (xyz, axis, low, high) in enumerate(FINGER)
    )
    return Arm.from_text(f'<robot name="finger">{links}{joints}</robot>', tip=f"l{len(FINGER)}")


def puma(tip="tool0"):
    return Arm.from_urdf(shipped_scenes.folder() / "puma560.urdf", tip=tip)


def spun(angles, centre=CENTRE, axis=AXIS):
    """Turns (k, 4, 4) about the line through the centre along the axis."""
    turn = exp_so3(np.asarray(angles)[:, None] * axis)
    return transform(turn, centre - turn @ centre)


def test_the_turntable_turns_the_arm_about_the_line():
    base = transform(exp_so3([0.3, -0.5, 0.9]), [0.1, 0.2, -0.3])
    arm = puma().with_base(base)
    turned = on_turntable(arm, CENTRE, AXIS)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (5, 7))
    np.testing.assert_allclose(
        turned.pose(q), spun(q[:, 0]) @ arm.pose(q[:, 1:]), rtol=0.0, atol=1e-14
    )
    for f in fields(arm):
        if isinstance(getattr(arm, f.name), np.ndarray) and f.name != "base":
            np.testing.assert_array_equal(getattr(turned, f.name)[1:], getattr(arm, f.name))


def test_only_an_arm_of_full_rank_holds_any_pose():
    assert puma().holds_any_pose
    assert finger().holds_any_pose
    assert not puma("link5").holds_any_pose


@pytest.mark.parametrize("arm", [puma("link5"), finger(), puma()], ids=["five", "finger", "six"])
def test_a_contact_that_can_be_made_is_found_with_its_spin(arm):
    rng = np.random.default_rng(1)
    room = posture.MIN_MARGIN + 0.02
    q = rng.uniform(arm.lower + room, arm.upper - room, (40, len(arm.joint_names)))
    targets = spun(rng.uniform(-np.pi, np.pi, len(q))) @ arm.pose(q)
    turned = on_turntable(arm, CENTRE, AXIS)
    nodes = posture.solve_spins(arm, turned, targets, anchor_spacing=1)
    found = nodes.within_limits
    assert found.any(axis=(1, 2)).all()
    k, place, b = np.nonzero(found)
    assert np.abs(nodes.offset[k, place, b]).max() <= 0.5 * posture.SPIN_STEP
    # a spin of the contact about the normal, against the axis, turns the body along the axis
    spin = posture.SPIN_STEP * place + nodes.offset[k, place, b]
    np.testing.assert_allclose(arm.pose(nodes.q[found]), spun(spin) @ targets[k], atol=1e-9)


@pytest.mark.deep
def test_all_of_60_taxels_of_a_real_arm_of_five_joints_are_reached():
    """Panda, link 5 (joints 1 to 5); spins on a grid reach none of them."""
    file = urdf("panda.urdf")
    folders = [str(folder) for folder in file.parents[:6]]
    arm = Arm.from_urdf(file, tip="panda_link5", folders=folders)
    body = ms.Body.from_urdf(file, "panda_link5", folders, kind="collision")
    skin = ms.Skin.cover(body, count=60, spacing=6e-3, seed=1, region=Cap((0.0, 1.0, 0.0)))
    indenter = ms.Indenter(8e-3, (0.4, 0.0, 0.5))
    rig = ContactRig(body, indenter, depth=3e-4, sensing_radius=5e-3, arm=arm)
    hit = body.closest(skin.positions)
    tangents = any_tangents(hit.normal)
    nodes, usable, reason = reachable_nodes(rig, hit.point, hit.normal, tangents, 1)
    assert (reason == "").sum() == 60
    k = np.nonzero(usable)[0]
    q = nodes.q[usable]
    pose = arm.pose(q)
    centres = rig.indenter_centres(hit.point, hit.normal)[k]
    at = np.einsum("kij,kj->ki", pose[:, :3, :3], centres) + pose[:, :3, 3]
    np.testing.assert_allclose(at, np.tile(indenter.position, (len(k), 1)), atol=1e-9)
    down = np.einsum("kij,kj->ki", pose[:, :3, :3], hit.normal[k])
    np.testing.assert_allclose(down, np.tile(-indenter.axis, (len(k), 1)), atol=1e-9)
    assert (np.minimum(q - arm.lower, arm.upper - q) >= posture.MIN_MARGIN).all()


@pytest.mark.slow
def test_an_so101_follows_lanes_over_all_of_a_skin():
    """Five joints that hold one spin at each contact; a capsule in front of the gripper."""
    arm = Arm.from_urdf(urdf("so101.urdf"), tip="gripper_frame_link")
    body = ms.Body.capsule(radius=0.02, length=0.06)
    skin = ms.Skin.cover(body, spacing=6e-3, region=ms.Disc((0.02, 0.0, 0.0), radius=0.02), seed=1)
    plan = ms.explore(
        body,
        skin,
        arm=arm,
        mount=transform(np.eye(3), [0.0, 0.0, 0.04]),
        indenter=ms.Indenter(5e-3, (0.28, 0.0, 0.25)),
        material=ms.Material(young=4e5),
        force=1.0,
    )
    assert len(skin) > 35
    assert plan.unreachable == {}


def test_a_finger_follows_its_path_where_the_spin_that_it_can_hold_is_narrow():
    arm, body = finger(), ms.Body.capsule(radius=0.008, length=0.018)
    mount = transform(np.eye(3), [0.0, 0.0, 0.013])
    pose = arm.pose([0.0, 0.0, 0.0, 0.7, 0.7, 0.4]) @ mount
    outward = pose[:3, 1]
    skin = ms.Skin.cover(
        body, count=20, spacing=3e-3, seed=1, region=Cap((0.0, 1.0, 0.0)), disc_radius=1e-3
    )
    plan = ms.explore(
        body,
        skin,
        arm=arm,
        mount=mount,
        indenter=ms.Indenter(2e-3, tuple(pose[:3, 3] + 0.01 * outward), direction=tuple(-outward)),
        material=ms.Material(young=2e6),
        force=1.0,
        exploration=ms.Exploration(lane_spacing=1.5e-3, margin=1e-3),
    )
    for segment in plan.segments:
        q = arm.inverse_kinematics(segment.poses @ inverse(mount), segment.postures[0])
        assert np.abs(np.diff(q, axis=0)).max() < 0.01
