"""The normal equations of taxels, contacts and global parameters together.

Where contact points and forces are measurements with errors of their own, each reading couples its
taxel with its contact. The contacts, three unknowns each, are eliminated first; what remains is a
sparse matrix with a block for every pair of taxels that read in the same contact, factorized by
posegraph/cholesky.py, and the global parameters are eliminated last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ...core.arrays import Array, ranges
from ..posegraph.cholesky import Cholesky
from ..posegraph.symmetric_blocks import SymmetricBlocks
from .likelihood import Readings

CONTACT_SIZE = 3
"""Errors of a contact: its displacement along two tangents, m, and the error of ln F."""


class CouplingPattern:
    """Which taxels read in the same contacts; made once for a selection of readings."""

    def __init__(self, readings: Readings, contacts: int) -> None:
        """contacts: their number m."""
        self.readings, self.contacts = readings, contacts
        self.taxels = len(readings.starts) - 1
        by_contact = np.argsort(readings.contact, kind="stable")
        count = np.bincount(readings.contact, minlength=contacts)
        end = np.cumsum(count)[readings.contact[by_contact]]
        here = np.arange(len(by_contact))
        partners = end - here - 1
        self.first = by_contact[np.repeat(here, partners)]
        self.second = by_contact[ranges(here + 1, partners)]
        pair = readings.taxel[self.second] * self.taxels + readings.taxel[self.first]
        unique, self.block = np.unique(pair, return_inverse=True)
        self.rows, self.columns = np.divmod(unique, max(self.taxels, 1))
        self.by_taxel = _summation(readings.taxel, self.taxels)
        self.by_contact = _summation(readings.contact, contacts)
        self.by_block = _summation(self.block, len(unique))

    @cached_property
    def cholesky(self) -> Cholesky:
        """The factorization of the taxels' matrix."""
        return Cholesky(self.taxels, self.rows, self.columns)


@dataclass(frozen=True)
class CoupledSystem:
    """H and g of a quadratic cost in n taxels (D), m contacts (3) and global parameters (ks)."""

    pattern: CouplingPattern
    taxels: Array
    """(n, D, D)."""
    contacts: Array
    """(m, 3, 3)."""
    shared: Array
    """(ks, ks)."""
    taxel_contact: Array
    """(k, D, 3), of each reading."""
    taxel_shared: Array
    """(n, D, ks)."""
    contact_shared: Array
    """(m, 3, ks)."""
    gradient: tuple[Array, Array, Array]
    """(n, D), (m, 3), (ks,)."""

    @classmethod
    def from_readings(
        cls, pattern: CouplingPattern, jacobian: Array, rate: Array, curvature: Array, size: int
    ) -> CoupledSystem:
        """Of k readings with derivatives (D + ks + 3, k) in taxel, global parameters and contact,
        and first and second derivative (k,) of their cost; D = `size`. Without priors."""
        m = pattern.contacts
        own, at = jacobian[:size], jacobian[-CONTACT_SIZE:]
        shared = jacobian[size:-CONTACT_SIZE]
        n, ks = pattern.taxels, len(shared)

        def by_taxel(a: Array, b: Array) -> Array:
            return _outer_sums(pattern.by_taxel, a * curvature, b)

        def by_contact(a: Array, b: Array) -> Array:
            return _outer_sums(pattern.by_contact, a * curvature, b)

        return cls(
            pattern=pattern,
            taxels=by_taxel(own, own),
            contacts=by_contact(at, at),
            shared=(shared * curvature) @ shared.T,
            taxel_contact=np.einsum("ak,bk->kab", own * curvature, at),
            taxel_shared=by_taxel(own, shared) if ks else np.zeros((n, size, 0)),
            contact_shared=by_contact(at, shared) if ks else np.zeros((m, CONTACT_SIZE, 0)),
            gradient=(
                sums(pattern.by_taxel, (own * rate).T),
                sums(pattern.by_contact, (at * rate).T),
                shared @ rate,
            ),
        )

    @cached_property
    def _inverse_contacts(self) -> Array:
        return np.asarray(np.linalg.inv(self.contacts))

    @cached_property
    def _reduced(self) -> SymmetricBlocks:
        """The taxels' matrix with the contacts eliminated."""
        pattern, coupling = self.pattern, self.taxel_contact
        weighted = coupling @ self._inverse_contacts[pattern.readings.contact]
        own = weighted @ np.swapaxes(coupling, 1, 2)
        pairs = weighted[pattern.second] @ np.swapaxes(coupling[pattern.first], 1, 2)
        off = -sums(pattern.by_block, pairs)
        diagonal = self.taxels - sums(pattern.by_taxel, own)
        return SymmetricBlocks(pattern.rows, pattern.columns, off).add_diagonal(diagonal)

    def damped(self, damping: float) -> CoupledSystem:
        """The system with its diagonal enlarged by a fraction, for taxels and global parameters."""
        size = self.taxels.shape[1]
        return replace(
            self,
            taxels=self.taxels * (1 + damping * np.eye(size)),
            shared=self.shared * (1 + damping * np.eye(len(self.shared))),
        )

    def solve(self, taxels: Array, contacts: Array, shared: Array) -> tuple[Array, Array, Array]:
        """x with H x = the right-hand side (n, D, c), (m, 3, c), (ks, c), in the same parts."""
        coupling, by_contact = self._coupling
        right = taxels - self._to_taxels(self._inverse_contacts @ contacts)
        if "_by_taxel" in self.__dict__:
            by_taxel, y = self._by_taxel, self._solve_taxels(right)
        else:  # one factorization serves both
            both = self._solve_taxels(np.concatenate([coupling, right], axis=2))
            by_taxel, y = np.split(both, [coupling.shape[2]], axis=2)
            self.__dict__["_by_taxel"] = by_taxel
        rest = shared - np.einsum("mis,mic->sc", by_contact, contacts)
        rest = rest - np.einsum("nis,nic->sc", by_taxel, right)
        x = np.linalg.solve(self._schur, rest)
        y = y - by_taxel @ x
        back = contacts - self._to_contacts(y) - self.contact_shared @ x
        return y, self._inverse_contacts @ back, x

    @cached_property
    def _coupling(self) -> tuple[Array, Array]:
        """Coupling of taxels and global parameters (n, D, ks) with the contacts eliminated; C^-1
        times that of the contacts (m, 3, ks)."""
        by_contact = self._inverse_contacts @ self.contact_shared
        return self.taxel_shared - self._to_taxels(by_contact), by_contact

    @cached_property
    def _by_taxel(self) -> Array:
        """S^-1 times the reduced coupling (n, D, ks)."""
        return self._solve_taxels(self._coupling[0])

    @cached_property
    def _schur(self) -> Array:
        """The matrix (ks, ks) of the global parameters with all others eliminated."""
        coupling, by_contact = self._coupling
        schur = self.shared - np.einsum("mis,mit->st", self.contact_shared, by_contact)
        return np.asarray(schur - np.einsum("nis,nit->st", coupling, self._by_taxel))

    def _solve_taxels(self, right: Array) -> Array:
        return np.asarray(self.pattern.cholesky.solve(self._reduced, right))

    def covariances(self) -> tuple[Array, Array]:
        """Covariances of the taxels (n, D, D) and of the global parameters (ks, ks)."""
        own = self.pattern.cholesky.diagonal_of_inverse(self._reduced, 0.0)
        by_taxel, shared = self._by_taxel, np.linalg.inv(self._schur)
        return own + by_taxel @ shared @ np.swapaxes(by_taxel, 1, 2), np.asarray(shared)

    def _to_taxels(self, values: Array) -> Array:
        """B v (n, D, c) of values (m, 3, c) of the contacts."""
        contact = self.pattern.readings.contact
        return sums(self.pattern.by_taxel, self.taxel_contact @ values[contact])

    def _to_contacts(self, values: Array) -> Array:
        """B^T v (m, 3, c) of values (n, D, c) of the taxels."""
        taxel = self.pattern.readings.taxel
        each = np.swapaxes(self.taxel_contact, 1, 2) @ values[taxel]
        return sums(self.pattern.by_contact, each)


def _summation(owner: np.ndarray, count: int) -> sparse.csr_array:
    """The matrix (count, k) that sums k values by owner (k,)."""
    return sparse.csr_array(
        (np.ones(len(owner)), (owner, np.arange(len(owner)))), shape=(count, len(owner))
    )


def sums(summation: sparse.csr_array, values: Array) -> Array:
    """Sums (count, ...) of values (k, ...)."""
    rest = values.shape[1:]
    flat = summation @ values.reshape(len(values), math.prod(rest))
    return np.asarray(flat).reshape(-1, *rest)


def _outer_sums(summation: sparse.csr_array, a: Array, b: Array) -> Array:
    """Sums (count, p, q) of outer products of a (p, k) and b (q, k)."""
    return sums(summation, a.T[:, :, None] * b.T[:, None, :])
