"""Scan order: the taxels of a module are read one after another, but a frame has one time stamp.

    t_s = t - l - c T (S - 1 - s) / S

is the time at which the taxel in slot s of S is read, with the time t of the frame, the latency l
and the duration c T of a scan, relative to the time T between frames. Its slot is its id modulo S
(ids are S * module + slot). All modules are scanned at the same time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..core.config import quantity
from .base import BaseEffect, Context
from .frames import FrameHistory, Frames, PressureField


@dataclass(frozen=True)
class ScanOrder(BaseEffect, stage="field", cost=1.5e-7):
    """Each slot reads the contact at its own time, interpolated between frames."""

    slots: int = quantity("", 12, least=1)
    """Taxels of a module that are read one after another."""
    scan_relative: float = quantity("", 1.0, above=0.0, most=1.0)
    """Duration of a scan, relative to the time between frames."""
    latency: float = quantity("s", 0.0, least=0.0, most=10.0)
    """Time between the reading of the last slot and the time of the frame."""

    def lags(self, context: Context) -> Array:
        """Time before the time of the frame at which each slot is read (slots,), s."""
        late = np.arange(self.slots)[::-1] / self.slots
        return np.asarray(self.latency + self.scan_relative * context.period * late)

    def bound(self, context: Context) -> float:
        """The distance that the contact moves in the largest lag, m."""
        return context.speed * float(self.lags(context).max())

    def build(self, context: Context) -> Callable[[PressureField], PressureField]:
        """A wrapper that makes a pressure field with a memory, across batches too."""
        lags, slot_of = self.lags(context), np.asarray(context.skin.ids) % self.slots
        history = FrameHistory(float(lags.max()), context.period)

        def wrap(field: PressureField) -> PressureField:
            def scan(frames: Frames, poses: Array) -> Array:
                history.append(frames)
                out = np.empty((len(frames), len(poses)))
                for slot, lag in enumerate(lags):
                    rows = slot_of == slot
                    out[:, rows] = field(history.interpolate(frames.time - lag), poses[rows])
                return out

            return scan

        return wrap
