"""Serial chains against pinocchio, the arm's expressions, finite differences and published rows."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import meshskin as ms
from meshskin.core.errors import ArmError, UnknownNameError
from meshskin.core.se3 import exp_so3, inverse, log_so3, transform
from meshskin.robot.arm import Arm
from meshskin.robot.chain import Chain, dh_pose

from ..real_data import DATA, needs_icub
from .test_arm import ODD, PUMA

ICUB = DATA / "icub_body" / "iCubGazeboV2_5.urdf"
NAO_ARM = [
    (0.0, 0.1, -np.pi / 2, 0.0),
    (0.0, 0.098, np.pi / 2, 0.0),
    (0.0, 0.0, np.pi / 2, np.pi / 2),
    (0.015, 0.105, -np.pi / 2, 0.0),
    (0.0, 0.0, np.pi / 2, 0.0),
]
"""Rows of the left arm of NAO up to ElbowRoll, the first fixed (README of the data)."""
MIMIC = """<robot name="gripper"><link name="palm"/><link name="rail"/><link name="finger"/>
  <joint name="drive" type="revolute"><parent link="palm"/><child link="rail"/>
    <origin xyz="0 0.1 0" rpy="0.2 0 0.1"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="finger"/>
    <origin xyz="0.3 0 0" rpy="0 0.4 0"/><axis xyz="1 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="drive" multiplier="-0.5" offset="0.02"/></joint></robot>"""


def odd(tmp_path, text=ODD):
    path = tmp_path / "odd.urdf"
    path.write_text(text)
    return ms.Robot.from_urdf(path)


def differences(chain, angles, step=1e-6):
    """The Jacobian (n, 6, k) by central differences of the poses."""
    columns = []
    middle = chain.poses(angles)
    for k in range(len(chain.joint_names)):
        move = step * np.eye(len(chain.joint_names))[k]
        low, high = chain.poses(angles - move), chain.poses(angles + move)
        turn = high[:, :3, :3] @ np.swapaxes(low[:, :3, :3], 1, 2)
        columns.append(np.hstack([high[:, :3, 3] - low[:, :3, 3], log_so3(turn)]) / (2 * step))
    assert len(middle) == len(angles)
    return np.stack(columns, axis=-1)


def angles_of(chain, n=5, seed=3):
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (n, len(chain.joint_names)))


@pytest.mark.parametrize("text", [ODD, MIMIC])
def test_jacobian_is_the_derivative_of_the_poses(tmp_path, text):
    robot = odd(tmp_path, text)
    for base, tip in [(robot.links[0], robot.links[-1]), (robot.links[-1], robot.links[0])]:
        chain = robot.chain(base, tip)
        q = angles_of(chain)
        np.testing.assert_allclose(chain.jacobian(q), differences(chain, q), atol=1e-9)


def test_chain_of_a_file_agrees_with_the_arm(tmp_path):
    arm, chain = Arm.from_urdf(PUMA), ms.Robot.from_urdf(PUMA).chain("base", "tool0")
    assert chain.joint_names == arm.joint_names
    q = angles_of(chain)
    np.testing.assert_allclose(chain.poses(q), arm.pose(q), atol=1e-14)
    np.testing.assert_allclose(chain.jacobian(q), arm.jacobian(q), atol=1e-14)


def test_a_chain_backwards_is_the_inverse_and_branches_meet(tmp_path):
    robot = odd(tmp_path)
    there, back = robot.chain("a", "d"), robot.chain("d", "a")
    q = angles_of(there)
    assert back.joint_names == there.joint_names[::-1] == ("finger", "spin")
    np.testing.assert_allclose(back.poses(q[:, ::-1]), inverse(there.poses(q)), atol=1e-14)
    across = robot.chain("d", "tip")  # the two links meet in link c: the spin is not on the way
    assert across.joint_names == ("finger",)
    root_to = {tip: robot.chain("root", tip) for tip in ("d", "tip")}
    q = angles_of(root_to["d"])
    expected = inverse(root_to["d"].poses(q)) @ root_to["tip"].poses(q[:, :2])
    np.testing.assert_allclose(across.poses(q[:, 2:]), expected, atol=1e-14)
    rest = robot.chain("b", "b")
    assert rest.joint_names == ()
    assert rest.jacobian(np.zeros((2, 0))).shape == (2, 6, 0)
    np.testing.assert_array_equal(rest.poses(np.zeros((2, 0))), [np.eye(4)] * 2)


def test_a_mimic_joint_follows_its_driver(tmp_path):
    chain = odd(tmp_path, MIMIC).chain("palm", "finger")
    assert chain.joint_names == ("drive",)
    q = 0.7
    turn = transform(Rotation.from_euler("xyz", [0.2, 0, 0.1]).as_matrix(), [0, 0.1, 0])
    turn = turn @ transform(exp_so3([0, 0, q]), np.zeros(3))
    slide = transform(Rotation.from_euler("xyz", [0, 0.4, 0]).as_matrix(), [0.3, 0, 0])
    slide = slide @ transform(np.eye(3), (-0.5 * q + 0.02) * np.array([1, 1, 0]) / np.sqrt(2))
    np.testing.assert_allclose(chain.poses([[q]])[0], turn @ slide, atol=1e-15)


def test_rows_of_denavit_and_hartenberg_are_their_product():
    chain = Chain.from_dh(NAO_ARM, fixed=[0])
    assert chain.joint_names == ("joint_1", "joint_2", "joint_3", "joint_4")
    q = angles_of(chain)
    for pose, angles in zip(chain.poses(q), q, strict=True):
        expected = np.eye(4)
        for (a, d, alpha, theta), angle in zip(NAO_ARM, [0.0, *angles], strict=True):
            turn = Rotation.from_euler("z", theta + angle).as_matrix()
            expected = expected @ transform(turn, [0, 0, d])
            expected = expected @ transform(Rotation.from_euler("x", alpha).as_matrix(), [a, 0, 0])
        np.testing.assert_allclose(pose, expected, atol=1e-15)
    np.testing.assert_allclose(chain.jacobian(q), differences(chain, q), atol=1e-9)
    # at rest the arm points forward: 0.098 + 0.015 m to the side, 0.1 m up
    hand = chain.with_tip(dh_pose(0.0, 0.05595, -np.pi / 2, np.pi)).poses(np.zeros((1, 4)))[0]
    np.testing.assert_allclose(np.abs(hand[:3, 3]), [0.05595 + 0.105, 0.113, 0.1], atol=1e-12)


def test_the_last_row_may_be_fixed():
    wrist = (0.0, 0.05595, -np.pi / 2, np.pi)
    chain = Chain.from_dh([*NAO_ARM, wrist], fixed=[0, -1], names=list("abcd"))
    tipped = Chain.from_dh(NAO_ARM, fixed=[0]).with_tip(dh_pose(*wrist))
    q = angles_of(chain)
    assert chain.joint_names == ("a", "b", "c", "d")
    np.testing.assert_allclose(chain.poses(q), tipped.poses(q), atol=1e-15)


@needs_icub
@pytest.mark.parametrize(
    ("base", "tip"), [("chest", "l_forearm"), ("l_hand", "r_upper_leg"), ("l_hand", "root_link")]
)
def test_icub_agrees_with_pinocchio(base, tip):
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(ICUB))
    data, rng = model.createData(), np.random.default_rng(5)
    chain = ms.Robot.from_urdf(ICUB).chain(base, tip)
    frames = [model.getFrameId(name) for name in (base, tip)]
    every = {model.names[k]: model.joints[k].idx_v for k in range(1, model.njoints)}
    columns = [every[name] for name in chain.joint_names]
    for _ in range(3):
        q = rng.uniform(-1.5, 1.5, model.nq)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        start, end = (data.oMf[f] for f in frames)
        expected = start.inverse() * end
        np.testing.assert_allclose(chain.poses([q[columns]])[0], expected.homogeneous, atol=1e-13)
        world = [pin.getFrameJacobian(model, data, f, pin.LOCAL_WORLD_ALIGNED) for f in frames]
        arm = end.translation - start.translation
        carried = np.vstack([world[0][:3] - pin.skew(arm) @ world[0][3:], world[0][3:]])
        relative = np.kron(np.eye(2), start.rotation.T) @ (world[1] - carried)
        np.testing.assert_allclose(
            chain.jacobian([q[columns]])[0], relative[:, columns], atol=1e-13
        )
        assert np.abs(np.delete(relative, columns, axis=1)).max() < 1e-13


@needs_icub
def test_a_link_of_the_icub_is_a_body():
    robot = ms.Robot.from_urdf(ICUB, DATA / "icub_body" / "meshes")
    body = robot.body("l_forearm", open=True)
    assert 0.1 < max(body.mesh.extents) < 0.3
    assert repr(robot).startswith("<Robot 'iCub': ")


@pytest.mark.deep
def test_taxels_of_a_link_in_the_frame_of_another(tmp_path):
    skin = ms.Skin.cover(ms.Body.sphere(0.05), spacing=0.03, seed=1)
    robot = odd(tmp_path).with_skin("d", skin)
    chain = robot.chain("a", "d")
    q = angles_of(chain, n=2)
    found = robot.taxel_poses("d", "a", q)
    assert found.shape == (2, len(skin), 4, 4)
    np.testing.assert_allclose(found[1, 3], chain.poses(q)[1] @ skin.poses[3], atol=1e-14)
    with pytest.raises(ArmError, match="link 'c' has no skin"):
        robot.taxel_poses("c", "a", q)
    with pytest.raises(UnknownNameError, match="unknown link 'hand'"):
        robot.with_skin("hand", skin)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Chain.from_dh([[0, 0, 0]]), "rows of Denavit and Hartenberg must be vectors"),
        (lambda: Chain.from_dh(NAO_ARM, fixed=[5]), "no such fixed row, got 5, limit: 5 rows"),
        (lambda: Chain.from_dh([(0, np.nan, 0, 0)]), "must be finite"),
        (lambda: Chain.from_dh(NAO_ARM, names=["a"]), "limit: 5 different names"),
        (lambda: Chain.from_dh(NAO_ARM).poses(np.zeros(5)), r"limit: \(n, 5\)"),
        (lambda: Chain.from_dh(NAO_ARM).poses([[0, 0, np.inf, 0, 0]]), "must be finite"),
        (lambda: Chain.from_dh(NAO_ARM).with_tip(np.zeros((4, 4))), "rigid transform"),
        (lambda: ms.Robot.from_urdf("nowhere.urdf"), "'nowhere.urdf', got No such"),
    ],
)
def test_bad_input_is_one_line(call, message):
    with pytest.raises(ArmError, match=message) as error:
        call()
    assert "\n" not in str(error.value)


def test_joints_that_a_chain_cannot_have(tmp_path):
    floating = ODD.replace('name="spin" type="continuous"', 'name="spin" type="floating"')
    with pytest.raises(ArmError, match=r"joint .spin. in odd\.urdf is floating"):
        odd(tmp_path, floating).chain("root", "tip")
    with pytest.raises(UnknownNameError, match="did you mean tip"):
        odd(tmp_path).chain("root", "tipp")


@pytest.mark.parametrize("text", [ODD, MIMIC])
def test_offsets_in_a_file_are_those_of_the_readings(tmp_path, text):
    robot = odd(tmp_path, text)
    rng = np.random.default_rng(2)
    offsets = {name: float(rng.normal(scale=0.3)) for name in robot.joint_names}
    robot.with_joint_offsets(offsets).save(tmp_path / "corrected.urdf")
    again = ms.Robot.from_urdf(tmp_path / "corrected.urdf")
    before, after = (r.chain(robot.links[0], robot.links[-1]) for r in (robot, again))
    q = angles_of(before)
    shift = [offsets[name] for name in before.joint_names]
    np.testing.assert_allclose(after.poses(q), before.poses(q + shift), atol=1e-14)


@needs_icub
def test_a_corrected_icub_read_by_pinocchio(tmp_path):
    pin = pytest.importorskip("pinocchio")
    robot, rng = ms.Robot.from_urdf(ICUB), np.random.default_rng(6)
    offsets = {name: float(x) for name, x in zip(
        robot.joint_names, rng.normal(scale=0.02, size=len(robot.joint_names)), strict=True
    )}  # fmt: skip
    robot.with_joint_offsets(offsets).save(tmp_path / "corrected.urdf")
    models = [pin.buildModelFromUrdf(str(p)) for p in (ICUB, tmp_path / "corrected.urdf")]
    shift = np.array([offsets[models[0].names[k]] for k in range(1, models[0].njoints)])
    q = rng.uniform(-1, 1, models[0].nq)
    poses = []
    for model, angles in zip(models, (q + shift, q), strict=True):
        data = model.createData()
        pin.framesForwardKinematics(model, data, angles)
        poses.append([data.oMf[model.getFrameId(link)].homogeneous for link in robot.links])
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-12)


def test_a_corrected_file_is_the_original_but_for_the_origins():
    robot = ms.Robot.from_urdf(PUMA)
    corrected = robot.with_joint_offsets({"joint2": 0.01})
    assert "Unimation Puma 560" in corrected.text
    pairs = zip(robot.text.splitlines(), corrected.text.splitlines(), strict=True)
    changed = [(a.strip(), b.strip()) for a, b in pairs if a != b]
    assert [a for a, _ in changed] == ['<origin xyz="0 0 0" rpy="1.5707963267948966 0 0"/>']
    assert changed[0][1].startswith('<origin xyz="0.0 0.0 0.0" rpy="1.570')
    with pytest.raises(UnknownNameError, match="did you mean joint"):
        robot.with_joint_offsets({"jont2": 0.01})
    with pytest.raises(ArmError, match="offset of joint joint2 must be a finite number"):
        robot.with_joint_offsets({"joint2": np.nan})
