"""The range of the sensor: readings below a threshold are zero, readings above saturation clip.

p <- 0 where p < p_low, else min(p, p_high)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.config import quantity
from ..core.errors import ConfigError
from .base import BaseEffect, Context, PressureTransform


@dataclass(frozen=True)
class SensingRange(BaseEffect, stage="transducer", cost=9e-10):
    """A threshold and a saturation pressure that all taxels share."""

    threshold_relative: float = quantity("", 0.1, least=0.0)
    """Threshold, relative to p_0 at the reference force."""
    saturation_relative: float = quantity("", 0.8, above=0.0)
    """Saturation pressure, relative to p_0 at the reference force."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.saturation_relative > self.threshold_relative:
            raise ConfigError(
                "sensing_range.saturation_relative must exceed threshold_relative",
                value=f"{self.saturation_relative:g} p_0",
                limit=f"above {self.threshold_relative:g} p_0",
            )

    def bound(self, context: Context) -> float:
        """From what the range cuts off at either end, m."""
        cut = max(self.threshold_relative, 1.0 - self.saturation_relative)
        return context.reading_error_bound(min(cut, 1.0))

    def build(self, context: Context) -> PressureTransform:
        """A stateless transform."""
        low = self.threshold_relative * context.peak_pressure
        high = self.saturation_relative * context.peak_pressure
        return lambda pressures, frames: np.where(pressures < low, 0.0, np.minimum(pressures, high))
