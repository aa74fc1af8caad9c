"""Arms with a free joint about the contact's normal: inverse kinematics that solves the spin.

A round indenter on a line fixed in the world cannot tell a turn of the arm about that line from the
opposite turn of the contact about its normal. So the poses that press one contact are one pose for
the arm on the turntable, whose first joint angle is minus the contact's spin: with five joints
there are single solutions for six unknowns, where spins on a grid have none. For an arm that
carries the indenter the free joint is a swivel at its tip.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.se3 import inverse
from .arm import Arm
from .urdf import numbers


def on_turntable(arm: Arm, centre: ArrayLike, axis: ArrayLike) -> Arm:
    """The arm with one more joint, its first, that turns it about a line fixed in the world.

    The line passes through `centre` (3,), m, along the unit vector `axis` (3,).
    """
    to_root = inverse(arm.base)
    along = to_root[:3, :3] @ np.asarray(axis, dtype=float)
    at = to_root[:3, :3] @ np.asarray(centre, dtype=float) + to_root[:3, 3]
    joints = [
        ("continuous", "turntable_base", "turntable", at),
        ("fixed", "turntable", arm.chain[0].parent, -at),
    ]
    return _with_free_joint(arm, joints, along, 0, arm.tip)


def with_swivel(arm: Arm, mount: ArrayLike) -> Arm:
    """The arm with one more joint, its last, that turns about the z axis of a frame on its tip.

    mount (4, 4): pose of that frame in the tip's frame. The tip of the result is at the frame's
    origin, with the axes of the arm's tip at joint angle zero.
    """
    at = np.asarray(mount, dtype=float)
    joints = [("continuous", arm.tip, "swivel", at[:3, 3])]
    return _with_free_joint(arm, joints, at[:3, 2], len(arm.joint_names), "swivel")


def _with_free_joint(
    arm: Arm, joints: list[tuple[str, str, str, Array]], axis: Array, column: int, tip: str
) -> Arm:
    """The arm with more joints (kind, parent, child, xyz), the first of which turns about an axis.

    The joint angle of that one is column `column` of the result's, without limits.
    """
    robot = ET.fromstring(arm.urdf)
    links = set(arm.tree.links)
    for kind, parent, child, xyz in joints:
        for name in {parent, child} - links:
            ET.SubElement(robot, "link", name=name)
        links |= {parent, child}
        joint = ET.SubElement(robot, "joint", name=f"{child}_{kind}", type=kind)
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        ET.SubElement(joint, "origin", xyz=numbers(xyz), rpy="0 0 0")
        ET.SubElement(joint, "axis", xyz=numbers(axis))
    names = list(arm.joint_names)
    names.insert(column, f"{joints[0][2]}_continuous")
    return replace(
        arm,
        urdf=ET.tostring(robot, encoding="unicode"),
        tip=tip,
        joint_names=tuple(names),
        lower=np.insert(arm.lower, column, -math.inf),
        upper=np.insert(arm.upper, column, math.inf),
        velocity_limit=np.insert(arm.velocity_limit, column, math.inf),
        effort_limit=np.insert(arm.effort_limit, column, math.inf),
        reflected_inertia=np.insert(arm.reflected_inertia, column, 0.0),
        damping=np.insert(arm.damping, column, 0.0),
        friction=np.insert(arm.friction, column, 0.0),
    )


def follow(
    arm: Arm, poses: ArrayLike, seed: ArrayLike, centre: ArrayLike, axis: ArrayLike
) -> Array:
    """`Arm.inverse_kinematics`, but an arm that cannot hold any pose turns its tip as it must.

    It turns about the line through `centre` (3,), m, along `axis` (3,), both in the world frame.
    """
    if arm.holds_any_pose:
        return arm.inverse_kinematics(poses, seed)
    start = np.concatenate([[0.0], np.asarray(seed, dtype=float)])
    q = on_turntable(arm, centre, axis).inverse_kinematics(poses, start)
    return np.ascontiguousarray(q[:, 1:])
