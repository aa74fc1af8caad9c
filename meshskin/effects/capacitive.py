"""The characteristic of a capacitive transducer, which saturates as its dielectric is compressed.

Two plates on a dielectric of strain s have the capacitance C = C_0 / (1 - s). With Hooke's law,
s = p/E_d, C would grow without bound until the plates meet. A foam stiffens towards a largest
strain: s = s_max p / (p + p_h). The reading, scaled by its slope at zero, is then

    (C/C_0 - 1) p_h / s_max = p / (1 + (1 - s_max) p / p_h),

which is linear at low pressure and saturates at p_h / (1 - s_max). The hyperbola is the simplest
stiffening law; its default parameters are not fitted to a particular skin.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform


@dataclass(frozen=True)
class Capacitive(BaseEffect, stage="transducer", cost=5e-10):
    """Readings of a compressed capacitor, scaled as if it were linear."""

    largest_strain: float = quantity("", 0.7, above=0.0, most=1.0)
    """Largest strain s_max of the dielectric; at 1 the reading is linear."""
    half_relative: float = quantity("", 4.0, above=0.0)
    """Pressure p_h at half that strain, relative to the peak pressure at the reference force."""

    def bound(self, context: Context) -> float:
        """From the reduction of the reading at p_0, m."""
        bend = (1.0 - self.largest_strain) / self.half_relative
        return context.reading_error_bound(bend / (1.0 + bend))

    def build(self, context: Context) -> PressureTransform:
        """A stateless transform."""
        bend = (1.0 - self.largest_strain) / (self.half_relative * context.peak_pressure)
        return lambda pressures, frames: pressures / (1.0 + bend * pressures)
