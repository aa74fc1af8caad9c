"""Gains and offsets that differ between taxels.

p_i <- g_i p_i + o_i,   ln g_i ~ N(0, sigma_g^2),   o_i ~ N(0, (sigma_o p_0)^2)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform


@dataclass(frozen=True)
class GainOffset(BaseEffect, stage="transducer", cost=6e-10):
    """A gain and an offset of each taxel, constant in time."""

    gain_spread: float = quantity("", 0.05, least=0.0, most=1.0)
    """Standard deviation of ln(gain)."""
    offset_relative: float = quantity("", 0.005, least=0.0, most=1.0)
    """Standard deviation of the offsets, relative to p_0 at the reference force."""

    def bound(self, context: Context) -> float:
        """From a gain and an offset at 3 standard deviations, m."""
        gain = np.expm1(3.0 * self.gain_spread)
        return context.reading_error_bound(gain + 3.0 * self.offset_relative)

    def build(self, context: Context) -> PressureTransform:
        """A stateless transform; the gains and offsets are drawn here."""
        stream, n = context.stream(self.name), len(context.skin)
        gain = np.exp(self.gain_spread * stream.standard_normal(n))
        offset = self.offset_relative * context.peak_pressure * stream.standard_normal(n)
        return lambda pressures, frames: gain * pressures + offset
