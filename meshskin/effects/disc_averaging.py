"""Taxels that average the pressure over discs of another radius than the skin's `disc_radius`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from ..contact.reading import ReadingModel
from ..core.config import quantity
from .base import BaseEffect, Context


@dataclass(frozen=True)
class DiscAveraging(BaseEffect):
    """The true radius of the discs over which the taxels average."""

    radius: float = quantity("m", above=0.0, most=0.1)
    """Radius of a taxel's disc."""

    name: ClassVar[str] = "disc_averaging"
    stage: ClassVar[str] = "field"
    cost: ClassVar[float] = 1e-9

    def bound(self, context: Context) -> float:
        """From the largest change of a reading, m."""
        return context.model_error_bound(self._with_radius(context.reading_model))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A function that replaces the disc radius of a reading model."""
        return self._with_radius

    def _with_radius(self, reading_model: ReadingModel) -> ReadingModel:
        return replace(reading_model, disc_radius=self.radius)
