"""Sums over the readings of taxels and contacts: blocks of normal equations and their products.

The loops are C (reading_sums.c); without a compiler they are sums by sparse matrices.
"""

from __future__ import annotations

import ctypes
import functools
import math
from pathlib import Path

import numpy as np
from scipy import sparse

from ...core import codegen
from ...core.arrays import Array, ranges

CONTACT_SIZE = 3
"""Errors of a contact: its displacement along two tangents, m, and the error of ln F."""
MAX_SIZE = 6
"""Largest number of unknowns of a taxel."""

Parts = tuple[Array, Array, Array]
"""Values of the taxels (n, D, c), the contacts (m, 3, c) and the global parameters (ks, c)."""


class ReadingSums:
    """Sums over k readings, each of the taxel and the contact that it belongs to."""

    def __init__(self, taxel: np.ndarray, contact: np.ndarray, taxels: int, contacts: int) -> None:
        """taxel, contact: rows (k,); taxels, contacts: their numbers."""
        self.taxel, self.contact = (np.ascontiguousarray(x, np.int64) for x in (taxel, contact))
        self.taxels, self.contacts = taxels, contacts
        self.each = np.arange(len(taxel))
        self.order = np.argsort(self.contact, kind="stable")
        self.starts = np.searchsorted(self.contact[self.order], np.arange(contacts + 1))
        first, second = pairs_of_contacts(self.contact)
        pair = self.taxel[second] * taxels + self.taxel[first]
        unique, self.block = np.unique(pair, return_inverse=True)
        self.rows, self.columns = np.divmod(unique, max(taxels, 1))
        """Taxels of the blocks (b,) of pairs of taxels that read in one contact."""
        self.library = library()

    def normal_equations(
        self, jacobian: Array, rate: Array, curvature: Array, size: int
    ) -> tuple[Array, ...]:
        """Blocks of the normal equations: taxels (n, D, D), contacts (m, 3, 3), global parameters
        (ks, ks), taxel and contact of each reading (k, D, 3), taxels (n, D, ks) and contacts
        (m, 3, ks) with global parameters; and the gradient, (n, D), (m, 3), (ks,).

        jacobian (k, D + ks + 3): of taxel, global parameters and contact, D = `size`; rate and
        curvature (k,): first and second derivative of the cost of each reading.
        """
        n, m, (k, width) = self.taxels, self.contacts, jacobian.shape
        ks = width - size - CONTACT_SIZE
        shapes = (n, size, size), (m, 3, 3), (ks, ks), (k, size, 3), (n, size, ks), (m, 3, ks)
        found = tuple(np.zeros(shape) for shape in (*shapes, (n, size), (m, 3), (ks,)))
        if self.library is not None:
            values = tuple(map(np.ascontiguousarray, (jacobian, rate, curvature)))
            inputs = (self.taxel, self.contact, *values)
            self.library.normal_equations(k, size, ks, *_addresses(*inputs, *found))
            return found
        own, shared, at = np.split(jacobian, [size, width - CONTACT_SIZE], axis=1)
        w_own, w_at = curvature[:, None] * own, curvature[:, None] * at

        def by(owner: np.ndarray, count: int, a: Array, b: Array) -> Array:
            return _sums(owner, count, a[:, :, None] * b[:, None, :])

        return (
            by(self.taxel, n, w_own, own),
            by(self.contact, m, w_at, at),
            (curvature[:, None] * shared).T @ shared,
            w_own[:, :, None] * at[:, None, :],
            by(self.taxel, n, w_own, shared),
            by(self.contact, m, w_at, shared),
            _sums(self.taxel, n, rate[:, None] * own),
            _sums(self.contact, m, rate[:, None] * at),
            shared.T @ rate,
        )

    def eliminated(self, coupling: Array, inverse: Array) -> tuple[Array, Array]:
        """-B C^-1 B^T: its diagonal blocks (n, D, D), and those of pairs (b, D, D); coupling B
        (k, D, 3): of each reading's taxel and contact, inverse C^-1 (m, 3, 3)."""
        size = coupling.shape[1]
        if self.library is not None:
            own = np.zeros((self.taxels, size, size))
            off = np.zeros((len(self.rows), size, size))
            values = tuple(map(np.ascontiguousarray, (coupling, inverse)))
            inputs = (self.starts, self.order, self.block, self.taxel, *values)
            self.library.eliminate_contacts(self.contacts, size, *_addresses(*inputs, own, off))
            return own, off
        weighted, transposed = coupling @ inverse[self.contact], np.swapaxes(coupling, 1, 2)
        first, second = pairs_of_contacts(self.contact)
        pairs = weighted[second] @ transposed[first]
        own = -_sums(self.taxel, self.taxels, weighted @ transposed)
        return own, -_sums(self.block, len(self.rows), pairs)

    def to_taxels(self, coupling: Array, values: Array) -> Array:
        """B v (n, D, c) of values v (m, 3, c) of the contacts."""
        return self._products(coupling, values, self.taxel, self.contact, self.taxels)

    def to_contacts(self, coupling: Array, values: Array) -> Array:
        """B^T v (m, 3, c) of values v (n, D, c) of the taxels."""
        transposed = np.swapaxes(coupling, 1, 2)
        return self._products(transposed, values, self.contact, self.taxel, self.contacts)

    def transposed(self, jacobian: Array, values: Array, size: int) -> Parts:
        """J^T v in parts, of values v (k, c) of the readings; jacobian as `normal_equations`."""
        own, at = jacobian[:, :size, None], jacobian[:, -CONTACT_SIZE:, None]
        v = np.ascontiguousarray(values)[:, None]
        return (
            self._products(own, v, self.taxel, self.each, self.taxels),
            self._products(at, v, self.contact, self.each, self.contacts),
            jacobian[:, size:-CONTACT_SIZE].T @ values,
        )

    def forward(self, jacobian: Array, x: Parts, size: int) -> Array:
        """J x (k, c) of unknowns x in parts; jacobian as `normal_equations`."""
        own, at = jacobian[:, None, :size], jacobian[:, None, -CONTACT_SIZE:]
        found = self._products(own, x[0], self.each, self.taxel, len(self.each))
        found += self._products(at, x[1], self.each, self.contact, len(self.each))
        return found[:, 0] + jacobian[:, size:-CONTACT_SIZE] @ x[2]

    def _products(
        self, a: Array, values: Array, owner: np.ndarray, source: np.ndarray, count: int
    ) -> Array:
        """Sums (count, p, c) over the readings of one owner (k,) of a (k, p, q) times the values
        (., q, c) of its source (k,)."""
        if self.library is None:
            return _sums(owner, count, a @ values[source])
        k, rows, inner = a.shape
        values, columns = np.ascontiguousarray(values), values.shape[2]
        out = np.zeros((count, rows, columns))
        strides = (step // a.itemsize for step in a.strides)
        self.library.products(
            k, rows, inner, columns, *_addresses(a), *strides,
            *_addresses(owner, source, values, out),
        )  # fmt: skip
        return out


def pairs_of_contacts(contact: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of readings of one contact, contact by contact: rows of each one's first and second
    reading; contact (k,): of each reading."""
    order, each = np.argsort(contact, kind="stable"), np.arange(len(contact))
    ends = np.searchsorted(contact[order], contact[order], side="right")
    partners = ends - each - 1
    return np.repeat(order, partners), order[ranges(each + 1, partners)]


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled reading_sums.c; None without a C compiler."""
    declare = "#ifdef _WIN32\n#define DECLARE __declspec(dllexport)\n#else\n#define DECLARE\n#endif"
    text = Path(__file__).with_name("reading_sums.c").read_text(encoding="utf-8")
    source = "\n".join([declare, f"#define MAX_SIZE {MAX_SIZE}", text])
    flags = (*codegen.FLAGS, *codegen.fma_flags())
    found = codegen.compile_library("reading_sums", source, flags)
    if found is not None:
        integer, pointer = ctypes.c_longlong, ctypes.c_void_p
        signatures = {
            "normal_equations": [integer] * 3 + [pointer] * 14,
            "eliminate_contacts": [integer] * 2 + [pointer] * 8,
            "products": [integer] * 4 + [pointer] + [integer] * 3 + [pointer] * 4,
        }
        for name, arguments in signatures.items():
            function = getattr(found, name)
            function.restype, function.argtypes = None, arguments
    return found


def _addresses(*arrays: np.ndarray) -> list[int]:
    return [array.ctypes.data for array in arrays]


def _sums(owner: np.ndarray, count: int, values: Array) -> Array:
    """Sums (count, ...) of values (k, ...) by owner (k,)."""
    k, rest = len(owner), values.shape[1:]
    summation = sparse.csr_array((np.ones(k), (owner, np.arange(k))), shape=(count, k))
    flat = summation @ values.reshape(k, math.prod(rest))
    return np.asarray(flat).reshape(count, *rest)
