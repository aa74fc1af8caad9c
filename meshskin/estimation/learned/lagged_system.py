"""The normal equations where readings depend on the errors of an earlier contact, too.

Under hysteresis (electronics.py) a reading rests on an earlier one of its taxel, and so on the
errors of that one's contact. Contacts are then coupled with each other and cannot be eliminated one
by one: taxels and contacts are blocks of one sparse matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from ...core.arrays import Array
from ..joint.coupled_system import CoupledSystem, inner
from ..joint.reading_sums import CONTACT_SIZE, Parts
from ..posegraph.cholesky import Cholesky
from ..posegraph.symmetric_blocks import SymmetricBlocks


@dataclass(frozen=True)
class LaggedSystem(CoupledSystem):
    """H and g with further couplings of l readings."""

    lagged: np.ndarray
    """Readings (l,) that rest on an earlier one."""
    source: np.ndarray
    """Contacts (l,) of the earlier ones."""
    lag: Array
    """Derivatives (l, 3) of the readings in the errors of these contacts."""
    lag_taxel: Array
    """Coupling (l, 3, D) of these contacts with the readings' taxels."""
    lag_contact: Array
    """Coupling (l, 3, 3) of these contacts with the readings' own contacts."""

    @classmethod
    def extended(
        cls,
        system: CoupledSystem,
        jacobian: Array,
        rate: Array,
        curvature: Array,
        lag: Array,
        source: np.ndarray,
    ) -> LaggedSystem:
        """`system`, made of the same readings, with their derivatives `lag` (k, 3) in the errors of
        the contacts `source` (k,)."""
        lagged = np.flatnonzero(lag.any(axis=1))
        lag, source, size = lag[lagged], source[lagged], system.taxels.shape[1]
        own, shared, at = np.split(jacobian[lagged], [size, -CONTACT_SIZE], axis=1)
        weighted = curvature[lagged, None] * lag
        parts = {field.name: getattr(system, field.name) for field in fields(system)}
        contacts, by_shared = system.contacts.copy(), system.contact_shared.copy()
        gradient = system.gradient[1].copy()
        np.add.at(contacts, source, weighted[:, :, None] * lag[:, None, :])
        np.add.at(by_shared, source, weighted[:, :, None] * shared[:, None, :])
        np.add.at(gradient, source, rate[lagged, None] * lag)
        parts |= {
            "contacts": contacts,
            "contact_shared": by_shared,
            "gradient": (system.gradient[0], gradient, system.gradient[2]),
        }
        return cls(
            **parts,
            lagged=lagged,
            source=source,
            lag=lag,
            lag_taxel=weighted[:, :, None] * own[:, None, :],
            lag_contact=weighted[:, :, None] * at[:, None, :],
        )

    def transposed(self, jacobian: Array, values: Array) -> Parts:
        """As CoupledSystem.transposed."""
        taxels, contacts, shared = super().transposed(jacobian, values)
        np.add.at(contacts, self.source, self.lag[:, :, None] * values[self.lagged][:, None, :])
        return taxels, contacts, shared

    def forward(self, jacobian: Array, x: Parts) -> Array:
        """As CoupledSystem.forward."""
        found = super().forward(jacobian, x)
        found[self.lagged] += np.einsum("li,lic->lc", self.lag, x[1][self.source])
        return found

    @cached_property
    def _blocks(self) -> tuple[Cholesky, SymmetricBlocks]:
        """The matrix of taxels and contacts, all blocks of the taxels' size, and its factorization;
        the unused entries of the contacts are those of the identity."""
        pattern, n, size = self.pattern, len(self.taxels), self.taxels.shape[1]
        nodes = n + len(self.contacts)
        first = np.concatenate([pattern.contact, self.source, self.source]) + n
        second = np.concatenate(
            [pattern.taxel, pattern.taxel[self.lagged], n + pattern.contact[self.lagged]]
        )
        blocks = np.zeros((len(first), size, size))
        k, end = len(pattern.taxel), len(pattern.taxel) + len(self.lagged)
        blocks[:k, :CONTACT_SIZE] = np.swapaxes(self.taxel_contact, 1, 2)
        blocks[k:end, :CONTACT_SIZE] = self.lag_taxel
        blocks[end:, :CONTACT_SIZE, :CONTACT_SIZE] = self.lag_contact
        swapped = first < second  # into the lower triangle
        blocks[swapped] = np.swapaxes(blocks[swapped], 1, 2)
        rows, columns = np.where(swapped, (second, first), (first, second))
        pairs, owner = np.unique(rows * nodes + columns, return_inverse=True)
        sums = np.zeros((len(pairs), size, size))
        np.add.at(sums, owner, blocks)
        rows, columns = np.divmod(pairs, nodes)
        diagonal = np.tile(np.eye(size), (nodes, 1, 1))
        diagonal[:n] = self.taxels
        diagonal[n:, :CONTACT_SIZE, :CONTACT_SIZE] = self.contacts
        matrix = SymmetricBlocks(rows, columns, sums).add_diagonal(diagonal)
        return pattern.lagged_cholesky(nodes, pairs), matrix

    def _joined(self, taxels: Array, contacts: Array) -> Array:
        """Values (n + m, D, c) of taxels (n, D, c) and contacts (m, 3, c)."""
        n, (size, columns) = len(taxels), taxels.shape[1:]
        out = np.zeros((n + len(contacts), size, columns))
        out[:n], out[n:, :CONTACT_SIZE] = taxels, contacts
        return out

    def solve(self, taxels: Array, contacts: Array, shared: Array) -> Parts:
        """As CoupledSystem.solve."""
        cholesky, matrix = self._blocks
        right, n = self._joined(taxels, contacts), len(taxels)
        y = np.asarray(cholesky.solve(matrix, right))
        x = np.linalg.solve(self._schur, shared - inner(self._all_coupling, y))
        y = y - self._by_all @ x
        return y[:n], y[n:, :CONTACT_SIZE], np.asarray(x)

    def explained(self, taxels: Array, contacts: Array, shared: Array) -> tuple[Array, Array]:
        """As CoupledSystem.explained."""
        parts = taxels, contacts, shared
        x = [part.reshape(-1, part.shape[-1]) for part in self.solve(taxels, contacts, shared)]
        square = sum(b.reshape(-1, b.shape[-1]).T @ y for b, y in zip(parts, x, strict=True))
        along = sum(y.T @ g.ravel() for y, g in zip(x, self.gradient, strict=True))
        return np.asarray(square), np.asarray(along)

    def following(self, shared: Array) -> Parts:
        """As CoupledSystem.following."""
        y, n = -self._by_all @ shared, len(self.taxels)
        return y[:n], y[n:, :CONTACT_SIZE], shared

    def covariances(self) -> tuple[Array, Array]:
        """As CoupledSystem.covariances."""
        cholesky, matrix = self._blocks
        n, shared = len(self.taxels), self.shared_covariance
        own, by_taxel = cholesky.diagonal_of_inverse(matrix, 0.0)[:n], self._by_all[:n]
        return own + by_taxel @ shared @ np.swapaxes(by_taxel, 1, 2), shared

    @cached_property
    def _all_coupling(self) -> Array:
        """Coupling (n + m, D, ks) of taxels and contacts with the global parameters."""
        return self._joined(self.taxel_shared, self.contact_shared)

    @cached_property
    def _by_all(self) -> Array:
        """The matrix' inverse times the coupling (n + m, D, ks)."""
        cholesky, matrix = self._blocks
        return np.asarray(cholesky.solve(matrix, self._all_coupling))

    @cached_property
    def _schur(self) -> Array:
        return self.shared - inner(self._all_coupling, self._by_all)
