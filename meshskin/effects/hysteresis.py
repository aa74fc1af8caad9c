"""Hysteresis that does not depend on rate: the Prandtl-Ishlinskii model.

    y = (1 - sum w_k) p + sum w_k P_k[p],   P_k <- max(p - r_k, min(p + r_k, P_k)), at first 0,

a sum of plays of half-widths r_k. Loading reads low, unloading high. A cycle between 0 and p, for
p > 2 r_k, has the area sum w_k 2 r_k (p - 2 r_k). Source: Brokate and Sprekels, "Hysteresis and
Phase Transitions" (1996), chapter 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.se3 import Array
from . import BaseEffect, Context, PressureTransform
from .frames import Frames


@dataclass(frozen=True)
class Hysteresis(BaseEffect):
    """Plays of equal weights, their half-widths spread evenly."""

    share: float = quantity("", 0.5, least=0.0, most=1.0)
    """Part of the reading that goes through plays, sum w_k."""
    width_relative: float = quantity("", 0.1, above=0.0, most=1.0)
    """Largest half-width, relative to p_0 at the reference force."""
    plays: int = quantity("", 4, least=1, most=100)
    """Number of plays."""

    name: ClassVar[str] = "hysteresis"
    stage: ClassVar[str] = "transducer"
    cost: ClassVar[float] = 7e-8

    @property
    def mean_width(self) -> float:
        """Mean half-width of the plays, relative to p_0."""
        return self.width_relative * (self.plays + 1) / (2 * self.plays)

    def bound(self, context: Context) -> float:
        """From the largest lag, m."""
        return context.reading_error_bound(self.share * self.mean_width)

    def build(self, context: Context) -> PressureTransform:
        """A function that remembers the plays from batch to batch."""
        width = self.width_relative * context.peak_pressure * np.arange(1, self.plays + 1)
        width = width[:, None] / self.plays
        play = np.zeros((self.plays, len(context.skin)))

        def lag(pressures: Array, frames: Frames) -> Array:
            nonlocal play
            out = (1.0 - self.share) * pressures
            for k, now in enumerate(pressures):
                play = np.maximum(now - width, np.minimum(now + width, play))
                out[k] += self.share * play.mean(axis=0)
            return out

        return lag
