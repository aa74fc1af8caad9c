"""Viscoelastic relaxation: every place of the skin is a standard linear solid.

A place that is suddenly squeezed answers stiffly and then gives way, G(t) = g + (1 - g) exp(-t/tau)
of its first pressure:

    y = p - (1 - g) h,   dh/dt = (p - h) / tau,

the integral being exact for pressures that go linearly between frames. The law holds the force all
the same: all pressures are scaled by F / F_y, F_y being what would be left of the force F. (For a
contact that slides, the integral of h over the skin is the history of F alone, so that F_y is
exact.) Where the skin has not come back yet, it lets go: y < 0 is 0, and the force is exceeded by
as much. The leading half of a sliding patch reads more than the trailing one.
Source: K. L. Johnson, "Contact Mechanics" (1985), sections 6.5 and 9.4 (viscoelastic foundation).
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
class Relaxation(BaseEffect):
    """A standard linear solid under each taxel, at constant force."""

    relaxed: float = quantity("", 0.9, above=0.0, most=1.0)
    """Stiffness g after long, relative to that at first."""
    time_constant: float = quantity("s", 0.3, above=0.0)
    """tau of the relaxation."""

    name: ClassVar[str] = "relaxation"
    stage: ClassVar[str] = "pressure"
    cost: ClassVar[float] = 4e-8

    def bound(self, context: Context) -> float:
        """Between a place that is quite relaxed and one that is not at all, m."""
        return context.reading_error_bound((1.0 - self.relaxed) / self.relaxed)

    def build(self, context: Context) -> PressureTransform:
        """A function that remembers what each place has gone through, from batch to batch."""
        history = _History(self.time_constant, 1.5 * context.period)
        lost = 1.0 - self.relaxed

        def relax(pressures: Array, frames: Frames) -> Array:
            felt = np.column_stack([pressures, frames.force])
            left = felt - lost * history.of(frames.time, felt)
            held = frames.force / np.maximum(left[:, -1], 1e-300)
            return np.maximum(held[:, None] * left[:, :-1], 0.0)

        return relax


class _History:
    """The low pass dh/dt = (x - h) / tau of signals x (m, k), frame after frame."""

    def __init__(self, time_constant: float, longest: float) -> None:
        self.time_constant, self.longest = time_constant, longest
        self.last: tuple[float, Array, Array] | None = None

    def of(self, time: Array, signals: Array) -> Array:
        """h (m, k) at the times (m,)."""
        out = np.empty_like(signals)
        t, x, h = self.last or (float(time[0]), signals[0], np.zeros(signals.shape[1]))
        for k, now in enumerate(signals):
            step = float(time[k]) - t
            old = np.exp(-step / self.time_constant)
            if step > self.longest:  # without contact between
                h = old * h
            elif step > 0:
                mean = (1.0 - old) * self.time_constant / step
                h = old * h + (1.0 - old) * x + (1.0 - mean) * (now - x)
            out[k] = h
            t, x = float(time[k]), now
        self.last = t, x, h
        return out
