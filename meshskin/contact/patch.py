"""The contact patch: its size, its depth, and the pressure that taxels read in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.value import Value
from .ellipse import NODES, ellipse_mean


@dataclass(frozen=True, eq=False)
class Patch(Value):
    """An elliptic contact patch with the pressure p = peak (1 - x^2/a^2 - y^2/b^2)^exponent.

    The x axis of its frame is the principal direction of smaller curvature of the body.
    """

    semi_axes: Array
    """Semi-axes (a, b), a >= b, m."""
    peak: float
    """Pressure at the centre, Pa."""
    depth: float
    """Approach of the two bodies, m."""
    model: str
    """Name of the contact model that computed the patch."""
    exponent: float = 0.5
    """Exponent of the pressure profile; 1/2 for Hertz."""

    def pressure(self, xy: ArrayLike) -> Array:
        """Pressure (...), Pa, at points `xy` (..., 2), m, in the principal frame of the patch."""
        xy = np.asarray(xy, dtype=float)
        if not self.semi_axes.all():
            return np.zeros(xy.shape[:-1])
        inside = 1.0 - np.sum((xy / self.semi_axes) ** 2, axis=-1)
        return np.asarray(self.peak * np.maximum(inside, 0.0) ** self.exponent)

    def reading(self, xy: ArrayLike, disc_radius: float) -> Array:
        """Mean pressure (...), Pa, over discs of `disc_radius`, m, centred at `xy` (..., 2), m."""
        xy = np.asarray(xy, dtype=float)
        if not self.semi_axes.all():
            return np.zeros(xy.shape[:-1])
        x, y = xy[..., 0], xy[..., 1]
        a, b = self.semi_axes
        mean = ellipse_mean(x, y, a, b, disc_radius, self.exponent)
        return np.asarray(self.peak * np.maximum(mean, 0.0))


class Patches(NamedTuple):
    """Patches of many contacts: NumPy arrays (...), or CasADi expressions."""

    first: Any
    """Semi-axis along the body's first principal direction, m."""
    second: Any
    """Semi-axis along the body's second principal direction, m."""
    peak: Any
    """Pressure at the centre, Pa."""
    depth: Any
    """Approach of the two bodies, m."""
    exponent: Any = 0.5
    """Exponent of the pressure profile."""

    def reading(self, x: Any, y: Any, disc_radius: Any, nodes: int = NODES) -> Any:
        """Mean pressure, Pa, over discs of `disc_radius`, m, centred at (x, y), m.

        x, y: coordinates in the tangent plane along the first and second principal directions,
        relative to the contact point. NumPy (broadcast) or CasADi; for the error see
        `ellipse.NODES`.
        """
        mean = ellipse_mean(x, y, self.first, self.second, disc_radius, self.exponent, nodes)
        return self.peak * mean

    def take(self, rows: Any) -> Patches:
        """The patches of the contacts `rows`: a slice, a mask or indices."""
        exponent = self.exponent if np.ndim(self.exponent) == 0 else self.exponent[rows]
        return Patches(
            self.first[rows], self.second[rows], self.peak[rows], self.depth[rows], exponent
        )
