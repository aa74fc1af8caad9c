"""A soft layer on a rigid core, where the scene takes a half-space.

Under the same force the patch on a layer is smaller and its peak higher: the pressures are those of
the contact model `layered`, the scene's own force, curvature and E* being kept. The closed loop,
which holds the force, runs on the scene's own model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from ..contact import ContactModel
from ..contact.reading import ReadingModel
from ..core.config import quantity
from . import BaseEffect, Context


@dataclass(frozen=True)
class Layer(BaseEffect):
    """The thickness of the skin, which the scene does not know of."""

    thickness: float = quantity("m", above=0.0)
    """Of the soft layer."""

    name: ClassVar[str] = "layer"
    stage: ClassVar[str] = "field"
    excludes: ClassVar[tuple[str, ...]] = ("elliptic_patch",)
    cost: ClassVar[float] = 9e-8

    def bound(self, context: Context) -> float:
        """From the reading that the layer changes most, m."""
        return context.model_error_bound(self._on(context.reading_model, context.poisson))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A field without memory. Raises ContactError where the layer leaves the model's range."""
        self.bound(context)
        return lambda ideal: self._on(ideal, context.poisson)

    def _on(self, ideal: ReadingModel, poisson: float) -> ReadingModel:
        return replace(ideal, model=ContactModel("layered", poisson, self.thickness))
