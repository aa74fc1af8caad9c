"""Quantisation: readings are integer multiples of a step, from 0 to the end of the scale.

p <- s min(max(round(p / s), 0), 2^bits - 1),   s = scale p_0 / (2^bits - 1)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform


@dataclass(frozen=True)
class Quantisation(BaseEffect, stage="transducer", cost=7e-10):
    """An analogue-to-digital converter with 2^bits levels."""

    bits: int = quantity("", 8, least=1, most=32)
    """Resolution; 8 and 16 bits are usual."""
    scale_relative: float = quantity("", 1.5, above=0.0)
    """End of the scale, relative to p_0 at the reference force."""

    def step(self, context: Context) -> float:
        """Pressure difference of adjacent levels, Pa."""
        return self.scale_relative * context.peak_pressure / (2**self.bits - 1)

    def bound(self, context: Context) -> float:
        """From half a step, or from what the end of the scale cuts off p_0, m."""
        half = self.step(context) / 2.0 / context.peak_pressure
        return context.reading_error_bound(max(half, 1.0 - self.scale_relative))

    def build(self, context: Context) -> PressureTransform:
        """A stateless transform."""
        step, top = self.step(context), 2**self.bits - 1
        return lambda pressures, frames: step * np.clip(np.rint(pressures / step), 0, top)
