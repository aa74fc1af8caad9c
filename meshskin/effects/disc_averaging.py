"""Taxels that average the pressure over other discs than the skin says.

A skin with discs of 1 um reads the pressure at its taxels' centres; this puts discs in their place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from ..contact.reading import ReadingModel
from ..core.config import quantity
from . import BaseEffect, Context


@dataclass(frozen=True)
class DiscAveraging(BaseEffect):
    """The radius of the discs over which the taxels truly average."""

    radius: float = quantity("m", above=0.0, most=0.1)
    """Of a taxel's disc."""

    name: ClassVar[str] = "disc_averaging"
    stage: ClassVar[str] = "field"
    cost: ClassVar[float] = 1e-9

    def bound(self, context: Context) -> float:
        """From the reading that the other disc changes most, m."""
        return context.model_error_bound(self._with(context.reading_model))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A field without memory."""
        return self._with

    def _with(self, ideal: ReadingModel) -> ReadingModel:
        return replace(ideal, disc_radius=self.radius)
