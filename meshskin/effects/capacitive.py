"""The characteristic of a capacitive transducer: it saturates as the dielectric is squeezed out.

Two plates on a dielectric of strain s: C = C_0 / (1 - s). With Hooke's law, s = p/E_d, the reading
C_0 / (1 - p/E_d) would grow without bound until the plates meet. A foam stiffens and ends at a
limit: s = s_max p / (p + p_h). A reading scaled by its slope at zero is then

    (C/C_0 - 1) p_h / s_max = p / (1 + (1 - s_max) p / p_h),

which is linear at first and saturates at p_h / (1 - s_max). The plate model is elementary physics;
the hyperbola is the simplest stiffening law, its numbers are no fit to a particular skin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ..core.config import quantity
from ..core.se3 import Array
from . import BaseEffect, Context, PressureTransform
from .frames import Frames


@dataclass(frozen=True)
class Capacitive(BaseEffect):
    """Readings of a squeezed capacitor, scaled as if it were linear."""

    largest_strain: float = quantity("", 0.7, above=0.0, most=1.0)
    """Strain s_max that the dielectric ends at; at 1 the reading is linear."""
    half_relative: float = quantity("", 4.0, above=0.0)
    """Pressure p_h of half that strain, relative to the peak pressure at the reference force."""

    name: ClassVar[str] = "capacitive"
    stage: ClassVar[str] = "transducer"
    cost: ClassVar[float] = 5e-10

    def bound(self, context: Context) -> float:
        """From the readings that p_0 lacks, m."""
        bend = (1.0 - self.largest_strain) / self.half_relative
        return context.reading_error_bound(bend / (1.0 + bend))

    def build(self, context: Context) -> PressureTransform:
        """A function without memory."""
        bend = (1.0 - self.largest_strain) / (self.half_relative * context.peak_pressure)

        def saturate(pressures: Array, frames: Frames) -> Array:
            return pressures / (1.0 + bend * pressures)

        return saturate
