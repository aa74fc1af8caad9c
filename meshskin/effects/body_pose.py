"""Error of the body's pose on the tip: what is recorded lies in another frame than the body's.

The indenter's centre is recorded at exp(w) x + t instead of x, and the contact is its foot there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.se3 import exp_so3
from . import BaseEffect, Context, FrameTransform
from .frames import Frames


@dataclass(frozen=True)
class BodyPose(BaseEffect):
    """A rigid displacement of all recorded contacts."""

    translation: tuple[float, float, float] = quantity("m", (5e-4, 0.0, 0.0), least=-0.1, most=0.1)
    """t, body frame."""
    rotation: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0), least=-4.0, most=4.0)
    """Rotation vector w about the body's origin."""

    name: ClassVar[str] = "body_pose"
    stage: ClassVar[str] = "geometry"
    cost: ClassVar[float] = 3e-8

    def bound(self, context: Context) -> float:
        """|t|, and |w| times the farthest taxel's distance, m."""
        far = np.linalg.norm(context.skin.positions, axis=1).max() + context.indenter_radius
        return float(np.linalg.norm(self.translation) + np.linalg.norm(self.rotation) * far)

    def build(self, context: Context) -> FrameTransform:
        """A function without memory."""
        turn = exp_so3(self.rotation)

        def displace(frames: Frames) -> Frames:
            return frames.moved(frames.centres @ turn.T + self.translation)

        return displace
