"""Error of the body's pose on the tip: contacts are recorded in a displaced body frame.

    x_e <- exp(w) x_e + t,

where x_e is the indenter's centre in the body frame; the recorded contact is the point of the body
closest to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.config import quantity
from ..core.se3 import exp_so3
from .base import BaseEffect, Context, FrameTransform


@dataclass(frozen=True)
class BodyPose(BaseEffect, stage="geometry", cost=3e-8):
    """A rigid displacement of all recorded contacts."""

    translation: tuple[float, float, float] = quantity("m", (5e-4, 0.0, 0.0), least=-0.1, most=0.1)
    """Translation t, body frame."""
    rotation: tuple[float, float, float] = quantity("rad", (0.0, 0.0, 0.0), least=-4.0, most=4.0)
    """Rotation vector w about the origin of the body frame."""

    def bound(self, context: Context) -> float:
        """|t| plus |w| times the largest distance of a taxel from the origin, m."""
        reach = np.linalg.norm(context.skin.positions, axis=1).max() + context.indenter_radius
        return float(np.linalg.norm(self.translation) + np.linalg.norm(self.rotation) * reach)

    def build(self, context: Context) -> FrameTransform:
        """A stateless transform of the recorded centres."""
        rotation = exp_so3(self.rotation)
        return lambda frames: frames.with_centres(frames.centres @ rotation.T + self.translation)
