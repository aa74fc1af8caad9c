"""Joint encoders: a constant offset of each joint angle, and noise in every frame.

    q <- q + b + n,   b ~ N(0, sigma_b^2) once,   n ~ N(0, sigma_n^2) in every frame

The recorded pose of the body, and the contact from it, are computed from these angles. The closed
loop itself, and the torques that give the recorded force, have the true angles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.config import quantity
from ..core.errors import ConfigError
from .base import BaseEffect, Context, FrameTransform
from .frames import Frames

PLANE_QUANTILE = 3.44
"""Standard deviations c with exp(-c^2 / 2) = erfc(3 / sqrt(2)): a point of the plane lies outside
as rarely (0.27 %) as a number lies outside 3 standard deviations."""


@dataclass(frozen=True)
class Encoder(BaseEffect, stage="robot", cost=7e-8):
    """Errors of the recorded joint angles, which displace the recorded contacts."""

    offset_spread: float = quantity("rad", 2e-4, least=0.0, most=1.0)
    """Standard deviation of the offsets."""
    noise_spread: float = quantity("rad", 5e-5, least=0.0, most=1.0)
    """Standard deviation of the noise."""

    def bound(self, context: Context) -> float:
        """The error at 3 standard deviations on any path of the arm, m; infinite without postures.

        Angle errors dq move the recorded contact by J dq, where J is the Jacobian of the point of
        the body closest to the indenter's centre. On the surface, which is two-dimensional, the
        displacement exceeds c sigma |J| (the largest singular value) with a probability below
        exp(-c^2 / 2). The noise is treated as if it did not average out.
        """
        if not context.joints:
            return 0.0
        spread = float(np.hypot(self.offset_spread, self.noise_spread))
        return PLANE_QUANTILE * spread * contact_point_gain(context)

    def build(self, context: Context) -> FrameTransform:
        """A transform whose successive calls continue one random stream.

        Raises ConfigError without an arm.
        """
        if not context.joints:
            raise ConfigError(
                "the effect encoder needs the joints of an arm",
                remedy='set loop.mode = "arm"; where contacts are pressed without an arm, touch by '
                "the closed loop (simulate, adapt(touch=touched))",
            )
        stream = context.stream(self.name)
        offset = self.offset_spread * stream.standard_normal(context.joints)

        def disturb(frames: Frames) -> Frames:
            q = frames.q + offset + self.noise_spread * stream.standard_normal(frames.q.shape)
            shift = context.indenter_centres(q) - context.indenter_centres(frames.q)
            return replace(frames.with_centres(frames.centres + shift), q=q)

        return disturb


def contact_point_gain(context: Context) -> float:
    """Largest singular value, m, of the Jacobian of the contact point by the joint angles.

    The maximum over all postures that hold the skin on the indenter; infinite where there are none.
    """
    q = context.postures()
    if not len(q):
        return np.inf
    jacobian = context.joint_jacobian(
        lambda q: context.body.closest(context.indenter_centres(q)).point, q
    )
    return float(np.linalg.norm(jacobian, 2, axis=(1, 2)).max())
