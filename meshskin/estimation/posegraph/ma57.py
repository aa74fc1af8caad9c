"""The fronts as IPOPT's linear solver.

CasADi's wheel brings MUMPS, with a BLAS built for processors of 2006, and it finds its order and
its fronts anew in every solve, scalar by scalar. IPOPT can load another solver at run time, where
the option `hsllib` names a library with the functions of HSL's MA57: ma57.c has them. An IPOPT that
does not come in through this door, as one with HSL built in, keeps its own solver.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import casadi as ca
import numpy as np

from .cholesky import Cholesky, Structure
from .ordering import Integers


class Plan(ctypes.Structure):
    """`Plan` of ma57.c."""

    _fields_ = [
        ("fronts", ctypes.POINTER(Structure)),
        ("poses", ctypes.c_longlong),
        ("held", ctypes.c_longlong),
        ("free", ctypes.c_void_p),
        ("anchors", ctypes.c_void_p),
        ("x", ctypes.c_void_p),
        ("work", ctypes.c_void_p),
        *((name, ctypes.c_longlong) for name in ("alike", "factorised", "own", "eliminations")),
        ("entries", ctypes.c_longlong),
        *((name, ctypes.c_void_p) for name in ("rows", "columns", "goal", "values")),
    ]


class IpoptLinearSolver:
    """Lets IPOPT in: poses `free` in the order of its x, `anchors` held."""

    def __init__(self, cholesky: Cholesky, free: Integers, anchors: Integers) -> None:
        self._cholesky = cholesky
        self._free, self._anchors = (np.ascontiguousarray(a, np.int64) for a in (free, anchors))
        self._x = np.empty(6 * cholesky.nodes)
        self._work = np.empty(4 * 6 * cholesky.nodes)

    @property
    def options(self) -> dict[str, object]:
        """For IPOPT; none where its own MUMPS has to do."""
        library = self._cholesky.built
        return _named(library) if library is not None and is_supported() else {}

    @contextmanager
    def open(self, alike: bool = False) -> Iterator[Plan]:
        """While in here, the solver of this thread has these fronts.

        alike: its matrices are positive semidefinite by their form, and little different from the
        first, whose factors serve the others.
        """
        library = self._cholesky.built
        with self._cholesky.lock:
            if library is None:
                yield Plan()
                return
            plan = Plan(
                ctypes.pointer(self._cholesky.structure),
                len(self._free),
                len(self._anchors),
                *(a.ctypes.data for a in (self._free, self._anchors, self._x, self._work)),
                alike,
            )
            before = library.hand_to_ipopt(ctypes.byref(plan))
            try:
                yield plan
            finally:
                library.hand_to_ipopt(before)


def _named(library: ctypes.CDLL) -> dict[str, object]:
    return {
        "linear_solver": "ma57",
        "hsllib": library._name,
        "linear_system_scaling": "none",
    }


@functools.cache
def is_supported() -> bool:
    """Whether this IPOPT uses the library: tried with a problem of one pose."""
    none, one = np.empty(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
    door, x = IpoptLinearSolver(Cholesky(1, none, none), one, none), ca.MX.sym("x", 6)
    library = door._cholesky.built
    if library is None:
        return False
    nlp: dict[str, Any] = {"x": x, "f": ca.sumsqr(x - 1)}
    quiet = {"print_level": 0, "sb": "yes"}
    options: dict[str, Any] = {"print_time": False, "ipopt": {**_named(library), **quiet}}
    try:
        solver = ca.nlpsol("door", "ipopt", nlp, options)
        with door.open() as plan:
            solver(x0=np.zeros(6))
    except RuntimeError:  # an option that this IPOPT does not know
        return False
    return bool(plan.factorised) and bool(solver.stats()["success"])
