"""CasADi functions of one vector, evaluated at many rows of an array.

A call of a CasADi function from Python converts its arguments and results entry by entry, which
takes longer than the function itself. Here it reads and writes the memory of the arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from .arrays import Array
from .codegen import compile_function

BATCH = 256
"""Rows evaluated in one call: they and the results stay in the processor's cache."""


@dataclass(frozen=True)
class RowFunction:
    """A function of one vector (n,) with one dense output, of which rows are evaluated."""

    function: ca.Function

    @classmethod
    def compiled(cls, name: str, x: ca.SX, output: ca.SX) -> RowFunction:
        """Of an expression `output` of `x`, as machine code if there is a C compiler."""
        function = ca.Function(name, [x], [ca.densify(output)], {"cse": True})
        return cls(compile_function(function))

    @cached_property
    def _mapped(self) -> ca.Function:
        return self.function.map(BATCH)

    def __call__(self, rows: Array) -> Array:
        """The outputs (k, m), each column by column, at rows (k, n)."""
        x = np.ascontiguousarray(rows, dtype=float)
        out = np.empty((len(x), self.function.numel_out(0)))
        whole = len(x) - len(x) % BATCH
        for function, first, end, step in (
            (self._mapped if whole else None, 0, whole, BATCH),
            (self.function, whole, len(x), 1),
        ):
            if function is None:
                continue
            made: Any = function.buffer()  # CasADi's type stub asks for sizes that it does not take
            buffer, call = made
            for begin in range(first, end, step):
                buffer.set_arg(0, x[begin : begin + step].data)
                buffer.set_res(0, out[begin : begin + step].data)
                call()
        return out
