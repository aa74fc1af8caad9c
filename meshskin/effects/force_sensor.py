"""Noise and bias of the recorded force: F <- F + b + N(0, sigma^2); the law feels the true one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from ..core.config import quantity
from . import BaseEffect, Context, FrameTransform
from .frames import Frames


@dataclass(frozen=True)
class ForceSensor(BaseEffect):
    """White noise and a constant."""

    noise: float = quantity("N", 0.02, least=0.0)
    """Standard deviation."""
    bias: float = quantity("N", 0.05)
    """b."""

    name: ClassVar[str] = "force_sensor"
    stage: ClassVar[str] = "robot"
    cost: ClassVar[float] = 1.1e-10

    def bound(self, context: Context) -> float:
        """At 3 standard deviations, m."""
        return context.force_error_bound(3.0 * self.noise + abs(self.bias))

    def build(self, context: Context) -> FrameTransform:
        """A function; successive calls continue one stream."""
        stream = context.stream(self.name)

        def feel(frames: Frames) -> Frames:
            noise = self.noise * stream.standard_normal(len(frames))
            return replace(frames, force=frames.force + self.bias + noise)

        return feel
