"""What every taxel reads at every step, as a point: for control loops and speed studies.

    p_i = p_0 sqrt(1 - r_i^2 / a^2),  a^2 = delta R,  p_0 = 3 F / (2 pi a^2)     (paper, eq. 12-15)

Recordings read discs (physics.reading), frame by frame; this is dense and some hundred times
cheaper.
"""

from __future__ import annotations

import numpy as np

from ..se3 import Array
from .loop import Loop

TINY = 1e-24
"""m^2, in place of a patch's squared radius where there is no contact."""


class PointReadings:
    """Hertz pressures of taxels at `positions` (n, 3), body frame, m, from a step's outputs."""

    def __init__(self, loop: Loop, positions: Array) -> None:
        x = np.asarray(positions, dtype=float)
        self.rows = loop.outputs
        ones = np.ones(len(x))
        self._spread = np.stack([*x.T, np.sum(x * x, axis=1), ones])  # (5, n)
        self._height = np.stack([*x.T, ones])  # (4, n)

    def __call__(self, outputs: Array) -> Array:
        """Pressures (k, n), Pa, of outputs (k, m)."""
        rows = self.rows
        c, normal = outputs[:, rows["point"]], outputs[:, rows["normal"]]
        depth, radius = outputs[:, rows["depth"].start], outputs[:, rows["radius"].start]
        area = np.maximum(depth * radius, TINY)  # a^2
        peak = 1.5 / np.pi * outputs[:, rows["force"].start] / area
        root = np.sqrt(area)[:, None]
        # 1 - |x - c|^2 / a^2 and (x - c) . n / a, each as one matrix product
        left = np.concatenate(
            [2.0 * c, -np.ones((len(c), 1)), (area - np.einsum("ij,ij->i", c, c))[:, None]], axis=1
        )
        inside = (left / area[:, None]) @ self._spread
        along = np.einsum("ij,ij->i", c, normal)[:, None]
        height = (np.concatenate([normal, -along], axis=1) / root) @ self._height
        height *= height
        np.minimum(height, 1.0, out=height)  # the far side of the body does not read
        inside += height
        np.maximum(inside, 0.0, out=inside)
        np.sqrt(inside, out=inside)
        inside *= peak[:, None]
        return np.asarray(inside)
