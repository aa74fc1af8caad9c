"""Noise and bias of the recorded force.

    F <- F + b + N(0, sigma^2)

The compliance law of the closed loop uses the true force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..core.config import quantity
from .base import BaseEffect, Context, FrameTransform
from .frames import Frames


@dataclass(frozen=True)
class ForceSensor(BaseEffect, stage="robot", cost=1.1e-10):
    """White noise and a constant bias."""

    noise: float = quantity("N", 0.02, least=0.0)
    """Standard deviation sigma."""
    bias: float = quantity("N", 0.05)
    """Bias b."""

    def bound(self, context: Context) -> float:
        """From the bias and 3 standard deviations of the noise, m."""
        return context.force_error_bound(3.0 * self.noise + abs(self.bias))

    def build(self, context: Context) -> FrameTransform:
        """A transform whose successive calls continue one random stream."""
        stream = context.stream(self.name)

        def measure(frames: Frames) -> Frames:
            noise = self.noise * stream.standard_normal(len(frames))
            return replace(frames, force=frames.force + self.bias + noise)

        return measure
