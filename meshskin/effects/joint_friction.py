"""Joint friction that is attributed to the contact force when it is inferred from joint torques.

In slow motion the motor torques are bias + J^T n F + tau_f, with the Coulomb friction
tau_f = T sign(qdot). An estimate that knows the bias alone infers, with h = J^T n,

    F <- F + h . tau_f / (h . h),

the least-squares force along the contact normal n. Friction is smoothed to
T tanh(qdot / FRICTION_SPEED). The friction of the arm itself, from its URDF, acts in the closed
loop; this effect only changes the recorded force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.arrays import Array
from ..core.config import quantity
from ..core.errors import ConfigError
from .base import BaseEffect, Context, FrameTransform
from .frames import FrameHistory, Frames

FRICTION_SPEED = 1e-3
"""Joint speed at which friction reaches tanh(1) of its full value, rad/s: it smooths the
jump of sign(qdot) at resting joints, and is far below the speed of the joint that moves most in the
scene "sphere", 2.5 rad/s."""


@dataclass(frozen=True)
class JointFriction(BaseEffect, stage="robot", cost=4e-7):
    """Coulomb friction of the joints that the inferred force includes."""

    torque: float = quantity("N m", least=0.0)
    """Friction torque T of every joint."""

    def bound(self, context: Context) -> float:
        """The error with the friction of all joints against the force in the worst posture, m.

        The maximum over all postures that hold the skin on the indenter; infinite without any.
        """
        if not context.joints:
            return 0.0
        q = context.postures()
        if not len(q):
            return np.inf
        contact = context.body.closest(context.indenter_centres(q))
        h = lever_arms(context, q, contact.point, contact.normal)
        worst = np.abs(h).sum(axis=1) / np.sum(h**2, axis=1)
        return context.force_error_bound(self.torque * float(worst.max()))

    def build(self, context: Context) -> FrameTransform:
        """A transform that keeps the previous frame. Raises ConfigError without an arm."""
        if not context.joints:
            raise ConfigError(
                "the effect joint_friction needs the joints of an arm",
                remedy='set loop.mode = "arm"',
            )
        history = FrameHistory(context.period, context.period)

        def infer(frames: Frames) -> Frames:
            history.append(frames)
            step = frames.q - history.interpolate(frames.time - context.period).q
            friction = self.torque * np.tanh(step / context.period / FRICTION_SPEED)
            h = lever_arms(context, frames.q, frames.points, frames.normals)
            error = np.sum(h * friction, axis=1) / np.sum(h**2, axis=1)
            return replace(frames, force=frames.force + error)

        return infer


def lever_arms(context: Context, q: Array, points: Array, normals: Array) -> Array:
    """h = J^T n (k, joints), m: velocity of a point of the body along its normal per joint speed.

    points, normals (k, 3): in the body frame, in the configurations q (k, joints).
    """
    normal = np.einsum("kij,kj->ki", context.pose(q)[:, :3, :3], normals)

    def height(q: Array) -> Array:
        pose = context.pose(q)
        world = np.einsum("kij,kj->ki", pose[:, :3, :3], points) + pose[:, :3, 3]
        return np.asarray(np.sum(normal * world, axis=1))

    return context.joint_jacobian(height, q)
