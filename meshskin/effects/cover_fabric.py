"""A cover of fabric or foam that spreads pressure: a Gaussian blur in the skin's tangent plane.

    p(x) <- integral of p(x + u) N(u; 0, w^2 I) du,

by the product rule of Gauss-Hermite quadrature. The blur preserves the contact force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..contact.disc import disc_mean
from ..core.arrays import Array
from ..core.config import quantity
from .base import BaseEffect, Context
from .frames import Frames, PressureField

NODES = 5
"""Quadrature nodes along each axis: exact for polynomials up to degree 9. On the paper's sphere
readings are within 0.13 % of p_0 of those with 21 nodes at w = 1 mm."""
MAX_READINGS = 500_000
"""Most readings, at all nodes of all taxels, per call of the field: 4 MB per array of them."""
BOUND_SAMPLES = 200
"""Distances from the patch's centre at which the bound compares readings: 0.05 mm apart."""


@dataclass(frozen=True)
class CoverFabric(BaseEffect, stage="field", cost=2.5e-6):
    """Each taxel reads the pressure around it, weighted by a Gaussian."""

    width: float = quantity("m", 1e-3, above=0.0, most=0.1)
    """Standard deviation w of the Gaussian along one axis."""

    def bound(self, context: Context) -> float:
        """From the largest change of a reading under a circular reference contact, m."""
        a, disc = context.contact_radius, context.skin.disc_radius
        node, weight = _gauss_hermite()
        r = np.linspace(0.0, a + disc + 4.0 * self.width, BOUND_SAMPLES)
        x = r[:, None, None] + self.width * node[:, None]
        blurred = disc_mean(np.hypot(x, self.width * node) / a, disc / a)
        plain = np.maximum(disc_mean(r / a, disc / a), 0)
        change = np.maximum(blurred, 0.0) @ weight @ weight - plain
        return context.reading_error_bound(min(float(np.abs(change).max()), 1.0))

    def build(self, context: Context) -> Callable[[PressureField], PressureField]:
        """A wrapper that makes a stateless pressure field."""
        node, weight = _gauss_hermite()
        x, y = (self.width * at.ravel()[:, None, None] for at in np.meshgrid(node, node))
        product = np.outer(weight, weight).ravel()

        def wrap(field: PressureField) -> PressureField:
            def blur(frames: Frames, poses: Array) -> Array:
                shifted = np.tile(poses, (len(x), 1, 1, 1))
                shifted[..., :3, 3] += x * poses[:, :3, 0] + y * poses[:, :3, 1]
                shifted = shifted.reshape(-1, 4, 4)
                out = np.empty((len(frames), len(poses)))
                batch = max(MAX_READINGS // max(len(shifted), 1), 1)  # frames per call
                for k in range(0, len(frames), batch):
                    rows = slice(k, k + batch)
                    read = field(frames.rows(rows), shifted).reshape(-1, len(x), len(poses))
                    out[rows] = np.einsum("mkn,k->mn", read, product)
                return out

            return blur

        return wrap


def _gauss_hermite() -> tuple[Array, Array]:
    """Nodes (NODES,) of the standard normal distribution and their weights, which sum to 1."""
    node, weight = np.polynomial.hermite_e.hermegauss(NODES)
    return node, weight / weight.sum()
