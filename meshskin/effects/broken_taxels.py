"""Broken taxels: dead ones say nothing, stuck ones the same for ever."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.errors import ConfigError
from ..core.se3 import Array
from . import BaseEffect, Context, PressureTransform
from .frames import Frames


@dataclass(frozen=True)
class BrokenTaxels(BaseEffect):
    """Some taxels, drawn by chance; their numbers are rounded to whole taxels."""

    dead: float = quantity("", 0.02, least=0.0, most=1.0)
    """Part of the taxels that always read zero."""
    stuck: float = quantity("", 0.02, least=0.0, most=1.0)
    """Part of the taxels that always read one level."""
    level_relative: float = quantity("", 0.5, least=0.0)
    """That level, relative to p_0 at the reference force."""

    name: ClassVar[str] = "broken_taxels"
    stage: ClassVar[str] = "transducer"
    cost: ClassVar[float] = 2e-10

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dead + self.stuck > 1.0:
            raise ConfigError(
                "more taxels are broken than there are", value=self.dead + self.stuck, limit=1
            )

    def bound(self, context: Context) -> float:
        """The skin's extent, m: a stuck taxel may be taken for anywhere; a dead one for nowhere."""
        if not any(map(len, self.chosen(context))):
            return 0.0
        return float(np.linalg.norm(np.ptp(context.skin.positions, axis=0)))

    def chosen(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the dead and of the stuck taxels."""
        n = len(context.skin)
        order = context.stream(self.name).permutation(n)
        dead, broken = round(self.dead * n), min(round(self.dead * n) + round(self.stuck * n), n)
        return order[:dead], order[dead:broken]

    def build(self, context: Context) -> PressureTransform:
        """A function without memory; the taxels are drawn here."""
        dead, stuck = self.chosen(context)
        level = self.level_relative * context.peak_pressure

        def spoil(pressures: Array, frames: Frames) -> Array:
            out = pressures.copy()
            out[:, dead] = 0.0
            out[:, stuck] = level
            return out

        return spoil
