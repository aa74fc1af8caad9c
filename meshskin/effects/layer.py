"""A soft layer on a rigid core in a scene whose contact model assumes a half-space.

Under the same force the patch on a layer is smaller and its peak pressure higher. The pressures are
those of the contact model `layered` with the scene's force, curvature and E*. The closed loop,
which controls the force, uses the contact model of the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from ..contact import ContactModel
from ..contact.reading import ReadingModel
from ..core.config import quantity
from .base import BaseEffect, Context


@dataclass(frozen=True)
class Layer(BaseEffect):
    """A finite thickness of the skin that the scene ignores."""

    thickness: float = quantity("m", above=0.0)
    """Thickness of the soft layer."""

    name: ClassVar[str] = "layer"
    stage: ClassVar[str] = "field"
    excludes: ClassVar[tuple[str, ...]] = ("elliptic_patch",)
    cost: ClassVar[float] = 9e-8

    def bound(self, context: Context) -> float:
        """From the largest change of a reading, m."""
        return context.model_error_bound(self._on_layer(context.reading_model, context.poisson))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A function that replaces the contact model of a reading model.

        Raises ContactError where the layer is outside the range of `layered`.
        """
        self.bound(context)
        return lambda reading_model: self._on_layer(reading_model, context.poisson)

    def _on_layer(self, reading_model: ReadingModel, poisson: float) -> ReadingModel:
        return replace(reading_model, model=ContactModel("layered", poisson, self.thickness))
