"""A soft layer on a rigid core in a scene whose contact model assumes a half-space.

    a = f_a a_H,   p_0 = f_p p_H,   p(r) = p_0 (1 - r^2 / a^2)^m,   m = pi a^2 p_0 / F - 1,

where a_H and p_H are Hertz's, and the factors f_a < 1 and f_p > 1 of the contact model `layered`
depend on a_H / thickness and Poisson's ratio. Force, curvature and E* are those of the scene. The
closed loop, which controls the force, uses the contact model of the scene.
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
