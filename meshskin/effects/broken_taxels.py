"""Broken taxels: dead ones always read zero, stuck ones always read the same pressure.

p_i <- 0 where dead,   p_i <- l p_0 where stuck
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..core.config import quantity
from ..core.errors import ConfigError
from .base import BaseEffect, Context, PressureTransform
from .frames import Frames


@dataclass(frozen=True)
class BrokenTaxels(BaseEffect, stage="transducer", cost=2e-10):
    """Randomly chosen broken taxels; their numbers are rounded to integers."""

    dead: float = quantity("", 0.02, least=0.0, most=1.0)
    """Fraction of the taxels that always read zero."""
    stuck: float = quantity("", 0.02, least=0.0, most=1.0)
    """Fraction of the taxels that always read one level."""
    level_relative: float = quantity("", 0.5, least=0.0)
    """Level of the stuck taxels, relative to p_0 at the reference force."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dead + self.stuck > 1.0:
            raise ConfigError(
                "broken_taxels.dead + broken_taxels.stuck is out of range",
                value=self.dead + self.stuck,
                limit="at most 1",
            )

    def bound(self, context: Context) -> float:
        """The extent of the skin, m: a stuck taxel can be estimated to lie anywhere on it."""
        if not any(map(len, self.chosen(context))):
            return 0.0
        return float(np.linalg.norm(np.ptp(context.skin.positions, axis=0)))

    def chosen(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the dead taxels and of the stuck taxels."""
        n = len(context.skin)
        order = context.stream(self.name).permutation(n)
        dead, broken = round(self.dead * n), min(round(self.dead * n) + round(self.stuck * n), n)
        return order[:dead], order[dead:broken]

    def build(self, context: Context) -> PressureTransform:
        """A stateless transform; the taxels are drawn here."""
        dead, stuck = self.chosen(context)
        level = self.level_relative * context.peak_pressure

        def replace_readings(pressures: Array, frames: Frames) -> Array:
            out = pressures.copy()
            out[:, dead] = 0.0
            out[:, stuck] = level
            return out

        return replace_readings
