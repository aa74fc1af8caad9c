"""Viscoelastic relaxation: every point of the skin is a standard linear solid.

Under a sudden indentation the pressure relaxes as G(t) = g + (1 - g) exp(-t/tau) of its first
value:

    y = p - (1 - g) h,   dh/dt = (p - h) / tau,

integrated exactly for pressures that are linear between frames. The compliance law still controls
the force: all pressures are scaled by F / F_y, where F_y would remain of the force F. (For a
sliding contact the integral of h over the skin is the history of F alone, so that F_y is exact.)
Where the skin has not recovered it loses contact: y < 0 is set to 0, and the total force is
exceeded by as much. The leading half of a sliding patch reads more than the trailing half.
Source: K. L. Johnson, "Contact Mechanics" (1985), sections 6.5 and 9.4 (viscoelastic foundation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform
from .frames import MAX_FRAME_GAP, Frames


@dataclass(frozen=True)
class Relaxation(BaseEffect, stage="pressure", cost=4e-8):
    """A standard linear solid under each taxel, at controlled force."""

    relaxed: float = quantity("", 0.9, above=0.0, most=1.0)
    """Long-term stiffness g, relative to the instantaneous stiffness."""
    time_constant: float = quantity("s", 0.3, above=0.0)
    """Time constant tau of the relaxation."""

    def bound(self, context: Context) -> float:
        """From the difference of a fully relaxed and an unrelaxed point, m."""
        return context.reading_error_bound((1.0 - self.relaxed) / self.relaxed)

    def build(self, context: Context) -> PressureTransform:
        """A transform that keeps the load history of each taxel from batch to batch."""
        history = _LowPass(self.time_constant, MAX_FRAME_GAP * context.period)
        loss = 1.0 - self.relaxed

        def relax(pressures: Array, frames: Frames) -> Array:
            loads = np.column_stack([pressures, frames.force])
            relaxed = loads - loss * history.filter(frames.time, loads)
            scale = frames.force / np.maximum(relaxed[:, -1], 1e-300)
            return np.maximum(scale[:, None] * relaxed[:, :-1], 0.0)

        return relax


class _LowPass:
    """The low-pass filter dh/dt = (x - h) / tau of signals x (m, k), over successive batches."""

    def __init__(self, time_constant: float, max_gap: float) -> None:
        self.time_constant, self.max_gap = time_constant, max_gap
        self.last: tuple[float, Array, Array] | None = None

    def filter(self, time: Array, signals: Array) -> Array:
        """The state h (m, k) at the times (m,), s."""
        out = np.empty_like(signals)
        t, x, h = self.last or (float(time[0]), signals[0], np.zeros(signals.shape[1]))
        for k, now in enumerate(signals):
            step = float(time[k]) - t
            decay = np.exp(-step / self.time_constant)
            if step > self.max_gap:  # no contact in between
                h = decay * h
            elif step > 0:
                mean = (1.0 - decay) * self.time_constant / step
                h = decay * h + (1.0 - decay) * x + (1.0 - mean) * (now - x)
            out[k] = h
            t, x = float(time[k]), now
        self.last = t, x, h
        return out
