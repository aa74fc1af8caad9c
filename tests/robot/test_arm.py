"""The arm against pinocchio, against the published Puma 560, and against itself."""

import pickle
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshskin.core.errors import ArmError, ReachError, UnknownNameError
from meshskin.core.se3 import exp_so3, transform
from meshskin.robot.arm import Arm
from meshskin.robot.collision import arm_capsules
from meshskin.robot.dynamics import GRAVITY

PUMA = Path(__file__).parents[2] / "bodies" / "puma560.urdf"
COLUMN = np.array([0.0, 0.0, 0.672])  # from the floor to the shoulder, m
COM, INERTIA = np.array([0.01, -0.02, 0.1]), np.diag([0.01, 0.02, 0.02]) + 0.001

# A joint with limits, an endless joint, skew axes and a finger beside the chain.
ODD = """<robot name="odd">
  <link name="root"/>
  <joint name="turn" type="revolute"><parent link="root"/><child link="a"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.3 -0.2 0.5"/><axis xyz="1 2 2"/>
    <limit lower="-1" upper="1" effort="10" velocity="2"/></joint>
  <link name="a"><inertial><mass value="2"/><origin xyz="0 0.1 0" rpy="0.1 0.2 0.3"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01" ixz="0" iyz="0"/></inertial></link>
  <joint name="mount" type="fixed"><parent link="a"/><child link="b"/>
    <origin xyz="0 0 0.2" rpy="0 1 0"/></joint>
  <link name="b"><inertial><mass value="0.5"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="spin" type="continuous"><parent link="b"/><child link="c"/>
    <origin xyz="0.2 0 0" rpy="0 0 0.4"/><axis xyz="0 1 1"/></joint>
  <link name="c"><inertial><mass value="1"/><origin xyz="0.1 0 0" rpy="0 0 0"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="finger" type="revolute"><parent link="c"/><child link="d"/>
    <origin xyz="0 0.2 0"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="d"><inertial><mass value="0.3"/><origin xyz="0.1 0 0" rpy="0 0 0"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="flange" type="fixed"><parent link="c"/><child link="tip"/>
    <origin xyz="0 0 0.1" rpy="0.2 0 0"/></joint>
  <link name="tip"/>
</robot>"""


@pytest.fixture(scope="module")
def puma():
    return Arm.from_urdf(PUMA)


def model(arm):
    """M, bias, pose and Jacobian of the arm's expressions as one function."""
    q, qd = (ca.SX.sym(name, len(arm.joint_names)) for name in ("q", "qd"))
    d = arm.dynamics()
    outputs = [d.mass_matrix(q), d.bias(q, qd), *arm.kinematics(q)]
    return ca.Function("model", [q, qd], outputs, {"cse": True})


def oracle(arm, q, qd):
    """M, bias, pose and Jacobian from pinocchio; joints beside the chain are locked at zero."""
    pin = pytest.importorskip("pinocchio")
    full = pin.buildModelFromXML(arm.urdf)
    beside = [j for j in range(1, full.njoints) if full.names[j] not in arm.joint_names]
    m = pin.buildReducedModel(full, beside, pin.neutral(full))
    m.armature = arm.reflected_inertia
    m.gravity.linear = GRAVITY
    x = []
    for name, value in zip(arm.joint_names, q, strict=True):
        endless = m.joints[m.getJointId(name)].nq == 2
        x += [np.cos(value), np.sin(value)] if endless else [value]
    data, x, frame = m.createData(), np.array(x), m.getFrameId(arm.tip)
    mass = np.triu(pin.crba(m, data, x))
    bias = pin.nonLinearEffects(m, data, x, qd).copy()
    pin.forwardKinematics(m, data, x)
    pin.updateFramePlacements(m, data)
    jacobian = pin.computeFrameJacobian(m, data, x, frame, pin.LOCAL_WORLD_ALIGNED)
    return mass + np.triu(mass, 1).T, bias[:, None], data.oMf[frame].homogeneous, jacobian


@pytest.mark.parametrize("payloads", [0, 1, 2])
def test_puma_agrees_with_pinocchio(puma, payloads):
    arm = puma
    for _ in range(payloads):
        arm = arm.with_payload(1.5, COM, INERTIA)
    f, rng = model(arm), np.random.default_rng(payloads)
    for _ in range(20):
        q, qd = rng.uniform(arm.lower, arm.upper), rng.uniform(-3.0, 3.0, 6)
        for ours, theirs in zip(f(q, qd), oracle(arm, q, qd), strict=True):
            np.testing.assert_allclose(ours.full(), theirs, rtol=0, atol=1e-10)


def test_an_arm_on_a_moved_base_agrees_with_pinocchio(puma):
    """The base is a fixed joint of pinocchio's URDF; gravity is along the world's -z."""
    xyz, rpy = (0.3, -0.2, 1.1), (0.4, 1.2, -0.7)
    arm = puma.with_payload(1.5, COM, INERTIA).with_base(
        transform(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)
    )
    robot = ET.fromstring(arm.urdf)
    root = arm.chain[0].parent
    ET.SubElement(robot, "link", name="ground")
    joint = ET.SubElement(robot, "joint", name="stand", type="fixed")
    ET.SubElement(joint, "origin", xyz="0.3 -0.2 1.1", rpy="0.4 1.2 -0.7")
    ET.SubElement(joint, "parent", link="ground")
    ET.SubElement(joint, "child", link=root)
    walled = replace(puma, urdf=ET.tostring(robot, encoding="unicode"))
    f, rng = model(arm), np.random.default_rng(5)
    for _ in range(10):
        q, qd = rng.uniform(arm.lower, arm.upper), rng.uniform(-3.0, 3.0, 6)
        for ours, theirs in zip(f(q, qd), oracle(walled, q, qd), strict=True):
            np.testing.assert_allclose(ours.full(), theirs, rtol=0, atol=1e-10)
    q = rng.uniform(arm.lower, arm.upper, (5, 6))
    np.testing.assert_allclose(arm.pose(q), arm.base @ puma.pose(q), atol=1e-12)
    placed = arm_capsules(puma).points(q) @ arm.base[:3, :3].T + arm.base[:3, 3]
    np.testing.assert_allclose(arm_capsules(arm).points(q), placed, atol=1e-12)
    found = arm.solve(arm.pose(q[0]))
    np.testing.assert_allclose(arm.pose(found), arm.pose(q[0]), atol=1e-9)


@pytest.mark.parametrize(
    "base", [np.eye(3), 2.0 * np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)]
)
def test_a_base_must_be_a_rigid_transform(puma, base):
    with pytest.raises(ArmError, match=r"base of an arm must be a rigid transform T_w_base"):
        puma.with_base(base)


def test_an_arm_with_skew_axes_agrees_with_pinocchio():
    arm = Arm.from_text(ODD, tip="tip").with_payload(0.7, COM, INERTIA)
    assert arm.joint_names == ("turn", "spin")
    np.testing.assert_array_equal(arm.lower, [-1.0, -np.inf])
    np.testing.assert_array_equal(arm.velocity_limit, [2.0, np.inf])
    f, rng = model(arm), np.random.default_rng(0)
    for _ in range(10):
        q, qd = rng.uniform(-1.0, 1.0, 2), rng.uniform(-3.0, 3.0, 2)
        for ours, theirs in zip(f(q, qd), oracle(arm, q, qd), strict=True):
            np.testing.assert_allclose(ours.full(), theirs, rtol=0, atol=1e-10)


def test_a_prismatic_joint_agrees_with_pinocchio():
    text = ODD.replace(
        'type="revolute"><parent link="root"/>', 'type="prismatic"><parent link="root"/>'
    )
    arm = Arm.from_text(text, tip="tip")
    rng = np.random.default_rng(4)
    for _ in range(5):
        q, qd = rng.uniform(-1.0, 1.0, 2), rng.normal(size=2)
        for ours, theirs in zip(model(arm)(q, qd), oracle(arm, q, qd), strict=True):
            np.testing.assert_allclose(ours.full(), theirs, atol=1e-12)


def test_a_mimic_joint_agrees_with_pinocchio():
    """With all joints at G q + o, M becomes G^T M G (Featherstone, section 8)."""
    mimic = '<mimic joint="turn" multiplier="-2" offset="0.3"/>'
    arm = Arm.from_text(ODD.replace('<axis xyz="0 1 1"/>', '<axis xyz="0 1 1"/>' + mimic), "tip")
    free = Arm.from_text(ODD, tip="tip")
    assert arm.joint_names == ("turn",)
    gather, rng = np.array([[1.0], [-2.0]]), np.random.default_rng(5)
    for _ in range(5):
        q, qd = rng.uniform(-1.0, 1.0, 1), rng.normal(size=1)
        mass, bias, pose, jacobian = oracle(free, gather @ q + [0.0, 0.3], gather @ qd)
        got = [x.full() for x in model(arm)(q, qd)]
        expected = (gather.T @ mass @ gather, gather.T @ bias, pose, jacobian @ gather)
        for ours, theirs in zip(got, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_the_range_of_a_mimic_joint_limits_its_driver():
    spin = '<joint name="spin" type="continuous">'
    limited = ODD.replace(spin, spin.replace("continuous", "revolute")).replace(
        '<axis xyz="0 1 1"/>',
        '<axis xyz="0 1 1"/><limit lower="-1" upper="0.5" effort="1" velocity="1"/>'
        '<mimic joint="turn" multiplier="-2"/>',
    )
    arm = Arm.from_text(limited, tip="tip")
    np.testing.assert_allclose([arm.lower, arm.upper], [[-0.25], [0.5]])


def test_a_joint_that_moves_no_mass_is_named():
    bare = re.sub(r"<link name=\"c\">.*?</link>", '<link name="c"/>', ODD, flags=re.S)
    bare = re.sub(r"<link name=\"d\">.*?</link>", '<link name="d"/>', bare, flags=re.S)
    arm = Arm.from_text(bare, tip="tip")
    with pytest.raises(ArmError, match=r"joint 'spin' .* mass, got links c, d, tip; give one"):
        arm.dynamics()
    assert arm.with_payload(1.0, COM, INERTIA).dynamics()


def test_expressions_have_few_instructions(puma):
    assert model(puma).n_instructions() < 1600
    assert model(puma.with_payload(1.0, COM, INERTIA)).n_instructions() < 1900


def test_building_the_dynamics_prints_nothing(puma, capfd):
    Arm.from_urdf(PUMA).dynamics()
    assert capfd.readouterr() == ("", "")


def test_published_puma(puma):
    """Corke's p560 on its column: qz, qr, qs; the motors' inertia times the gear ratio squared."""
    assert puma.joint_names == tuple(f"joint{i}" for i in range(1, 7))
    pi = np.pi
    qz, qr, qs = np.zeros(6), [0, pi / 2, -pi / 2, 0, 0, 0], [0, 0, -pi / 2, 0, 0, 0]
    poses = puma.pose([qz, qr, qs])
    published = np.array(
        [[0.4521, -0.15005, 0.4318], [0.0203, -0.15005, 0.8636], [0.8636, -0.15005, -0.0203]]
    )  # from the shoulder
    np.testing.assert_allclose(poses[:, :3, 3], published + COLUMN, atol=1e-12)
    np.testing.assert_allclose(poses[0, :3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(
        puma.reflected_inertia, [0.784, 2.325, 0.577, 0.191, 0.171, 0.194], atol=5e-4
    )
    np.testing.assert_allclose(np.rad2deg(puma.upper), [160, 225, 45, 170, 100, 266])
    np.testing.assert_allclose(np.rad2deg(puma.lower), [-160, -45, -225, -110, -100, -266])
    np.testing.assert_allclose(puma.velocity_limit, [1.92, 1.51, 2.40, 5.34, 5.09, 5.74], atol=5e-3)


def test_gravity_torque_of_the_stretched_puma(puma):
    """In qs the arm lies along x: the shoulder carries every weight times its lever."""
    q, qd = ca.SX.sym("q", 6), ca.SX(6, 1)
    bias = ca.Function("bias", [q], [puma.dynamics().bias(q, qd)])
    levers = {17.4: 0.068, 4.8: 0.4318 + 0.07, 0.82: 0.4318 + 0.4508}
    levers |= {0.34: 0.8636, 0.09: 0.8636 + 0.032}
    expected = -GRAVITY[2] * sum(mass * lever for mass, lever in levers.items())
    assert float(bias([0, 0, -np.pi / 2, 0, 0, 0])[1]) == pytest.approx(expected, rel=1e-12)


def test_payload_adds_its_inertia(puma):
    """The kinetic energy gained is that of the body moving with the tip."""
    mass, rng = 2.0, np.random.default_rng(1)
    loaded = puma.with_payload(mass, COM, INERTIA)
    before, after = model(puma), model(loaded)
    q, qd = rng.uniform(puma.lower, puma.upper), rng.normal(size=6)
    pose, twist = puma.pose(q), puma.jacobian(q) @ qd
    speed = twist[:3] + np.cross(twist[3:], pose[:3, :3] @ COM)
    spin = pose[:3, :3].T @ twist[3:]
    gained = qd @ (after(q, qd)[0] - before(q, qd)[0]).full() @ qd
    assert gained == pytest.approx(mass * speed @ speed + spin @ INERTIA @ spin, rel=1e-10)
    np.testing.assert_array_equal(loaded.pose(q), pose)


def test_jacobian_is_the_derivative_of_the_pose(puma):
    q, h = np.random.default_rng(2).uniform(-1.0, 1.0, (5, 6)), 1e-6
    jacobian, rotations = puma.jacobian(q), puma.pose(q)[:, :3, :3]
    for k in range(6):
        step = h * np.eye(6)[k]
        rate = (puma.pose(q + step) - puma.pose(q - step)) / (2 * h)
        spin = rate[:, :3, :3] @ rotations.swapaxes(1, 2)
        np.testing.assert_allclose(jacobian[:, :3, k], rate[:, :3, 3], atol=1e-9)
        expected = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        np.testing.assert_allclose(jacobian[:, 3:, k], expected, atol=1e-9)


def test_batches_keep_their_shape(puma):
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (2, 3, 6))
    assert puma.pose(q).shape == (2, 3, 4, 4)
    assert puma.jacobian(q).shape == (2, 3, 6, 6)
    np.testing.assert_array_equal(puma.pose(q)[1, 2], puma.pose(q[1, 2]))
    np.testing.assert_array_equal(puma.jacobian(q)[1, 2], puma.jacobian(q[1, 2]))


def test_inverse_kinematics_follows_a_path(puma):
    s = np.linspace(0.0, 2.0 * np.pi, 500)[:, None]
    middle = np.array([0.3, 0.6, -2.6, 0.2, 0.7, 0.1])
    q = middle + 0.3 * np.sin(s * np.arange(1, 7) + np.arange(6))
    found = puma.inverse_kinematics(puma.pose(q), q[0] + 0.05)
    np.testing.assert_allclose(found, q, atol=1e-9)
    np.testing.assert_allclose(puma.pose(found), puma.pose(q), atol=2e-10)


def test_inverse_kinematics_winds_up_without_jumping(puma):
    """The last joint turns beyond half a turn, and its angle is continuous."""
    q = np.tile([0.3, 0.6, -2.6, 0.2, 0.7, 0.0], (300, 1))
    q[:, 5] = np.linspace(-4.0, 4.0, 300)
    np.testing.assert_allclose(puma.inverse_kinematics(puma.pose(q), q[0]), q, atol=1e-9)


def test_path_past_a_joint_limit_names_the_joint(puma):
    q = np.tile([0.3, 0.6, -2.6, 0.2, 0.7, 0.0], (100, 1))
    q[:, 4] = np.linspace(0.7, 2.0, 100)
    first = int(np.argmax(q[:, 4] > puma.upper[4]))
    with pytest.raises(ReachError, match=rf"pose {first} of 100 takes joint5 .*1\.7453\] rad"):
        puma.inverse_kinematics(puma.pose(q), q[0])


def test_path_out_of_reach_names_the_sample(puma):
    poses = np.tile(puma.pose([0.0, 0.3, -1.8, 0.1, 0.4, 0.0]), (50, 1, 1))
    poses[:, 0, 3] += np.linspace(0.0, 1.0, 50)
    far = np.linalg.norm(poses[:, :3, 3] - COLUMN, axis=1) > np.hypot(0.8641 + 1e-3, 0.15005)
    with pytest.raises(ReachError, match=r"pose (\d+) of 50.*residual.*seed") as caught:
        puma.inverse_kinematics(poses, [0.0, 0.3, -1.8, 0.1, 0.4, 0.0])
    assert abs(int(str(caught.value).split("pose ")[1].split()[0]) - np.argmax(far)) <= 1


def test_solve_finds_the_posture_farthest_from_the_joint_limits(puma):
    rng = np.random.default_rng(4)

    def margin(q):
        return np.minimum(q - puma.lower, puma.upper - q).min()

    for q in rng.uniform(puma.lower, puma.upper, (20, 6)):
        found = puma.solve(puma.pose(q))
        np.testing.assert_allclose(puma.pose(found), puma.pose(q), atol=2e-10)
        assert margin(found) >= margin(q) - 1e-6
        np.testing.assert_array_equal(found, puma.solve(puma.pose(q)))


def test_solve_starts_from_the_given_seed(puma):
    q = np.array([0.3, 0.6, -2.6, 0.2, 0.7, 0.1])
    np.testing.assert_allclose(puma.solve(puma.pose(q), seeds=[q + 0.05]), q, atol=1e-9)
    wound = q + 2 * np.pi * np.eye(6)[5]
    np.testing.assert_allclose(puma.solve(puma.pose(q), seeds=wound), q, atol=1e-9)


def test_solve_refuses_what_is_out_of_reach(puma):
    with pytest.raises(ReachError, match=r"cannot reach the pose at \[3\.0, 0\.0, 0\.0\] m"):
        puma.solve(transform(exp_so3([0.1, 0.2, 0.3]), [3.0, 0.0, 0.0]))


@pytest.mark.parametrize("shape", [(), (5,), (7,), (6, 1), (3, 5), (2, 2, 12), (0, 6)])
def test_angles_of_wrong_shape(puma, shape):
    for evaluate in (puma.pose, puma.jacobian):
        with pytest.raises(
            ArmError, match=re.escape(f"q has the wrong shape, got {shape}, limit: (...")
        ):
            evaluate(np.zeros(shape))


@pytest.mark.parametrize("shape", [(5, 1), (7, 1), (1, 6)])
def test_symbols_of_wrong_shape(puma, shape):
    with pytest.raises(ArmError, match=re.escape(f"q has the wrong shape, got {shape}")):
        puma.kinematics(ca.SX.sym("q", *shape))


def test_poses_and_seeds_of_wrong_shape(puma):
    pose, q = puma.pose(np.full(6, 0.3)), np.full(6, 0.3)
    np.testing.assert_allclose(puma.inverse_kinematics(pose, q), [q], atol=1e-9)

    def refused(name, shape, limit):
        return pytest.raises(
            ArmError, match=re.escape(f"{name} has the wrong shape, got {shape}, limit: {limit}")
        )

    for shape in [(3, 4), (16,), (2, 16), (0, 4, 4), (1, 2, 4, 4)]:
        with refused("poses", shape, "(k, 4, 4) or (4, 4)"):
            puma.inverse_kinematics(np.zeros(shape), q)
    for shape in [(), (5,), (1, 6), (12,)]:
        with refused("seed", shape, "(6,)"):
            puma.inverse_kinematics(pose, np.zeros(shape))
    for shape in [(3, 4), (1, 4, 4), (2, 4, 4)]:
        with refused("pose", shape, "(4, 4)"):
            puma.solve(np.zeros(shape))
    for shape in [(), (5,), (0, 6), (6, 1), (1, 2, 6)]:
        with refused("seeds", shape, "(k, 6) or (6,)"):
            puma.solve(pose, np.zeros(shape))
    with pytest.raises(ArmError, match="seeds must be numbers"):
        puma.solve(pose, [[0.0] * 6, [0.0] * 5])


def test_arm_survives_pickling(puma):
    puma.dynamics()
    again = pickle.loads(pickle.dumps(puma))
    np.testing.assert_array_equal(again.pose(np.ones(6)), puma.pose(np.ones(6)))
    assert again.urdf == puma.urdf


def test_unknown_tip_suggests_near_names():
    with pytest.raises(UnknownNameError, match=r"'tool1' in puma560\.urdf; did you mean tool0"):
        Arm.from_urdf(PUMA, tip="tool1")


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(ArmError, match="cannot read"):
        Arm.from_urdf(tmp_path / "none.urdf")
    (tmp_path / "bad.urdf").write_text("<robot><link></robot>")
    with pytest.raises(ArmError, match=r"bad XML in bad\.urdf"):
        Arm.from_urdf(tmp_path / "bad.urdf")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot ", "<sdf ", "root element is <sdf>"),
        ('"revolute"', '"planar"', "'turn' is planar"),
        ('lower="-1" upper="1" effort="10"', 'effort="10"', "'turn' has no <limit"),
        (
            'lower="-1" upper="1" effort="10"',
            'lower="1" upper="-1" effort="10"',
            r"lower limit of joint 'turn' is above the upper one, got 1.0 > -1.0",
        ),
        ('name="spin"', 'name="turn"', "two joints have one name, got turn"),
        ('xyz="0.1 0.2 0.3"', 'xyz="0.1 0.2"', r"bad xyz of joint 'turn'"),
        ('effort="10"', 'effort="strong"', r"bad effort of joint 'turn', got 'strong'"),
        ('xyz="1 2 2"', 'xyz="0 0 0"', "zero axis"),
        ('<parent link="b"/>', "", "no parent or child"),
        ('<parent link="b"/>', '<parent link="z"/>', "missing, got 'z'"),
        ('<child link="d"/>', '<child link="c"/>', "not form a tree"),
        ('<parent link="root"/>', '<parent link="c"/>', "not form a tree|form a loop"),
        ('<mass value="2"/>', "", "bad value of link 'a'"),
        (
            '<axis xyz="0 1 1"/>',
            '<mimic joint="turm"/>',
            "mimics a joint that is missing, got turm",
        ),
        ('<axis xyz="0 1 1"/>', '<mimic joint="spin"/>', "mimics itself"),
    ],
)
def test_bad_descriptions(old, new, message):
    text = ODD.replace(old, new, 1)
    if new.startswith("<sdf"):
        text = text.replace("</robot>", "</sdf>")
    with pytest.raises(ArmError, match=message):
        Arm.from_text(text, tip="tip")


def test_limits_of_zero_are_none():
    """As in the files of Kinova and Romeo arms."""
    arm = Arm.from_text(ODD.replace('effort="10"', 'effort="0"', 1), tip="tip")
    first = list(arm.joint_names).index("turn")
    assert arm.effort_limit[first] == np.inf


def test_no_moving_joint_before_the_tip():
    with pytest.raises(ArmError, match="no moving joint leads to the link 'root'"):
        Arm.from_text(ODD, tip="root")


@pytest.mark.parametrize(
    ("mass", "com", "inertia", "message"),
    [
        (-1.0, COM, INERTIA, "mass"),
        (1.0, [0.0, 0.0, np.nan], INERTIA, "mass or com"),
        (1.0, COM[:2], INERTIA, "shape"),
        (1.0, COM, -INERTIA, "positive"),
        (1.0, COM, INERTIA + np.eye(3, k=1), "symmetric"),
    ],
)
def test_bad_payloads(puma, mass, com, inertia, message):
    with pytest.raises(ArmError, match=message):
        puma.with_payload(mass, com, inertia)


def test_the_com_of_a_payload_moves_with_the_tip(puma):
    """A payload whose axes the arm turns agrees with the same link in pinocchio's model.

    Its gravity torque is that of its weight at the turned centre of mass.
    """
    com, mass = np.array([0.2, -0.1, 0.05]), 2.0
    loaded = puma.with_payload(mass, com, np.diag([0.01, 0.02, 0.025]))
    q = np.array([0.4, 0.7, -2.1, 0.9, 0.6, 1.3])
    gained = (model(loaded)(q, np.zeros(6))[1] - model(puma)(q, np.zeros(6))[1]).full()[:, 0]
    pose, jacobian = puma.pose(q), puma.jacobian(q)
    lever = pose[:3, :3] @ com
    assert np.abs(lever - com).max() > 0.05
    weight = -mass * GRAVITY
    np.testing.assert_allclose(
        gained, jacobian[:3].T @ weight + jacobian[3:].T @ np.cross(lever, weight), atol=1e-12
    )
    for ours, theirs in zip(model(loaded)(q, q), oracle(loaded, q, q), strict=True):
        np.testing.assert_allclose(ours.full(), theirs, rtol=0, atol=1e-10)
