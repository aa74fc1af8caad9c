"""Indenter offset: the indenter stands elsewhere than recorded, by an offset fixed in the world.

Its centre in the body frame is recorded at x + R^T d instead of x, R being the body's rotation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from . import BaseEffect, Context, FrameTransform
from .frames import Frames


@dataclass(frozen=True)
class IndenterOffset(BaseEffect):
    """The recorded place of the indenter less the true one."""

    offset: tuple[float, float, float] = quantity("m", (3e-4, 0.0, 0.0), least=-0.1, most=0.1)
    """d, world."""

    name: ClassVar[str] = "indenter_offset"
    stage: ClassVar[str] = "geometry"
    cost: ClassVar[float] = 5e-8

    def bound(self, context: Context) -> float:
        """|d|, m: on a convex body the foot moves less than the centre."""
        return float(np.linalg.norm(self.offset))

    def build(self, context: Context) -> FrameTransform:
        """A function without memory."""

        def displace(frames: Frames) -> Frames:
            rotation = context.pose(frames.q)[:, :3, :3]
            return frames.moved(
                frames.centres + np.einsum("kji,j->ki", rotation, np.array(self.offset))
            )

        return displace
