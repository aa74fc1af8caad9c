"""An arm on a turntable about the indenter's axis: inverse kinematics with the spin as an unknown.

A round indenter on a line fixed in the world cannot tell a turn of the arm about that line from the
opposite turn of the contact about its normal. So the poses that press one contact are one pose for
the arm on the turntable, whose first joint angle is minus the contact's spin: with five joints
there are single solutions for six unknowns, where spins on a grid have none.
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
    robot = ET.fromstring(arm.urdf)
    links = ["turntable_base", "turntable", arm.chain[0].parent]
    for name in links[:2]:
        ET.SubElement(robot, "link", name=name)
    for kind, parent, child, xyz in zip(
        ("continuous", "fixed"), links[:2], links[1:], (at, -at), strict=True
    ):
        joint = ET.SubElement(robot, "joint", name=f"{parent}_joint", type=kind)
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        ET.SubElement(joint, "origin", xyz=numbers(xyz), rpy="0 0 0")
        ET.SubElement(joint, "axis", xyz=numbers(along))

    def first(value: float, others: Array) -> Array:
        return np.concatenate([[value], others])

    return replace(
        arm,
        urdf=ET.tostring(robot, encoding="unicode"),
        joint_names=("turntable_base_joint", *arm.joint_names),
        lower=first(-math.inf, arm.lower),
        upper=first(math.inf, arm.upper),
        velocity_limit=first(math.inf, arm.velocity_limit),
        effort_limit=first(math.inf, arm.effort_limit),
        reflected_inertia=first(0.0, arm.reflected_inertia),
        damping=first(0.0, arm.damping),
        friction=first(0.0, arm.friction),
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
