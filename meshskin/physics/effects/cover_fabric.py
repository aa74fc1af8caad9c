"""A cover of fabric or foam that spreads pressure: a Gaussian blur in the skin's tangent plane.

    p(x) <- integral of p(x + u) N(u; 0, w^2 I) du,

by the product rule of Gauss and Hermite. It keeps the force: what the peak loses the rim gains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...config import quantity
from ...se3 import Array
from . import Context, Plain
from .frames import Field, Frames

NODES = 5
"""Nodes along each axis."""


@dataclass(frozen=True)
class CoverFabric(Plain):
    """The pressure around a taxel, weighted by a bell."""

    width: float = quantity("m", 1e-3, above=0.0, most=0.1)
    """Standard deviation w of the bell along one axis."""

    name: ClassVar[str] = "cover_fabric"
    stage: ClassVar[str] = "field"
    cost: ClassVar[float] = 2.5e-6

    def bound(self, context: Context) -> float:
        """From the rim, where p goes like the root of the distance: sqrt(w / a) of p_0, m."""
        return context.misread(min(np.sqrt(self.width / context.contact_radius), 1.0))

    def build(self, context: Context) -> Callable[[Field], Field]:
        """A field without memory."""
        node, weight = np.polynomial.hermite_e.hermegauss(NODES)
        weight /= weight.sum()

        def wrap(field: Field) -> Field:
            def blur(frames: Frames, poses: Array) -> Array:
                out = np.zeros((len(frames), len(poses)))
                for x, w_x in zip(node, weight, strict=True):
                    for y, w_y in zip(node, weight, strict=True):
                        beside = poses.copy()
                        beside[:, :3, 3] += self.width * (x * poses[:, :3, 0] + y * poses[:, :3, 1])
                        out += w_x * w_y * field(frames, beside)
                return out

            return blur

        return wrap
