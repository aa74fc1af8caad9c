"""Different sampling rates: the recorded pose and force are older than the readings of the skin.

    x(t) <- x(T floor((t - d) / T)),

with the robot's sampling period T and the delay d of its samples, for pose, contact and force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.config import quantity
from .base import BaseEffect, Context, FrameTransform
from .frames import FrameHistory, Frames

SAMPLE_ROUNDING = 1e-6
"""Sampling periods by which a sample may lie after the frame that takes it: rounding of the times
must not replace the sample at a frame's own time by the one before."""


@dataclass(frozen=True)
class Sampling(BaseEffect, stage="robot", cost=2.5e-9):
    """The recorded contacts are held constant between the samples of the robot."""

    rate: float = quantity("Hz", 50.0, above=0.0, most=1e6)
    """Sampling rate of the robot."""
    delay: float = quantity("s", 0.0, least=0.0, most=10.0)
    """Delay of a sample."""

    def bound(self, context: Context) -> float:
        """The distance that the contact moves in a sampling period and the delay, m."""
        return context.speed * (1.0 / self.rate + self.delay)

    def build(self, context: Context) -> FrameTransform:
        """A transform that looks back in time, across batches too."""
        history = FrameHistory(1.0 / self.rate + self.delay, context.period)

        def hold(frames: Frames) -> Frames:
            history.append(frames)
            ticks = np.floor((frames.time - self.delay) * self.rate + SAMPLE_ROUNDING)
            return replace(history.interpolate(ticks / self.rate), time=frames.time)

        return hold
