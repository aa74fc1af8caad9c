"""Friction of the joints, taken for contact force where this is inferred from joint torques.

In slow motion the motors carry bias + J^T n F + tau_f, where tau_f = T sign(qdot) is what Coulomb
friction takes. Who knows the bias alone infers, with h = J^T n,

    F <- F + h . tau_f / (h . h),

the least-squares force along the contact's normal n; where a joint is slower than `SLOW` its
friction fades to none. (An arm's own friction, from its URDF, acts in the closed loop; this is
about what its torques are taken for.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.errors import ConfigError
from ..core.se3 import Array
from . import BaseEffect, Context, FrameTransform
from .frames import FrameHistory, Frames

SLOW = 1e-3
"""Joint speed at which friction is at tanh(1) of its full value, rad/s."""
STEP = 1e-5
"""Of the differences that stand for derivatives, rad."""


@dataclass(frozen=True)
class JointFriction(BaseEffect):
    """Coulomb friction of the joints that the inferred force does not know of."""

    torque: float = quantity("N m", least=0.0)
    """T of every joint."""

    name: ClassVar[str] = "joint_friction"
    stage: ClassVar[str] = "robot"
    cost: ClassVar[float] = 4e-7

    def bound(self, context: Context) -> float:
        """With all joints' friction against the force, m, in the worst of all postures that hold
        the skin on the indenter; infinite where none is known.
        """
        if not context.joints:
            return 0.0
        q = context.postures()
        if not len(q):
            return np.inf
        pose = context.pose(q)
        foot = context.body.closest(
            np.einsum("kji,kj->ki", pose[:, :3, :3], context.indenter_position - pose[:, :3, 3])
        )
        h = levers(context, q, foot.point, foot.normal)
        worst = np.abs(h).sum(axis=1) / np.sum(h**2, axis=1)
        return context.force_error_bound(self.torque * float(worst.max()))

    def build(self, context: Context) -> FrameTransform:
        """A function that remembers the last frame. Raises ConfigError without an arm."""
        if not context.joints:
            raise ConfigError(
                "the effect joint_friction needs the joints of an arm",
                remedy='set loop.mode = "arm"',
            )
        memory = FrameHistory(context.period, context.period)

        def infer(frames: Frames) -> Frames:
            memory.extend(frames)
            turned = frames.q - memory.at(frames.time - context.period).q
            spent = self.torque * np.tanh(turned / context.period / SLOW)
            h = levers(context, frames.q, frames.points, frames.normals)
            more = np.sum(h * spent, axis=1) / np.sum(h**2, axis=1)
            return replace(frames, force=frames.force + more)

        return infer


def levers(context: Context, q: Array, points: Array, normals: Array) -> Array:
    """h = J^T n (k, joints), m: how far each joint moves the body's point along its normal, both
    (k, 3), body frame, by the angles q (k, joints).
    """
    pose = context.pose(q)
    normal = np.einsum("kij,kj->ki", pose[:, :3, :3], normals)

    def along(q: Array) -> Array:
        moved = context.pose(q)
        place = np.einsum("kij,kj->ki", moved[:, :3, :3], points) + moved[:, :3, 3]
        return np.asarray(np.sum(normal * place, axis=1))

    turns = STEP * np.eye(context.joints)
    return np.stack([along(q + t) - along(q - t) for t in turns], axis=1) / (2.0 * STEP)
