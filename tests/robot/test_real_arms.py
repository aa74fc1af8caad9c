"""Arms of real robots against pinocchio, at random states.

The URDF files are the iCub's of real_data.py and those of the wheel `example-robot-data` (the
extra `robots`).
"""

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np
import pytest

from meshskin.robot.arm import Arm

from ..real_data import DATA, needs_icub
from .test_arm import model, oracle

ROBOTS = {
    "panda.urdf": "panda_hand_tcp",
    "ur5_robot.urdf": "tool0",
    "kinova.urdf": "j2s6s200_end_effector",
    "baxter.urdf": "left_gripper",
    "tiago.urdf": "arm_tool_link",  # on a sliding column
    "pr2.urdf": "r_gripper_tool_frame",  # sliding and endless joints
    "talos_left_arm.urdf": "gripper_left_base_link",
    "xarm7.urdf": "link7",
    "z1.urdf": "link06",
    "g1_29dof_rev_1_0.urdf": "left_wrist_yaw_link",
}
FIRST = ("panda.urdf", "tiago.urdf", "pr2.urdf")
"""Those of the default run: a plain chain, a sliding column, endless joints."""


def urdf(name):
    try:
        found = [f for f in files("example-robot-data") or [] if f.name == name]
    except PackageNotFoundError:
        pytest.skip("example-robot-data is not installed (extra: robots)")
    return Path(str(found[0].locate()))


def agrees(arm):
    n, rng = len(arm.joint_names), np.random.default_rng(7)
    ours = model(arm)
    for _ in range(3):
        q, qd = rng.uniform(-1.0, 1.0, n), rng.normal(size=n)
        for got, expected in zip(ours(q, qd), oracle(arm, q, qd), strict=True):
            np.testing.assert_allclose(got.full(), expected, atol=1e-11)


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=() if k in FIRST else pytest.mark.slow) for k in ROBOTS]
)
def test_real_arm_agrees_with_pinocchio(name):
    agrees(Arm.from_urdf(urdf(name), tip=ROBOTS[name]))


@pytest.mark.deep
@needs_icub
@pytest.mark.parametrize("tip", ["l_forearm", "l_lower_leg", "chest"])
def test_icub_agrees_with_pinocchio(tip):
    agrees(Arm.from_urdf(DATA / "icub_body" / "iCubGazeboV2_5.urdf", tip=tip))


def test_a_finger_driven_from_beside_the_chain_is_held():
    """The Panda's right finger mimics the left one, which the chain to the right does not pass."""
    hand = Arm.from_urdf(urdf("panda.urdf"), tip="panda_hand")
    finger = Arm.from_urdf(urdf("panda.urdf"), tip="panda_rightfinger")
    assert finger.joint_names == hand.joint_names
    q = np.zeros(7)
    assert np.isfinite(finger.pose(q)).all()
    agrees_in_mass = [float(np.abs(model(arm)(q, q)[0].full()).sum()) for arm in (hand, finger)]
    assert agrees_in_mass[0] == pytest.approx(agrees_in_mass[1])
