"""Taxels that average the pressure over discs of another radius than the skin's `disc_radius`.

p_i = 1 / (pi r^2) integral of p(x_i + u) du over |u| < r in the tangent plane
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..contact.reading import ReadingModel
from ..core.config import quantity
from .base import Context, ReadingModelEffect


@dataclass(frozen=True)
class DiscAveraging(ReadingModelEffect, stage="field", cost=1e-9):
    """The true radius of the discs over which the taxels average."""

    radius: float = quantity("m", above=0.0, most=0.1)
    """Radius of a taxel's disc."""

    def change(self, model: ReadingModel, context: Context) -> ReadingModel:
        """The reading model with discs of this radius."""
        return replace(model, disc_radius=self.radius)
