"""Pressures at all taxels, taken as points, at every step of the closed loop.

    p_i = p_0 sqrt(1 - r_i^2 / a^2),  a^2 = delta R,  p_0 = 3 F / (2 pi a^2)     (paper, eq. 12-15)

Recordings average over discs (contact/reading.py), frame by frame; this is dense and some hundred
times cheaper.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np

from meshskin.core import codegen
from meshskin.core.arrays import Array
from meshskin.simulation.closed_loop_model import ClosedLoopModel
from meshskin.simulation.machine_code import FLAGS

MIN_AREA = 1e-24
"""Squared contact radius, m^2, that is used without contact, where it would be 0: (1 pm)^2."""
_INT, _POINTER = ctypes.c_int64, ctypes.c_void_p


class PointReadings:
    """Hertz pressures of taxels at `positions` (n, 3), body frame, m, from a step's outputs.

    dtype float32 is twice as fast; its error is about 1e-6 (L / a)^2 p_0^2 / p, L the skin's half
    extent: 0.1 % of the peak near the patch's rim for a skin of 50 mm. compiled: by machine code,
    if there is a C compiler; with NumPy it is several times slower.
    """

    def __init__(
        self,
        loop: ClosedLoopModel,
        positions: Array,
        dtype: Any = np.float64,
        compiled: bool = False,
    ) -> None:
        self.rows, self.dtype = loop.outputs, dtype
        self._library = _compiled(loop) if compiled else None
        self._taxels = np.ascontiguousarray(np.transpose(positions), dtype=dtype)
        self.origin = np.mean(positions, axis=0)
        x = np.asarray(positions, dtype=float) - self.origin
        ones = np.ones(len(x))
        self._spread = np.stack([*x.T, np.sum(x * x, axis=1), ones]).astype(dtype)  # (5, n)
        self._height = np.stack([*x.T, ones]).astype(dtype)  # (4, n)
        self._scratch = np.empty((0, len(x)), dtype)

    def __call__(self, outputs: Array, out: Any = None) -> Array:
        """Pressures (k, n), Pa, of outputs (k, m); `out`: an array for the result."""
        if self._library is not None:
            return self._read(self._library, outputs, out)
        rows = self.rows
        c, normal = outputs[:, rows["point"]] - self.origin, outputs[:, rows["normal"]]
        force = outputs[:, rows["force"]]
        area = np.maximum(outputs[:, rows["depth"]] * outputs[:, rows["radius"]], MIN_AREA)  # a^2
        peak = 1.5 / np.pi * force / area
        scale = peak * peak / area
        inner = np.einsum("ij,ij->i", c, c)[:, None]
        spread = np.concatenate([2.0 * scale * c, -scale, scale * (area - inner)], axis=1)
        root, along = np.sqrt(scale), np.einsum("ij,ij->i", c, normal)[:, None]
        height = np.concatenate([root * normal, -root * along], axis=1)
        if len(self._scratch) < len(outputs):
            self._scratch = np.empty((len(outputs), self._scratch.shape[1]), self.dtype)
        # p_0^2 ((x - c) . n)^2 / a^2 and p_0^2 (1 - |x - c|^2 / a^2), each as one matrix product
        across = self._scratch[: len(outputs)]
        np.matmul(height.astype(self.dtype), self._height, out=across)
        across *= across
        # taxels further than a from the tangent plane, as on the far side, read nothing
        np.minimum(across, ((force > 0) * peak**2).astype(self.dtype), out=across)
        inside: Array = np.matmul(spread.astype(self.dtype), self._spread, out=out)
        inside += across
        np.maximum(inside, 0.0, out=inside)
        return np.sqrt(inside, out=inside)

    def _read(self, library: ctypes.CDLL, outputs: Array, out: Any) -> Array:
        """The pressures by machine code."""
        if out is None:
            out = np.empty((len(outputs), self._taxels.shape[1]), self.dtype)
        assert all(a.flags.c_contiguous for a in (self._taxels, outputs, out))
        read = library.read_double if out.dtype == np.float64 else library.read_float
        addresses = (_POINTER(a.ctypes.data) for a in (self._taxels, outputs, out))
        read(_INT(len(outputs)), _INT(self._taxels.shape[1]), *addresses)
        return np.asarray(out)


def _compiled(loop: ClosedLoopModel) -> ctypes.CDLL | None:
    """readings.c for the layout of a loop's outputs; None without a C compiler."""
    layout: dict[str, float] = {name.upper(): s.start for name, s in loop.outputs.items()}
    layout |= {"OUTPUT": max(s.stop for s in loop.outputs.values()), "MIN_AREA": MIN_AREA}
    lines = [f"#define {name} {value}" for name, value in layout.items()]
    text = Path(__file__).with_name("readings.c").read_text(encoding="utf-8")
    return codegen.compile_library("readings", "\n".join([codegen.INLINE, *lines, text]), FLAGS)
