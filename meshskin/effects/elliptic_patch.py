"""Elliptic patches, where the scene takes circles of the mean curvature.

The pressures are those of the contact model `elliptic`, the scene's own force and E* being kept. In
a scene whose model has ellipses already it changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from ..contact import ContactModel
from ..contact.reading import ReadingModel
from . import BaseEffect, Context


@dataclass(frozen=True)
class EllipticPatch(BaseEffect):
    """The ellipse that unequal curvatures make."""

    name: ClassVar[str] = "elliptic_patch"
    stage: ClassVar[str] = "field"
    excludes: ClassVar[tuple[str, ...]] = ("layer",)
    cost: ClassVar[float] = 1.8e-7

    def bound(self, context: Context) -> float:
        """From the reading that the ellipse changes most, m."""
        return context.model_error_bound(_stretched(context.reading_model))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A field without memory."""
        return _stretched


def _stretched(ideal: ReadingModel) -> ReadingModel:
    return replace(ideal, model=ContactModel("elliptic")) if ideal.model.name == "hertz" else ideal
