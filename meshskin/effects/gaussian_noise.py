"""Gaussian noise of the transducers, independent per taxel and frame.

    p <- p + N(0, sigma^2)

sigma is relative to the peak contact pressure at the reference force: a property of the sensor's
range that does not vary with the contact.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform


@dataclass(frozen=True)
class GaussianNoise(BaseEffect, stage="transducer", cost=8e-9):
    """White noise added to the pressure of every taxel in every frame."""

    sigma_relative: float = quantity("", 0.01, above=0.0, most=1.0)
    """Standard deviation, relative to the peak pressure p_0 at the reference force."""

    def sigma(self, context: Context) -> float:
        """Standard deviation, Pa."""
        return self.sigma_relative * context.peak_pressure

    def bound(self, context: Context) -> float:
        """3 sigma_relative a, m: the distance error of one reading at 3 sigma, where the profile
        falls by p_0 over a. An estimate from many readings is more accurate than one reading.
        """
        return 3.0 * self.sigma_relative * context.contact_radius

    def build(self, context: Context) -> PressureTransform:
        """A transform whose successive calls continue one random stream.

        The noise does not depend on how the frames are divided into batches.
        """
        stream, sigma = context.stream(self.name), self.sigma(context)
        return lambda pressures, frames: pressures + sigma * stream.standard_normal(pressures.shape)
