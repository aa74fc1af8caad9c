"""Drift while the skin warms up.

p <- (1 + g w) p + o w p_0,   w = 1 - exp(-t / tau)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform
from .frames import Frames


@dataclass(frozen=True)
class TemperatureDrift(BaseEffect, stage="transducer", cost=7e-10):
    """Gain and offset of all taxels drift together towards those of the warm skin."""

    gain_drift: float = quantity("", 0.05, least=-0.9, most=10.0)
    """Final relative change g of the gain."""
    offset_relative: float = quantity("", 0.01, least=-1.0, most=1.0)
    """Final offset o, relative to p_0 at the reference force."""
    time_constant: float = quantity("s", 30.0, above=0.0)
    """Time constant tau of the warming, from the start of the first run."""

    def bound(self, context: Context) -> float:
        """From the change of a reading of p_0 on the warm skin, m."""
        return context.reading_error_bound(abs(self.gain_drift) + abs(self.offset_relative))

    def build(self, context: Context) -> PressureTransform:
        """A transform that depends on the times of the frames."""
        offset = self.offset_relative * context.peak_pressure

        def drift(pressures: Array, frames: Frames) -> Array:
            warm = -np.expm1(-frames.time / self.time_constant)[:, None]
            return (1.0 + self.gain_drift * warm) * pressures + offset * warm

        return drift
