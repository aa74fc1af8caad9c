"""Elliptic contact patches in a scene whose contact model assumes circles of the mean curvature.

The pressures are those of the contact model `elliptic` under the same force and E*. The effect
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
