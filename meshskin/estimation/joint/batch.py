"""Compiled kernels evaluated in batches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.se3 import Array

if TYPE_CHECKING:
    import casadi as ca

BATCH = 256
"""Columns evaluated in one call of a compiled kernel."""


def evaluate(kernel: ca.Function, count: int, *columns: ArrayLike) -> Array:
    """The outputs (count, .) of `kernel`, a function mapped over `BATCH` columns.

    `columns`, one after the other the inputs of each: arrays (count,) or (count, .), or numbers.
    """
    rows = -(-count // BATCH) * BATCH
    x = np.ones((rows, kernel.size1_in(0)))
    first = 0
    for values in columns:
        value = np.asarray(values)
        width = value.shape[1] if value.ndim == 2 else 1
        x[:count, first : first + width] = value if value.ndim != 1 else value[:, None]
        first += width
    out = np.empty((rows, kernel.size1_out(0)))
    buffer: Any
    buffer, call = kernel.buffer()
    for begin in range(0, rows, BATCH):
        buffer.set_arg(0, x[begin : begin + BATCH].data)
        buffer.set_res(0, out[begin : begin + BATCH].data)
        call()
    return out[:count]
