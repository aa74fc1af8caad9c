"""What every taxel reads at every step, as a point: for control loops and speed studies.

    p_i = p_0 sqrt(1 - r_i^2 / a^2),  a^2 = delta R,  p_0 = 3 F / (2 pi a^2)     (paper, eq. 12-15)

Recordings read discs (physics.reading), frame by frame; this is dense and some hundred times
cheaper.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.se3 import Array
from .closed_loop_model import ClosedLoopModel
from .machine_code import TINY, MachineCode


class PointReadings:
    """Hertz pressures of taxels at `positions` (n, 3), body frame, m, from a step's outputs.

    With dtype float32, twice as fast, a reading is off by some 1e-6 (L / a)^2 p_0^2 / p, L the
    skin's half extent: 0.1 % of the peak near the patch's rim for a skin of 50 mm. code: of the
    loop's step; without, in NumPy, several times slower.
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
        self.origin = np.mean(positions, axis=0)
        x = np.asarray(positions, dtype=float) - self.origin
        ones = np.ones(len(x))
        self._spread = np.stack([*x.T, np.sum(x * x, axis=1), ones]).astype(dtype)  # (5, n)
        self._height = np.stack([*x.T, ones]).astype(dtype)  # (4, n)
        self._scratch = np.empty((0, len(x)), dtype)

    def __call__(self, outputs: Array, out: Any = None) -> Array:
        """Pressures (k, n), Pa, of outputs (k, m); `out`: an array to put them in."""
        if self._code is not None:
            out = (
                np.empty((len(outputs), self._taxels.shape[1]), self.dtype) if out is None else out
            )
            self._code.read(self._taxels, outputs, out)
            return np.asarray(out)
        spread, height = self._factors(outputs)
        if len(self._scratch) < len(outputs):
            self._scratch = np.empty((len(outputs), self._scratch.shape[1]), self.dtype)
        # p_0^2 ((x - c) . n)^2 / a^2 and p_0^2 (1 - |x - c|^2 / a^2), each as one matrix product
        across = np.matmul(height, self._height, out=self._scratch[: len(outputs)])
        across *= across
        # the far side of the body is no part of the patch
        peak = (outputs[:, self.rows["force"]] > 0) * self._peak(outputs) ** 2
        np.minimum(across, peak.astype(self.dtype), out=across)
        inside: Array = np.matmul(spread, self._spread, out=out)
        inside += across
        np.maximum(inside, 0.0, out=inside)
        return np.sqrt(inside, out=inside)

    def _area(self, outputs: Array) -> Array:
        rows = self.rows
        return np.maximum(outputs[:, rows["depth"]] * outputs[:, rows["radius"]], TINY)

    def _peak(self, outputs: Array) -> Array:
        """p_0 (k, 1)."""
        return np.asarray(1.5 / np.pi * outputs[:, self.rows["force"]] / self._area(outputs))

    def _factors(self, outputs: Array) -> tuple[Array, Array]:
        """Left factors (k, 5) and (k, 4) of the two products."""
        c = outputs[:, self.rows["point"]] - self.origin
        normal = outputs[:, self.rows["normal"]]
        area, peak = self._area(outputs), self._peak(outputs)
        scale = peak * peak / area
        inner = np.einsum("ij,ij->i", c, c)[:, None]
        spread = np.concatenate([2.0 * scale * c, -scale, scale * (area - inner)], axis=1)
        root = np.sqrt(scale)
        along = np.einsum("ij,ij->i", c, normal)[:, None]
        height = np.concatenate([root * normal, -root * along], axis=1)
        return spread.astype(self.dtype), height.astype(self.dtype)
