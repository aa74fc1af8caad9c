"""Joint encoders: an offset of each joint, the same all the time, and noise in every frame.

The body's pose is computed from the angles q + offset + noise, and the contact with it. (The closed
loop itself runs on the true angles.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.errors import ConfigError
from ..core.se3 import Array
from . import BaseEffect, Context, FrameTransform
from .frames import Frames

RARELY = 3.44
"""Standard deviations beyond which a point of the plane is as rarely as a number is beyond 3."""
STEP = 1e-4
"""Of the differences that stand for derivatives, rad."""


@dataclass(frozen=True)
class Encoder(BaseEffect):
    """Errors of the recorded joint angles, as they show in the recorded contacts."""

    offset_spread: float = quantity("rad", 2e-4, least=0.0, most=1.0)
    """Standard deviation of the offsets."""
    noise_spread: float = quantity("rad", 5e-5, least=0.0, most=1.0)
    """Standard deviation of the noise."""

    name: ClassVar[str] = "encoder"
    stage: ClassVar[str] = "robot"
    cost: ClassVar[float] = 7e-8

    def bound(self, context: Context) -> float:
        """At 3 standard deviations, m, whatever path the arm takes; infinite where none is known.

        Angles off by dq move the recorded contact by J dq, J the Jacobian of the foot of the
        indenter's centre on the body. Over the surface that is two-dimensional, and longer than
        c sigma |J| (its largest singular value) with a chance below exp(-c^2 / 2). The noise is
        taken as if it did not average out.
        """
        if not context.joints:
            return 0.0
        spread = float(np.hypot(self.offset_spread, self.noise_spread))
        return RARELY * spread * lever(context)

    def build(self, context: Context) -> FrameTransform:
        """A function; successive calls continue one stream. Raises ConfigError without an arm."""
        if not context.joints:
            raise ConfigError(
                "the effect encoder needs the joints of an arm",
                remedy='set loop.mode = "arm"; where contacts are pressed without an arm, touch by '
                "the closed loop (simulate, adapt(touch=touched))",
            )
        stream = context.stream(self.name)
        offset = self.offset_spread * stream.standard_normal(context.joints)

        def misread(frames: Frames) -> Frames:
            noise = self.noise_spread * stream.standard_normal(frames.q.shape)
            shift = centres(context, frames.q + offset + noise) - centres(context, frames.q)
            return frames.moved(frames.centres + shift)

        return misread


def centres(context: Context, q: Array) -> Array:
    """The indenter's centre (k, 3), body frame, in configurations (k, n)."""
    pose = context.pose(q)
    return np.einsum("kji,kj->ki", pose[:, :3, :3], context.indenter_position - pose[:, :3, 3])


def lever(context: Context) -> float:
    """Largest singular value, m, of the Jacobian of the contact point by the joint angles, over
    all postures that hold the skin on the indenter.
    """
    q = context.postures()
    if not len(q):
        return np.inf

    def foot(q: Array) -> Array:
        return context.body.closest(centres(context, q)).point

    columns = [foot(q + turn) - foot(q - turn) for turn in STEP * np.eye(context.joints)]
    jacobian = np.stack(columns, axis=-1) / (2.0 * STEP)
    return float(np.linalg.norm(jacobian, 2, axis=(1, 2)).max())
