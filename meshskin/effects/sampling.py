"""Sampling rates that differ: the robot's pose and force are older than the skin's readings.

A frame is recorded with the robot's last sample before it, which was taken at a whole multiple of
the robot's period, and arrives late.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from . import BaseEffect, Context, FrameTransform
from .frames import FrameHistory, Frames


@dataclass(frozen=True)
class Sampling(BaseEffect):
    """The recorded contacts are held between the robot's samples."""

    rate: float = quantity("Hz", 50.0, above=0.0, most=1e6)
    """Samples of the robot in a second."""
    delay: float = quantity("s", 0.0, least=0.0, most=10.0)
    """How late a sample arrives."""

    name: ClassVar[str] = "sampling"
    stage: ClassVar[str] = "robot"
    cost: ClassVar[float] = 2.5e-9

    def bound(self, context: Context) -> float:
        """The way of the contact in a period and the delay, m."""
        return context.speed * (1.0 / self.rate + self.delay)

    def build(self, context: Context) -> FrameTransform:
        """A function that looks back, over the seams of batches too."""
        memory = FrameHistory(1.0 / self.rate + self.delay, context.period)

        def hold(frames: Frames) -> Frames:
            memory.extend(frames)
            # the spare keeps a sample at the frame's own time from rounding into the one before
            sample = np.floor((frames.time - self.delay) * self.rate + 1e-6) / self.rate
            return replace(memory.at(sample), time=frames.time)

        return hold
