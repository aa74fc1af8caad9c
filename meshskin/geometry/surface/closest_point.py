"""What a query against a surface answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Closest:
    """Points of a surface answering n queries, in the body frame, SI units."""

    point: Array
    """(n, 3) foot points on the surface, in m"""
    distance: Array
    """(n,) signed distance in m, negative inside (for rays: the way along the ray)"""
    normal: Array
    """(n, 3) outward unit normals"""
    curvature: Array
    """(n, 2) principal curvatures in 1/m, positive where convex, larger first"""
    direction: Array
    """(n, 3) unit tangents along the first principal curvature; any tangent where both are equal"""
    face: NDArray[np.intp]
    """(n,) faces of the mesh; -1 where a ray missed (its other entries are NaN)"""
    uv: Array
    """(n, 2) barycentric weights of the face's second and third vertex"""

    def take(self, rows: Any) -> Closest:
        """The answers of some rows: a slice, a mask or indices."""
        return Closest(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Closest]) -> Closest:
        """The answers of several, one after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))
