"""Serial chains of joints: poses of the last frame in the first, and how they move with the joints.

A chain joins two links of a robot, whichever of them is nearer to the root, or is given by
Denavit-Hartenberg rows. Angles of sliding joints (rad) stand for displacements (m).

Source: Denavit, Hartenberg, "A kinematic notation for lower-pair mechanisms based on matrices",
J. Appl. Mech. 22 (1955); Siciliano and others, "Robotics" (2009), section 2.8.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_array, check_vectors
from ..core.arrays import Array
from ..core.errors import ArmError
from ..core.se3 import hat, is_rigid, transform
from .urdf import rotation


@dataclass(frozen=True, eq=False)
class ChainJoint:
    """One joint of a chain: it moves all that follows by `multiplier * angle + offset`."""

    origin: Array
    """Pose (4, 4) of the joint in the frame that the joint before it moves, m."""
    axis: Array
    """Unit vector (3,) in the joint's frame."""
    slides: bool
    """Whether the joint moves along its axis, m, and not about it, rad."""
    column: int
    """Index of the chain's angle that drives the joint."""
    multiplier: float = 1.0
    offset: float = 0.0
    """In rad, or in m where the joint slides."""

    def motions(self, angles: Array) -> Array:
        """Poses (n, 4, 4) of the frame that the joint moves, in the joint's, at `angles` (n, k)."""
        position = self.multiplier * angles[:, self.column] + self.offset
        if self.slides:
            return transform(np.eye(3), position[:, None] * self.axis)
        cross = hat(self.axis)
        sine, cosine = np.sin(position)[:, None, None], np.cos(position)[:, None, None]
        turn = np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)
        return transform(turn, np.zeros(3))


@dataclass(frozen=True, eq=False)
class Chain:
    """The joints between a base frame and a tip frame, in order from the base."""

    joint_names: tuple[str, ...]
    """Name of each angle (k,). An angle may drive several joints, which mimic each other."""
    joints: tuple[ChainJoint, ...]
    end: Array
    """Pose (4, 4) of the tip in the frame that the last joint moves, m."""

    def __repr__(self) -> str:
        return f"<Chain: {len(self.joints)} joints, angles {', '.join(self.joint_names)}>"

    @classmethod
    def from_dh(
        cls, rows: ArrayLike, fixed: Iterable[int] = (), names: Sequence[str] | None = None
    ) -> Chain:
        """The chain of Denavit-Hartenberg `rows` (m, 4): a, d (m), alpha, theta offset (rad).

        A row is the pose Rz(theta + angle) Tz(d) Tx(a) Rx(alpha) of a frame in the one before it:
        the standard convention, not the modified one. The rows of the indices `fixed`, which may
        count from the end (-1), have no angle. `names`: those of the angles, by default "joint_1"
        and so on. Raises ArmError.
        """
        table = check_vectors("rows of Denavit and Hartenberg", rows, 4, error=ArmError)
        if not np.isfinite(table).all():
            raise ArmError("rows of Denavit and Hartenberg must be finite")
        held = set()
        for row in fixed:
            if not -len(table) <= row < len(table):
                raise ArmError("no such fixed row", value=row, limit=f"{len(table)} rows")
            held.add(row % len(table))
        count = len(table) - len(held)
        names = [f"joint_{k + 1}" for k in range(count)] if names is None else names
        if len(names) != count or len(set(names)) != count:
            raise ArmError(
                "names of a chain's joints", value=list(names), limit=f"{count} different names"
            )
        joints, pose = list[ChainJoint](), np.eye(4)
        for k, row in enumerate(table):
            if k not in held:
                joints.append(ChainJoint(pose, np.array([0.0, 0.0, 1.0]), False, len(joints)))
                pose = np.eye(4)
            pose = pose @ dh_pose(*row)
        return cls(tuple(names), tuple(joints), pose)

    def with_tip(self, pose: ArrayLike) -> Chain:
        """This chain to another frame, at the rigid `pose` (4, 4), m, in the tip of this one."""
        if not is_rigid(pose):
            raise ArmError("pose of a chain's tip must be a rigid transform (4, 4)", value=pose)
        return replace(self, end=self.end @ np.asarray(pose, dtype=float))

    def poses(self, angles: ArrayLike) -> Array:
        """T_base_tip (n, 4, 4), m, at joint angles (n, k), rad. Raises ArmError."""
        return np.asarray(self._forward(self._check(angles))[-1] @ self.end)

    def jacobian(self, angles: ArrayLike) -> Array:
        """How the tip moves with the joint angles or their offsets, (n, 6, k), at angles (n, k).

        Velocity of the tip's origin, m/rad, over the angular velocity, rad/rad, in the axes of the
        base, as `Arm.jacobian`. Raises ArmError.
        """
        q = self._check(angles)
        moved = self._forward(q)
        tip = (moved[-1] @ self.end)[:, :3, 3]
        out = np.zeros((len(q), 6, len(self.joint_names)))
        for joint, pose in zip(self.joints, moved[1:], strict=True):
            axis = joint.multiplier * (pose[:, :3, :3] @ joint.axis)  # unmoved by its own joint
            if joint.slides:
                out[:, :3, joint.column] += axis
            else:
                out[:, :3, joint.column] += np.cross(axis, tip - pose[:, :3, 3])
                out[:, 3:, joint.column] += axis
        return out

    def _forward(self, angles: Array) -> list[Array]:
        """Poses (n, 4, 4) of the base and of the frame that each joint moves, in the base."""
        moved = [np.broadcast_to(np.eye(4), (len(angles), 4, 4))]
        for joint in self.joints:
            moved.append(moved[-1] @ joint.origin @ joint.motions(angles))
        return moved

    def _check(self, angles: ArrayLike) -> Array:
        """The angles as an array (n, k). Raises ArmError."""
        array = check_array("angles", angles, error=ArmError)
        k = len(self.joint_names)
        if array.ndim != 2 or array.shape[1] != k:
            raise ArmError(
                "the shape of angles of a chain is wrong", value=array.shape, limit=f"(n, {k})"
            )
        if not np.isfinite(array).all():
            raise ArmError("angles of a chain must be finite")
        return array


def dh_pose(a: float, d: float, alpha: float, theta: float) -> Array:
    """Pose (4, 4) Rz(theta) Tz(d) Tx(a) Rx(alpha); `a` and `d` in m, angles in rad."""
    turn = rotation([0.0, 0.0, theta])
    return transform(turn @ rotation([alpha, 0.0, 0.0]), turn @ [a, 0.0, d])
