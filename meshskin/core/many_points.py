"""CasADi functions, evaluated at many points at once.

A call of a CasADi function from Python converts its arguments and results entry by entry, which
takes longer than the function itself. A RowFunction reads and writes the memory of the arrays. The
generated C of a ColumnFunction is inlined into a loop over the points, which the compiler turns
into operations on vectors of them: five times as fast as calls for one point each. For that nothing
in it may branch or call a library, so `atan2` is a polynomial here.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from . import codegen
from .arrays import Array

FLAGS = (
    *codegen.FLAGS, "-fno-trapping-math", "-fvisibility=hidden", *codegen.fma_flags()
)  # fmt: skip
BATCH = 256
"""Points of a call of an interpreted function, or of a row function: they and the results stay in
the processor's cache."""
POINTS = 1024
"""Points of a call of a compiled one, from which loops are long enough."""
SOURCE = """
/* atan2(y, x) of y, x >= 0, not both 0, without branches: Cephes' atan, within 3e-16 */
static inline double quadrant(double y, double x) {
  double large = y > x ? y : x, small = y > x ? x : y;
  int steep = small > 0.41421356237309503 * large; /* tan(pi/8) */
  double u = steep ? (small - large) / (small + large) : small / large, z = u * u;
  double p = ((((-8.750608600031904122785E-1 * z - 1.615753718733365076637E1) * z
                - 7.500855792314704667340E1) * z - 1.228866684490136173410E2) * z
                - 6.485021904942025371773E1) * z;
  double q = ((((z + 2.485846490142306297962E1) * z + 1.650270098316988542046E2) * z
                + 4.328810604912902668951E2) * z + 4.853903996359136964868E2) * z
                + 1.945506571482613964425E2;
  double angle = u + u * (p / q) + (steep ? 0.78539816339744830962 : 0.0);
  return y > x ? 1.57079632679489661923 - angle : angle;
}
#define atan2 quadrant
"""
LOOP = """
EXPORT void columns(int64_t count, const double *restrict x, double *restrict y) {
  for (int64_t k = 0; k < count; k++) {
    const double *inputs[INPUTS];
    double *outputs[OUTPUTS];
    for (int i = 0; i < INPUTS; i++) inputs[i] = x + i * POINTS + k;
    for (int i = 0; i < OUTPUTS; i++) outputs[i] = y + i * POINTS + k;
    casadi_f0(inputs, outputs, 0, 0, 0);
  }
}
"""


class ColumnFunction:
    """A function of numbers x (n,) -> y (m,), at many points."""

    def __init__(self, name: str, x: ca.SX, y: ca.SX) -> None:
        """x (n,): symbols, y (m,): expressions of them. An `atan2` in y may have no argument below
        zero."""
        self.inputs, self.outputs = x.numel(), y.numel()
        function = ca.Function(name, ca.vertsplit(x), ca.vertsplit(ca.densify(y)), {"cse": True})
        sizes = {"INPUTS": self.inputs, "OUTPUTS": self.outputs, "POINTS": POINTS}
        layout = "\n".join(f"#define {key} {value}" for key, value in sizes.items())
        parts = (codegen.INLINE, SOURCE, codegen.c_source(function), layout, LOOP)
        self._run: ctypes.CDLL | ca.Function
        self._run = codegen.compile_library(name, "\n".join(parts), FLAGS) or function.map(BATCH)

    def __call__(self, count: int, *columns: ArrayLike) -> Array:
        """The values (m, count); columns: x in order, arrays (count,) or (count, .), or numbers."""
        values = [np.asarray(column) for column in columns]
        size = POINTS if isinstance(self._run, ctypes.CDLL) else BATCH
        x, y = np.ones((self.inputs, size)), np.empty((self.outputs, size))
        out = np.empty((self.outputs, count))
        for begin in range(0, count, size):
            rows = slice(begin, begin + size)
            number, first = min(size, count - begin), 0
            for value in values:
                width = value.shape[1] if value.ndim == 2 else 1
                x[first : first + width, :number] = value[rows].T if value.ndim else value
                first += width
            if isinstance(self._run, ctypes.CDLL):
                at = ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(y.ctypes.data)
                self._run.columns(ctypes.c_int64(number), *at)
            else:
                y = np.concatenate([np.asarray(row) for row in self._run.call(list(x[:, None]))])
            out[:, rows] = y[:, :number]
        return out


@dataclass(frozen=True)
class RowFunction:
    """A function of one vector (n,) with one dense output, of which rows are evaluated."""

    function: ca.Function

    @classmethod
    def compiled(cls, name: str, x: ca.SX, output: ca.SX) -> RowFunction:
        """Of an expression `output` of `x`, as machine code if there is a C compiler."""
        function = ca.Function(name, [x], [ca.densify(output)], {"cse": True})
        return cls(codegen.compile_function(function))

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
