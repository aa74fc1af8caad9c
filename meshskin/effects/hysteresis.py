"""Rate-independent hysteresis: the Prandtl-Ishlinskii model.

    y = (1 - sum w_k) p + sum w_k P_k[p],
    P_k <- max(p - r_k, min(p + r_k, P_k)), initially 0,

a weighted sum of play operators of half-widths r_k. Readings are low on loading and high on
unloading. Where the contact was lost between two frames, p was 0. A cycle between 0 and p, for
p > 2 r_k, has the area sum w_k 2 r_k (p - 2 r_k). Source: Brokate and Sprekels, "Hysteresis and
Phase Transitions" (1996), chapter 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform
from .frames import MAX_FRAME_GAP, Frames


@dataclass(frozen=True)
class Hysteresis(BaseEffect, stage="transducer", cost=7e-8):
    """Play operators of equal weights and evenly spaced half-widths."""

    share: float = quantity("", 0.5, least=0.0, most=1.0)
    """Sum of the weights w_k."""
    width_relative: float = quantity("", 0.1, above=0.0, most=1.0)
    """Largest half-width, relative to p_0 at the reference force."""
    plays: int = quantity("", 4, least=1, most=100)
    """Number of play operators."""

    @property
    def mean_width(self) -> float:
        """Mean half-width of the play operators, relative to p_0."""
        return self.width_relative * (self.plays + 1) / (2 * self.plays)

    def bound(self, context: Context) -> float:
        """From the largest lag of a reading, m."""
        return context.reading_error_bound(self.share * self.mean_width)

    def build(self, context: Context) -> PressureTransform:
        """A transform that keeps the states of the play operators from batch to batch."""
        width = self.width_relative * context.peak_pressure * np.arange(1, self.plays + 1)
        width = width[:, None] / self.plays
        play = np.zeros((self.plays, len(context.skin)))
        max_gap, last = MAX_FRAME_GAP * context.period, 0.0

        def lag(pressures: Array, frames: Frames) -> Array:
            nonlocal play, last
            out = (1.0 - self.share) * pressures
            for k, now in enumerate(pressures):
                if frames.time[k] - last > max_gap:
                    play = np.clip(play, -width, width)
                play = np.maximum(now - width, np.minimum(now + width, play))
                out[k] += self.share * play.mean(axis=0)
                last = frames.time[k]
            return out

        return lag
