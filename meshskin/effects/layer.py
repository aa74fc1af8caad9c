"""A soft layer on a rigid core in a scene whose contact model assumes a half-space.

Under the same force the patch on a layer is smaller and its peak pressure higher. The pressures are
those of the contact model `layered` with the scene's force, curvature and E*. The closed loop,
which controls the force, uses the contact model of the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from ..contact import ContactModel
from ..contact.reading import ReadingModel
from ..core.config import quantity
from .base import Context, ReadingModelEffect


@dataclass(frozen=True)
class Layer(ReadingModelEffect, stage="field", cost=9e-8, excludes=("elliptic_patch",)):
    """A finite thickness of the skin that the scene ignores."""

    thickness: float = quantity("m", above=0.0)
    """Thickness of the soft layer."""

    def change(self, model: ReadingModel, context: Context) -> ReadingModel:
        """The reading model on a layer of this thickness."""
        return replace(model, model=ContactModel("layered", context.poisson, self.thickness))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """Raises ContactError where the layer is outside the range of `layered`."""
        self.bound(context)
        return super().build(context)
