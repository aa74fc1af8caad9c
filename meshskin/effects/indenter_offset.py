"""Indenter offset: the recorded position of the indenter is wrong by a constant in the world frame.

    x_e <- x_e + R^T d,

where x_e is the indenter's centre in the body frame, and R the rotation of the body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.config import quantity
from .base import BaseEffect, Context, FrameTransform
from .frames import Frames


@dataclass(frozen=True)
class IndenterOffset(BaseEffect, stage="geometry", cost=5e-8):
    """The recorded position of the indenter minus the true one."""

    offset: tuple[float, float, float] = quantity("m", (3e-4, 0.0, 0.0), least=-0.1, most=0.1)
    """Offset d, world frame."""

    def bound(self, context: Context) -> float:
        """|d|, m: on a convex body the closest point moves less than the centre."""
        return float(np.linalg.norm(self.offset))

    def build(self, context: Context) -> FrameTransform:
        """A stateless transform of the recorded centres."""
        offset = np.array(self.offset)

        def displace(frames: Frames) -> Frames:
            rotation = context.pose(frames.q)[:, :3, :3]
            return frames.with_centres(frames.centres + np.einsum("kji,j->ki", rotation, offset))

        return displace
