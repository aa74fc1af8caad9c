"""Tests of distance from a surface, most of them by bounds from a grid of signed distances.

The signed distance of a closed surface has the Lipschitz constant 1. A point whose distance at the
nearest node differs from a limit by more than the distance to that node needs no closest point.
Source: Hart, "Sphere tracing", Visual Computer 12 (1996).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array
from .surface import Surface

NODES = 30_000
"""Nodes of a grid: their distances take as long as those of as many points."""
LIPSCHITZ = 1.05
"""Lipschitz constant of the distance of the smooth surface: slightly above 1 over coarse facets."""


class DistanceGrid:
    """Signed distances of a surface at nodes about it."""

    def __init__(self, surface: Surface, margin: float) -> None:
        """The nodes fill the surface's box, grown by the margin, m."""
        self._surface = surface
        self._low = surface.bounds[0] - margin
        size = surface.bounds[1] + margin - self._low
        self._step = float(np.prod(size) / NODES) ** (1.0 / 3.0)
        self._shape = np.ceil(size / self._step).astype(int) + 1
        self._closed = surface.closed
        nodes = np.indices(self._shape if self._closed else (0, 0, 0)).reshape(3, -1).T
        self._values = surface.closest(self._low + self._step * nodes).distance

    def within(self, points: Array, limits: Array) -> NDArray[np.bool_]:
        """Whether (n,) the signed distances of points (n, 3) are below limits (n,), m."""
        if not self._closed:  # the sign may change far from the surface
            return np.asarray(self._surface.closest(points).distance < limits)
        node = np.rint((points - self._low) / self._step).astype(int)
        node = np.clip(node, 0, self._shape - 1)
        way = points - self._low - self._step * node
        reach = LIPSCHITZ * np.sqrt(np.einsum("ij,ij->i", way, way))
        gap = self._values[np.ravel_multi_index(tuple(node.T), tuple(self._shape))] - limits
        out = np.asarray(gap < -reach)
        unsure = np.flatnonzero(np.abs(gap) <= reach)
        out[unsure] = self._surface.closest(points[unsure]).distance < limits[unsure]
        return out
