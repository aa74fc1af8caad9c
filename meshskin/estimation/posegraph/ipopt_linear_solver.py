"""IPOPT's linear solver: the multifrontal Cholesky factorization behind the interface of MA57.

Libraries weighed: MUMPS, which CasADi's wheel contains, makes its symbolic factorization anew in
every solve, entry by entry, with a BLAS for processors of 2006; it is the solver where this one
cannot be used. MA57 and the other solvers of HSL must be obtained by each user, SPRAL and Pardiso
are not in the wheel. IPOPT loads MA57 at run time from the library that its option `hsllib` names:
ipopt_linear_solver.c has the functions of that interface.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import casadi as ca
import numpy as np

from ...core import ipopt
from .cholesky import Cholesky, CSymbolic
from .symbolic_factorization import IntArray


class Context(ctypes.Structure):
    """The struct `Context` of ipopt_linear_solver.c."""

    _fields_ = [
        ("symbolic", ctypes.POINTER(CSymbolic)),
        ("poses", ctypes.c_longlong),
        ("anchored", ctypes.c_longlong),
        *((name, ctypes.c_void_p) for name in ("free", "anchors", "x", "work")),
        *(
            (name, ctypes.c_longlong)
            for name in ("similar", "factorized", "current", "factorizations", "entries")
        ),
        *((name, ctypes.c_void_p) for name in ("rows", "columns", "target", "values")),
    ]


class IpoptLinearSolver:
    """IPOPT's linear solver for problems in the poses `free`, in the order of x."""

    def __init__(self, cholesky: Cholesky, free: IntArray, anchors: IntArray) -> None:
        self._cholesky = cholesky
        self._free, self._anchors = (np.ascontiguousarray(a, np.int64) for a in (free, anchors))
        self._x = np.empty(6 * cholesky.nodes)
        self._work = np.empty(4 * 6 * cholesky.nodes)

    @property
    def options(self) -> dict[str, object]:
        """Options of IPOPT that select this solver; none where IPOPT must use MUMPS."""
        library = self._cholesky.library
        return _options(library) if library is not None and is_supported() else {}

    @contextmanager
    def activate(self, similar: bool = False) -> Iterator[Context]:
        """Make this the solver of IPOPT in this thread.

        similar: the matrices are positive semidefinite by construction and differ little, so that
        the factors of the first precondition the others.
        """
        library = self._cholesky.library
        with self._cholesky.lock:
            if library is None:
                yield Context()
                return
            context = Context(
                ctypes.pointer(self._cholesky.structure),
                len(self._free),
                len(self._anchors),
                *(a.ctypes.data for a in (self._free, self._anchors, self._x, self._work)),
                similar,
            )
            before = library.set_context(ctypes.byref(context))
            try:
                yield context
            finally:
                library.set_context(before)


def _options(library: ctypes.CDLL) -> dict[str, object]:
    return {"linear_solver": "ma57", "hsllib": library._name, "linear_system_scaling": "none"}


@functools.cache
def is_supported() -> bool:
    """Whether this IPOPT can load the solver: tried with a problem of one pose."""
    none, one = np.empty(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
    linear_solver, x = IpoptLinearSolver(Cholesky(1, none, none), one, none), ca.MX.sym("x", 6)
    library = linear_solver._cholesky.library
    if library is None:
        return False
    nlp: dict[str, Any] = {"x": x, "f": ca.sumsqr(x - 1)}
    try:
        solver = ipopt.solver("trial", nlp, _options(library))
        with linear_solver.activate() as context:
            solver(x0=np.zeros(6))
    except RuntimeError:  # an option that this IPOPT does not know
        return False
    return bool(context.factorized) and bool(solver.stats()["success"])
