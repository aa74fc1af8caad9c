"""Error of the gravity compensation of a force sensor between the tip and the body.

    F <- F + dm g n_z

The sensor measures the contact force -F n and the weight of the body, and the compensation
subtracts the weight of a wrong mass. The recorded force is too small where the skin faces
downwards (n_z < 0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.config import STANDARD_GRAVITY, quantity
from ..core.errors import ConfigError
from .base import BaseEffect, Context, FrameTransform
from .frames import Frames


@dataclass(frozen=True)
class GravityError(BaseEffect, stage="robot", cost=1.7e-8):
    """A mass that the gravity compensation ignores."""

    mass: float = quantity("kg", 0.01, least=-100.0, most=100.0)
    """True mass minus assumed mass, dm."""

    def bound(self, context: Context) -> float:
        """From the whole weight acting along the normal, m."""
        return context.force_error_bound(abs(self.mass) * STANDARD_GRAVITY)

    def build(self, context: Context) -> FrameTransform:
        """A stateless transform of the recorded force.

        Raises ConfigError for a carried indenter, whose frame the body's poses are given in.
        """
        if context.carried:
            raise ConfigError(
                "gravity_error needs the vertical, which the poses of a carried indenter lack",
                remedy="leave the effect out, or the indenter's carried_by",
            )

        def add_weight(frames: Frames) -> Frames:
            # world z component of the normals
            z = np.einsum("kj,kj->k", context.pose(frames.q)[:, 2, :3], frames.normals)
            return replace(frames, force=frames.force + self.mass * STANDARD_GRAVITY * z)

        return add_weight
