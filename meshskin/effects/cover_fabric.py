"""A cover of fabric or foam that spreads pressure: a Gaussian blur in the skin's tangent plane.

    p(x) <- integral of p(x + u) N(u; 0, w^2 I) du,

by the product rule of Gauss and Hermite. It keeps the force: what the peak loses the rim gains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..core.config import quantity
from ..core.se3 import Array
from . import BaseEffect, Context
from .frames import Frames, PressureField

NODES = 5
"""Nodes along each axis."""
CELLS = 500_000
"""Most readings, at all nodes of all taxels, that are asked for at once."""
SAMPLES = 200
"""Distances from the patch's middle at which the bound looks at readings."""


@dataclass(frozen=True)
class CoverFabric(BaseEffect):
    """The pressure around a taxel, weighted by a bell."""

    width: float = quantity("m", 1e-3, above=0.0, most=0.1)
    """Standard deviation w of the bell along one axis."""

    name: ClassVar[str] = "cover_fabric"
    stage: ClassVar[str] = "field"
    cost: ClassVar[float] = 2.5e-6

    def bound(self, context: Context) -> float:
        """From the reading that the blur changes most, m, the reference contact being a circle."""
        from ..contact.disc import disc_mean

        a, disc = context.contact_radius, context.skin.disc_radius
        node, weight = _bell()
        r = np.linspace(0.0, a + disc + 4.0 * self.width, SAMPLES)
        x = r[:, None, None] + self.width * node[:, None]
        blurred = disc_mean(np.hypot(x, self.width * node) / a, disc / a)
        change = np.maximum(blurred, 0.0) @ weight @ weight - np.maximum(
            disc_mean(r / a, disc / a), 0
        )
        return context.reading_error_bound(min(float(np.abs(change).max()), 1.0))

    def build(self, context: Context) -> Callable[[PressureField], PressureField]:
        """A field without memory."""
        node, weight = _bell()

        def wrap(field: PressureField) -> PressureField:
            def blur(frames: Frames, poses: Array) -> Array:
                x, y = (self.width * at.ravel()[:, None, None] for at in np.meshgrid(node, node))
                beside = np.tile(poses, (len(x), 1, 1, 1))
                beside[..., :3, 3] += x * poses[:, :3, 0] + y * poses[:, :3, 1]
                beside = beside.reshape(-1, 4, 4)
                out = np.empty((len(frames), len(poses)))
                few = max(CELLS // max(len(beside), 1), 1)  # a call is dear, and so is memory
                for k in range(0, len(frames), few):
                    rows = slice(k, k + few)
                    read = field(frames.rows(rows), beside).reshape(-1, len(x), len(poses))
                    out[rows] = np.einsum("mkn,k->mn", read, np.outer(weight, weight).ravel())
                return out

            return blur

        return wrap


def _bell() -> tuple[Array, Array]:
    """Nodes of a normal distribution, and their weights."""
    node, weight = np.polynomial.hermite_e.hermegauss(NODES)
    return node, weight / weight.sum()
