"""Elliptic contact patches in a scene whose contact model assumes circles of the mean curvature.

    p(x, y) = p_0 sqrt(1 - x^2 / a^2 - y^2 / b^2),   p_0 = 3 F / (2 pi a b),

with the semi-axes a and b of the contact model `elliptic` under the same force and E*. The effect
changes nothing in a scene whose contact model already has elliptic patches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..contact import ContactModel
from ..contact.reading import ReadingModel
from .base import Context, ReadingModelEffect


@dataclass(frozen=True)
class EllipticPatch(ReadingModelEffect, stage="field", cost=1.8e-7, excludes=("layer",)):
    """The elliptic patch of unequal principal curvatures."""

    def change(self, model: ReadingModel, context: Context) -> ReadingModel:
        """The reading model with elliptic in place of circular patches."""
        if model.model.name != "hertz":
            return model
        return replace(model, model=ContactModel("elliptic"))
