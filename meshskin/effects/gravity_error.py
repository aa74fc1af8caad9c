"""Error of the weight that a force sensor between tip and body is compensated for.

The sensor feels the contact force -F n and the body's weight; of the weight, the wrong part is
taken off. The recorded force is F + dm g n_z: less where the skin faces downwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from . import BaseEffect, Context, FrameTransform
from .frames import Frames

GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True)
class GravityError(BaseEffect):
    """A mass that the compensation does not know of."""

    mass: float = quantity("kg", 0.01, least=-100.0, most=100.0)
    """True mass less the believed one, dm."""

    name: ClassVar[str] = "gravity_error"
    stage: ClassVar[str] = "robot"
    cost: ClassVar[float] = 1.7e-8

    def bound(self, context: Context) -> float:
        """With the whole weight along the normal, m."""
        return context.force_error_bound(abs(self.mass) * GRAVITY)

    def build(self, context: Context) -> FrameTransform:
        """A function without memory."""

        def weigh(frames: Frames) -> Frames:
            down = np.einsum("kj,kj->k", context.pose(frames.q)[:, 2, :3], frames.normals)
            return replace(frames, force=frames.force + self.mass * GRAVITY * down)

        return weigh
