"""Scan order: the taxels of a module are read one after another, and a frame bears one time.

The taxel in slot s of S is read (S - 1 - s)/S of the scan before the frame's time. Its slot is its
id modulo S, ids being S * module + slot; all modules are scanned at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.se3 import Array
from . import BaseEffect, Context
from .frames import FrameHistory, Frames, PressureField


@dataclass(frozen=True)
class ScanOrder(BaseEffect):
    """Each slot reads the contact of its own time, interpolated between frames."""

    slots: int = quantity("", 12, least=1)
    """Taxels of a module that are read one after another."""
    scan_relative: float = quantity("", 1.0, above=0.0, most=1.0)
    """Length of a scan, relative to the time between frames."""
    latency: float = quantity("s", 0.0, least=0.0, most=10.0)
    """Time from the last slot's reading to the time that the frame bears."""

    name: ClassVar[str] = "scan_order"
    stage: ClassVar[str] = "field"
    cost: ClassVar[float] = 1.5e-7

    def lags(self, context: Context) -> Array:
        """How long before the frame's time each slot is read (slots,), s."""
        late = np.arange(self.slots)[::-1] / self.slots
        return np.asarray(self.latency + self.scan_relative * context.period * late)

    def bound(self, context: Context) -> float:
        """The way of the contact in the largest lag, m."""
        return context.speed * float(self.lags(context).max())

    def build(self, context: Context) -> Callable[[PressureField], PressureField]:
        """A field that looks back, over the seams of batches too."""
        lags, mine = self.lags(context), np.asarray(context.skin.ids) % self.slots
        memory = FrameHistory(float(lags.max()), context.period)

        def wrap(field: PressureField) -> PressureField:
            def scan(frames: Frames, poses: Array) -> Array:
                memory.extend(frames)
                out = np.empty((len(frames), len(poses)))
                for slot, lag in enumerate(lags):
                    rows = mine == slot
                    out[:, rows] = field(memory.at(frames.time - lag), poses[rows])
                return out

            return scan

        return wrap
