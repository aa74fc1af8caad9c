"""The contact patch: what a contact model gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...se3 import Array


@dataclass(frozen=True)
class Patch:
    """An elliptic contact patch with the pressure p = peak sqrt(1 - x^2/a^2 - y^2/b^2)."""

    semi_axes: Array
    """Semi-axes (a, b), a >= b, m."""
    peak: float
    """Pressure at the centre, Pa."""
    depth: float
    """Approach of the two bodies, m."""
    model: str
    """Name of the contact model that gave it."""

    def pressure(self, xy: ArrayLike) -> Array:
        """Pressure (...), Pa, at points `xy` (..., 2), m, in the patch's principal frame."""
        xy = np.asarray(xy, dtype=float)
        if not self.semi_axes.all():
            return np.zeros(xy.shape[:-1])
        inside = 1.0 - np.sum((xy / self.semi_axes) ** 2, axis=-1)
        return np.asarray(self.peak * np.sqrt(np.maximum(inside, 0.0)))
