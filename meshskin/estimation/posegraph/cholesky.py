"""Cholesky factorization of sparse symmetric matrices of small blocks, for one sparsity pattern.

The symbolic factorization is made once per pattern and serves IPOPT's Hessians, the systems of the
chordal start, the matrix of the certificate, and the information matrix, of whose inverse the
diagonal blocks are the marginal covariances. The numerical part is cholesky.c, with the BLAS that
SciPy offers to compiled code (scipy.linalg.cython_blas); without a C compiler it is SuperLU.

Libraries weighed: CHOLMOD (scikit-sparse) has the fastest factors but no selected inverse, and no
wheels; QDLDL and SuperLU (scipy.sparse.linalg.splu) work entry by entry, where the blocks here are
6 x 6, and have no selected inverse either: n solves in place of two factorizations.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ...core import codegen
from ...core.arrays import Array
from .symbolic_factorization import IntArray, SymbolicFactorization, symbolic_factorization
from .symmetric_blocks import SingularMatrixError, SuperLUFactors, SymmetricBlocks

MAX_BLOCK_SIZE = 6
"""Memory is allocated for blocks up to this size, that of a pose."""
COLUMNS = 8
"""Right-hand sides that are solved together, while the factor passes through the cache once."""
BLAS = {
    "scipy.linalg.cython_lapack": ("dpotrf", "dpotri"),
    "scipy.linalg.cython_blas": ("dtrsm", "dsyrk", "dsymm", "dgemm", "dtrsv", "dgemv"),
}
"""Functions that cholesky.c calls, in the order of its `set_blas`."""
INDEX_FIELDS = (
    "order", "position", "front", "start", "rows", "parent_row", "pivots", "parent", "depth",
    "subtree", "panel",
)  # fmt: skip
"""Pointers of the struct `Symbolic` to arrays of SymbolicFactorization."""
MEMORY_FIELDS = ("panels", "even", "odd", "work")
"""Pointers of the struct `Symbolic` to memory for numbers."""
MIN_PIVOT = 1e-13
"""A pivot below this share of its diagonal entry is zero up to rounding: the error of a pivot is
about the number of updates times 1e-16 of the entry."""
PRIOR = 1e-10
"""Information of the prior added to a singular matrix, as a share of its largest diagonal entries:
far above rounding (1e-16) and far below what data determine."""
UNDETERMINED = 1e-2
"""A variance above this share of the prior's variance is that of the prior: a degree of freedom is
determined if its information is above PRIOR / UNDETERMINED = 1e-8 of the largest."""


class CSymbolic(ctypes.Structure):
    """The struct `Symbolic` of cholesky.c."""

    _fields_ = [
        *((name, ctypes.c_longlong) for name in ("nodes", "fronts")),
        *((name, ctypes.c_void_p) for name in (*INDEX_FIELDS, *MEMORY_FIELDS)),
    ]


class Cholesky:
    """Factorizations of matrices with blocks at `rows` and `columns` (k,) and on the diagonal.

    Memory is shared by all matrices: threads wait for each other. The factors of the last matrix
    are kept for further solutions.
    """

    def __init__(self, nodes: int, rows: IntArray, columns: IntArray) -> None:
        self.symbolic: SymbolicFactorization = symbolic_factorization(nodes, rows, columns)
        self.nodes = nodes
        self.lock = threading.RLock()
        self.library = library()
        self._kept: SymmetricBlocks | None = None

    @functools.cached_property
    def structure(self) -> CSymbolic:
        """The argument of the functions of cholesky.c, with the memory that they need."""
        found = CSymbolic(self.nodes, len(self.symbolic.parent))
        panel, height = self.symbolic.largest
        square = MAX_BLOCK_SIZE * MAX_BLOCK_SIZE
        work = max(square * panel, MAX_BLOCK_SIZE * (self.nodes + height) * COLUMNS)
        blocks = (int(self.symbolic.panel[-1]), *self.symbolic.stacks)
        self._memory = [*(np.empty(square * count) for count in blocks), np.empty(work)]
        for name, array in zip(MEMORY_FIELDS, self._memory, strict=True):
            setattr(found, name, array.ctypes.data)
        for name in INDEX_FIELDS:
            setattr(found, name, getattr(self.symbolic, name).ctypes.data)
        return found

    def solve(self, matrix: SymmetricBlocks, right: Array) -> Array:
        """x (nodes, size, k) with `matrix` x = `right` (nodes, size, k).

        Raises SingularMatrixError where the matrix is not positive definite.
        """
        size, count = right.shape[1:]
        with self._factorized(matrix, 0.0) as superlu:
            if superlu is not None:
                return superlu.solve(right)
            columns = np.array(np.moveaxis(right, 2, 0), order="C")
            self._call("solve", size, count, columns.ctypes.data)
            return np.moveaxis(columns, 0, 2)

    def diagonal_of_inverse(self, matrix: SymmetricBlocks, min_pivot: float) -> Array:
        """Diagonal blocks (nodes, size, size) of the inverse of `matrix`.

        Raises SingularMatrixError where a pivot is at most `min_pivot` times its diagonal entry.
        """
        size = matrix.values.shape[1]
        with self._factorized(matrix, min_pivot) as superlu:
            if superlu is not None:
                return superlu.diagonal_of_inverse()
            found = np.empty((self.nodes, size, size))
            self._kept = None  # the factors are overwritten
            self._call("diagonal_of_inverse", size, found.ctypes.data)
            return found

    def marginal_covariances(self, information: SymmetricBlocks) -> Array:
        """Covariances (nodes, size, size) of nodes with this joint `information`.

        Degrees of freedom that it does not determine have infinite variance and no covariance.
        Source: Takahashi, Fagan, Chen, "Formation of a sparse bus impedance matrix" (1973).
        """
        try:
            return self.diagonal_of_inverse(information, MIN_PIVOT)
        except SingularMatrixError:
            typical = information.diagonal(self.nodes).max(axis=0)
        prior = PRIOR * np.where(typical > 0, typical, 1.0)
        added = np.broadcast_to(np.diag(prior), (self.nodes, len(prior), len(prior)))
        blocks = self.diagonal_of_inverse(information.add_diagonal(added), MIN_PIVOT)
        variance = np.diagonal(blocks, axis1=1, axis2=2)
        undetermined = variance * prior > UNDETERMINED
        blocks[undetermined[:, :, None] | undetermined[:, None, :]] = 0.0
        node, freedom = np.nonzero(undetermined)
        blocks[node, freedom, freedom] = np.inf
        return blocks

    def log_determinant(self, matrix: SymmetricBlocks) -> float:
        """Logarithm of the determinant of `matrix`.

        Raises SingularMatrixError where the matrix is not positive definite.
        """
        return SuperLUFactors(matrix, self.symbolic.order, 0.0).log_determinant

    def is_positive_definite(self, matrix: SymmetricBlocks) -> bool:
        """Whether every pivot of `matrix` is positive."""
        try:
            with self._factorized(matrix, 0.0):
                return True
        except SingularMatrixError:
            return False

    def _call(self, name: str, *arguments: object) -> int:
        return int(getattr(self.library, name)(ctypes.byref(self.structure), *arguments) or 0)

    @contextmanager
    def _factorized(
        self, matrix: SymmetricBlocks, min_pivot: float
    ) -> Iterator[SuperLUFactors | None]:
        """Factorize; yield the factors of SuperLU, or None if they are those of cholesky.c."""
        with self.lock:
            if self.library is None:
                yield SuperLUFactors(matrix, self.symbolic.order, min_pivot)
                return
            if matrix is self._kept and not min_pivot:
                yield None
                return
            self._kept = None
            size = matrix.values.shape[1]
            rows, columns = (
                np.ascontiguousarray(a, np.int64) for a in (matrix.rows, matrix.columns)
            )
            values = np.ascontiguousarray(matrix.values)
            self._call("clear_panels", size)
            arrays = (a.ctypes.data for a in (rows, columns, values))
            self._call("add_blocks", size, len(rows), *arrays)
            fault = self._call("factorize", size, min_pivot)
            if fault:
                raise SingularMatrixError(fault - 1)
            self._kept = matrix
            yield None


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled cholesky.c and ipopt_linear_solver.c, with SciPy's BLAS.

    None without a C compiler, or where SciPy's BLAS has 64-bit integers.
    """
    functions = _blas_functions()
    if functions is None:
        return None
    declare = "#ifdef _WIN32\n#define DECLARE __declspec(dllexport)\n#else\n#define DECLARE\n#endif"
    declare += f"\n#define COLUMNS {COLUMNS}"
    names = ("cholesky.c", "ipopt_linear_solver.c")
    parts = (Path(__file__).with_name(name).read_text(encoding="utf-8") for name in names)
    found = codegen.compile_library("posegraph_cholesky", "\n".join([declare, *parts]))
    if found is not None:
        integer, pointer = ctypes.c_longlong, ctypes.c_void_p
        signatures = {
            "clear_panels": (None, integer),
            "add_blocks": (None, integer, integer, pointer, pointer, pointer),
            "factorize": (integer, integer, ctypes.c_double),
            "solve": (None, integer, integer, pointer),
            "diagonal_of_inverse": (None, integer, pointer),
            "set_context": (pointer,),
        }
        for name, (result, *arguments) in signatures.items():
            function = getattr(found, name)
            function.restype, function.argtypes = result, [pointer, *arguments]
        found.set_blas((ctypes.c_void_p * len(functions))(*functions))
    return found


def _blas_functions() -> list[int] | None:
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
