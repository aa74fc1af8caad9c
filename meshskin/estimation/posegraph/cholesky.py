"""Cholesky factorisation of sparse symmetric matrices of small blocks, for one pattern.

The fronts are found once a pattern; whatever has that pattern is then eliminated by BLAS, in memory
that is kept: IPOPT's Hessians, the systems of the chordal start, the certificate's matrix, the
information whose inverse gives the covariances. Compiled where there is a C compiler, with the BLAS
that SciPy offers to compiled code (scipy.linalg.cython_blas); else in NumPy.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from ...core import codegen
from ...core.se3 import Array
from . import cholesky_numpy
from .ordering import Integers
from .symbolic_factorization import SymbolicFactorization, symbolic_factorization

LARGEST = 6
"""Blocks up to this size have room."""
BLAS = {
    "scipy.linalg.cython_lapack": ("dpotrf", "dpotri"),
    "scipy.linalg.cython_blas": ("dtrsm", "dsyrk", "dsymm", "dgemm", "dtrsv", "dgemv"),
}
"""What fronts.c calls, in its order."""


class SingularError(ArithmeticError):
    """The matrix is not positive definite, up to rounding; `node` is where it was noticed."""

    def __init__(self, node: int) -> None:
        super().__init__(f"not positive definite at node {node}")
        self.node = node


@dataclass(frozen=True)
class Blocks:
    """A symmetric matrix; each block between two nodes is given once, either way round."""

    rows: Integers
    """(k,) nodes; repeats add up."""
    columns: Integers
    """(k,)"""
    values: Array
    """(k, size, size); of blocks on the diagonal a factorisation reads the lower triangle."""

    def and_diagonal(self, values: Array) -> Blocks:
        """With `values` (nodes, size, size) added to the diagonal."""
        nodes = np.arange(len(values))
        return Blocks(
            np.concatenate([self.rows, nodes]),
            np.concatenate([self.columns, nodes]),
            np.concatenate([self.values, values]),
        )

    def diagonal(self, nodes: int) -> Array:
        """(nodes, size) entries on the diagonal."""
        own = self.rows == self.columns
        entries = np.diagonal(self.values[own], axis1=1, axis2=2)
        return summed(entries, self.rows[own], nodes)

    def __matmul__(self, x: Array) -> Array:
        """Times x (nodes, size, k); diagonal blocks are whole."""
        off = self.rows != self.columns
        turned = np.swapaxes(self.values[off], 1, 2)
        products = np.concatenate([self.values @ x[self.columns], turned @ x[self.rows[off]]])
        return summed(products, np.concatenate([self.rows, self.columns[off]]), len(x))


POINTERS = (
    "order", "place", "front", "start", "rows", "up", "pivots", "parent", "depth", "span", "panel",
)  # fmt: skip
ROOM = ("panels", "even", "odd", "work")


class Structure(ctypes.Structure):
    """`SymbolicFactorization` of fronts.c."""

    _fields_ = [
        *((name, ctypes.c_longlong) for name in ("nodes", "fronts")),
        *((name, ctypes.c_void_p) for name in (*POINTERS, *ROOM)),
    ]


class Cholesky:
    """Systems with blocks at `rows` and `columns` (k,), whatever is on the diagonal.

    One matrix at a time: threads wait for each other.
    """

    def __init__(self, nodes: int, rows: Integers, columns: Integers) -> None:
        self.fronts: SymbolicFactorization = symbolic_factorization(nodes, rows, columns)
        self.nodes = nodes
        self.lock = threading.RLock()
        self.built = library()

    @functools.cached_property
    def structure(self) -> Structure:
        """For fronts.c, with all memory that it needs."""
        found = Structure(self.nodes, len(self.fronts.parent))
        widest, highest = self.fronts.work
        square = LARGEST * LARGEST
        rows = LARGEST * (self.nodes + highest)
        self._work = np.empty(max(square * widest, rows))
        self._stacks = [np.empty(square * count) for count in self.fronts.stacks]
        arrays = (self._panels, *self._stacks, self._work)
        for name, array in zip(ROOM, arrays, strict=True):
            setattr(found, name, array.ctypes.data)
        for name in POINTERS:
            setattr(found, name, getattr(self.fronts, name).ctypes.data)
        return found

    @functools.cached_property
    def _panels(self) -> Array:
        return np.empty(LARGEST * LARGEST * int(self.fronts.panel[-1]))

    def solve(self, matrix: Blocks, right: Array) -> Array:
        """x (nodes, size, k) with `matrix` x = `right` (nodes, size, k).

        Raises SingularError where the matrix is not positive definite.
        """
        size, count = right.shape[1:]
        with self._factorised(matrix, 0.0):
            if self.built is None:
                return cholesky_numpy.solve(self.fronts, size, right, self._panels)
            columns = np.array(np.moveaxis(right, 2, 0), order="C")
            self.built.solve(self._pointer(), size, count, columns.ctypes.data)
            return np.moveaxis(columns, 0, 2)

    def diagonal_of_inverse(self, matrix: Blocks, least: float) -> Array:
        """Diagonal blocks (nodes, size, size) of the inverse of `matrix`.

        Raises SingularError where a pivot is not above `least` as a share of its diagonal entry.
        """
        size = matrix.values.shape[1]
        found = np.empty((self.nodes, size, size))
        with self._factorised(matrix, least):
            if self.built is None:
                cholesky_numpy.invert(self.fronts, size, found, self._panels)
            else:
                self.built.invert(self._pointer(), size, found.ctypes.data)
        return found

    def is_positive(self, matrix: Blocks) -> bool:
        """Whether every pivot of `matrix` is positive."""
        try:
            with self._factorised(matrix, 0.0):
                return True
        except SingularError:
            return False

    def _pointer(self) -> Any:
        return ctypes.byref(self.structure)

    @contextmanager
    def _factorised(self, matrix: Blocks, least: float) -> Iterator[None]:
        size = matrix.values.shape[1]
        rows, columns = (np.ascontiguousarray(a, np.int64) for a in (matrix.rows, matrix.columns))
        values = np.ascontiguousarray(matrix.values)
        with self.lock:
            if self.built is None:
                self._panels[: size * size * int(self.fronts.panel[-1])] = 0.0
                cholesky_numpy.add(self.fronts, size, rows, columns, values, self._panels)
                fault = cholesky_numpy.eliminate(self.fronts, size, least, self._panels)
            else:
                self.built.clear(self._pointer(), size)
                arrays = (a.ctypes.data for a in (rows, columns, values))
                self.built.add(self._pointer(), size, len(rows), *arrays)
                fault = self.built.eliminate(self._pointer(), size, least)
            if fault:
                raise SingularError(fault - 1)
            yield


def summed(values: Array, places: Integers, count: int) -> Array:
    """(count, ...) sums of `values` (k, ...) by their `places` (k,)."""
    each = np.arange(len(places))
    gather = sparse.csr_array((np.ones(len(places)), (places, each)), shape=(count, len(places)))
    rest = values.shape[1:]
    return np.asarray(gather @ values.reshape(len(values), math.prod(rest))).reshape(count, *rest)


@functools.cache
def library() -> ctypes.CDLL | None:
    """fronts.c and ma57.c, with SciPy's BLAS; None without a compiler, or another kind of BLAS."""
    functions = _functions()
    if functions is None:
        return None
    here = Path(__file__)
    declare = "#ifdef _WIN32\n#define DECLARE __declspec(dllexport)\n#else\n#define DECLARE\n#endif"
    parts = (here.with_name(name).read_text(encoding="utf-8") for name in ("fronts.c", "ma57.c"))
    found = codegen.compile_library("posegraph_fronts", "\n".join([declare, *parts]))
    if found is not None:
        integer, pointer = ctypes.c_longlong, ctypes.c_void_p
        found.clear.argtypes = [pointer, integer]
        found.add.argtypes = [pointer, integer, integer, pointer, pointer, pointer]
        found.eliminate.argtypes, found.eliminate.restype = (
            [pointer, integer, ctypes.c_double],
            integer,
        )
        found.solve.argtypes = [pointer, integer, integer, pointer]
        found.invert.argtypes = [pointer, integer, pointer]
        found.hand_to_ipopt.argtypes, found.hand_to_ipopt.restype = [pointer], pointer
        found.use((ctypes.c_void_p * len(functions))(*functions))
    return found


def _functions() -> list[int] | None:
    """Addresses of SciPy's functions; None where their integers are not C's int."""
    pointer, name = ctypes.pythonapi.PyCapsule_GetPointer, ctypes.pythonapi.PyCapsule_GetName
    pointer.restype, pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
    name.restype, name.argtypes = ctypes.c_char_p, (ctypes.py_object,)
    found = []
    for module, names in BLAS.items():
        offered = importlib.import_module(module).__pyx_capi__
        for key in names:
            signature = name(offered[key])
            if b"int *" not in signature:
                return None
            found.append(pointer(offered[key], signature))
    return found
