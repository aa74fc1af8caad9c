"""Elliptic contact patches in a scene whose contact model assumes circles of the mean curvature.

The pressures are those of the contact model `elliptic` under the same force and E*. The effect
changes nothing in a scene whose contact model already has elliptic patches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from ..contact import ContactModel
from ..contact.reading import ReadingModel
from .base import BaseEffect, Context


@dataclass(frozen=True)
class EllipticPatch(BaseEffect):
    """The elliptic patch of unequal principal curvatures."""

    name: ClassVar[str] = "elliptic_patch"
    stage: ClassVar[str] = "field"
    excludes: ClassVar[tuple[str, ...]] = ("layer",)
    cost: ClassVar[float] = 1.8e-7

    def bound(self, context: Context) -> float:
        """From the largest change of a reading, m."""
        return context.model_error_bound(_with_ellipse(context.reading_model))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A function that replaces the contact model of a reading model."""
        return _with_ellipse


def _with_ellipse(reading_model: ReadingModel) -> ReadingModel:
    if reading_model.model.name != "hertz":
        return reading_model
    return replace(reading_model, model=ContactModel("elliptic"))
