"""Pressures at all taxels, taken as points, at every step: for control loops and speed studies.

    p_i = p_0 sqrt(1 - r_i^2 / a^2),  a^2 = delta R,  p_0 = 3 F / (2 pi a^2)     (paper, eq. 12-15)

Recordings average over discs (contact/reading.py), frame by frame; this is dense and some hundred
times cheaper.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.se3 import Array
from .closed_loop_model import ClosedLoopModel
from .machine_code import MIN_AREA, MachineCode


class PointReadings:
    """Hertz pressures of taxels at `positions` (n, 3), body frame, m, from a step's outputs.

    dtype float32 is twice as fast; its error is about 1e-6 (L / a)^2 p_0^2 / p, L the skin's half
    extent: 0.1 % of the peak near the patch's rim for a skin of 50 mm. code: machine code of the
    loop's step; without it NumPy is used, several times slower.
    """

    def __init__(
        self,
        loop: ClosedLoopModel,
        positions: Array,
        dtype: Any = np.float64,
        code: MachineCode | None = None,
    ) -> None:
        self.rows, self.dtype, self._code = loop.outputs, dtype, code
        self._taxels = np.ascontiguousarray(np.transpose(positions), dtype=dtype)
        self._origin = np.mean(positions, axis=0)  # near the taxels, against cancellation
        self._offsets = np.transpose(positions - self._origin)
        self._squares = np.sum(self._offsets**2, axis=0).astype(dtype)
        self._offsets = self._offsets.astype(dtype)

    def __call__(self, outputs: Array, out: Any = None) -> Array:
        """Pressures (k, n), Pa, of outputs (k, m); `out`: an array for the result."""
        if self._code is not None:
            if out is None:
                out = np.empty((len(outputs), self._taxels.shape[1]), self.dtype)
            self._code.read(self._taxels, outputs, out)
            return np.asarray(out)
        rows, dtype = self.rows, self.dtype
        c, normal = outputs[:, rows["point"]] - self._origin, outputs[:, rows["normal"]]
        area = np.maximum(outputs[:, rows["depth"]] * outputs[:, rows["radius"]], MIN_AREA)
        force = outputs[:, rows["force"]]
        # p^2 = p_0^2 max(0, 1 - (|x - c|^2 - h^2) / a^2), h^2 at most a^2: taxels further than a
        # from the tangent plane, as on the far side of the body, read nothing
        scale = (force > 0) * (1.5 / np.pi * force / area) ** 2 / area
        height = (np.sqrt(scale) * normal).astype(dtype) @ self._offsets
        height -= np.sqrt(scale) * np.sum(c * normal, axis=1, keepdims=True).astype(dtype)
        height *= height
        np.minimum(height, (scale * area).astype(dtype), out=height)
        inside = np.matmul((2.0 * scale * c).astype(dtype), self._offsets, out=out)
        inside -= scale.astype(dtype) * self._squares
        inside += (scale * (area - np.sum(c * c, axis=1, keepdims=True))).astype(dtype)
        inside += height
        np.maximum(inside, 0.0, out=inside)
        return np.asarray(np.sqrt(inside, out=inside))
