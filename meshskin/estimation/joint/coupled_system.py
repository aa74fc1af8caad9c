"""The normal equations of taxels, contacts and global parameters together.

Where contact points and forces are measurements with errors of their own, each reading couples its
taxel with its contact. The contacts, three unknowns each, are eliminated first; what remains is a
sparse matrix with a block for every pair of taxels that read in the same contact, factorized by
posegraph/cholesky.py, and the global parameters are eliminated last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...core.arrays import Array
from ..posegraph.cholesky import Cholesky
from ..posegraph.symmetric_blocks import SingularMatrixError, SymmetricBlocks
from .reading_sums import Parts, ReadingSums
from .readings import Readings

COLUMNS = 12
"""Columns that are eliminated together: two parts of the usual 22. All at once would take 1 % less
time with 10,000 taxels, and twice the memory."""
DAMPINGS = (0.0, 1e-3, 1e-2, 0.1, 1.0)
"""Damping of singular normal equations, relative to their diagonal, in the order of trials."""


class CouplingPattern(ReadingSums):
    """Which taxels read in the same contacts; made once for a selection of readings."""

    def __init__(self, readings: Readings, contacts: int) -> None:
        """contacts: their number m."""
        super().__init__(readings.taxel, readings.contact, len(readings.starts) - 1, contacts)
        self._lagged: tuple[np.ndarray, Cholesky] | None = None

    @cached_property
    def cholesky(self) -> Cholesky:
        """The factorization of the taxels' matrix."""
        return Cholesky(self.taxels, self.rows, self.columns)

    def lagged_cholesky(self, nodes: int, pairs: np.ndarray) -> Cholesky:
        """The factorization of a matrix of `nodes` taxels and contacts with blocks at the `pairs`
        (b,), row times `nodes` plus column; the last one is kept."""
        if self._lagged is None or not np.array_equal(self._lagged[0], pairs):
            self._lagged = pairs, Cholesky(nodes, *np.divmod(pairs, nodes))
        return self._lagged[1]


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
        """Of k readings with derivatives (k, D + ks + 3) in taxel, global parameters and contact,
        and first and second derivative (k,) of their cost; D = `size`. Without priors."""
        names = ("taxels", "contacts", "shared", "taxel_contact", "taxel_shared", "contact_shared")
        *blocks, g, h, k = pattern.normal_equations(jacobian, rate, curvature, size)
        return cls(pattern=pattern, gradient=(g, h, k), **dict(zip(names, blocks, strict=True)))

    def transposed(self, jacobian: Array, values: Array) -> Parts:
        """J^T v in parts, of values v (k, c) of the readings; jacobian as `from_readings`."""
        return self.pattern.transposed(jacobian, values, self.taxels.shape[1])

    def forward(self, jacobian: Array, x: Parts) -> Array:
        """J x (k, c) of unknowns x in parts; jacobian as `from_readings`."""
        return self.pattern.forward(jacobian, x, self.taxels.shape[1])

    @cached_property
    def _inverse_contacts(self) -> Array:
        return np.asarray(np.linalg.inv(self.contacts))

    @cached_property
    def _reduced(self) -> SymmetricBlocks:
        """The taxels' matrix with the contacts eliminated."""
        own, off = self.pattern.eliminated(self.taxel_contact, self._inverse_contacts)
        blocks = SymmetricBlocks(self.pattern.rows, self.pattern.columns, off)
        return blocks.add_diagonal(self.taxels + own)

    def damped(self, damping: float) -> CoupledSystem:
        """The system with its diagonal enlarged by a fraction, for taxels and global parameters."""
        if not damping:
            return self
        size = self.taxels.shape[1]
        return replace(
            self,
            taxels=self.taxels * (1 + damping * np.eye(size)),
            shared=self.shared * (1 + damping * np.eye(len(self.shared))),
        )

    def solve(self, taxels: Array, contacts: Array, shared: Array) -> Parts:
        """x with H x = the right-hand side (n, D, c), (m, 3, c), (ks, c), in the same parts."""
        _, _, y, rest = self._eliminated(taxels, contacts, shared)
        x = np.linalg.solve(self._schur, rest)
        y = y - self._by_taxel @ x
        back = contacts - self.pattern.to_contacts(self.taxel_contact, y) - self.contact_shared @ x
        return y, self._inverse_contacts @ back, np.asarray(x)

    def newton_step(self) -> tuple[CoupledSystem, Parts, float]:
        """The system, damped where rounding makes it singular, x with H x = g in parts (n, D),
        (m, 3), (ks,), and x^T g / 2, the decrease of the cost by a step of -x. Raises
        SingularMatrixError where damping fails.
        """
        gradient = tuple(g[..., None] for g in self.gradient)
        for damping in DAMPINGS:
            damped = self.damped(damping)
            try:
                x = damped.solve(*gradient)
                decrease = sum(float(np.vdot(a, g)) for a, g in zip(x, gradient, strict=True)) / 2
                return damped, (x[0][..., 0], x[1][..., 0], x[2][..., 0]), decrease
            except SingularMatrixError as error:
                singular = error
        raise singular

    def explained(self, taxels: Array, contacts: Array, shared: Array) -> tuple[Array, Array]:
        """b^T H^-1 b (c, c) and b^T H^-1 g (c,) of b in parts as of `solve`, without H^-1 b; g is
        the gradient."""
        pressed, right, y, rest = self._eliminated(taxels, contacts, shared)
        by_taxel, by_contact, by_shared = self.gradient
        moved = self._inverse_contacts @ by_contact[..., None]
        left = by_taxel[..., None] - self.pattern.to_taxels(self.taxel_contact, moved)
        least = by_shared[:, None] - inner(self.contact_shared, moved) - inner(self._by_taxel, left)
        ahead = np.linalg.solve(self._schur, rest)
        square = inner(contacts, pressed) + inner(right, y) + rest.T @ ahead
        along = inner(pressed, by_contact[..., None]) + inner(y, left) + ahead.T @ least
        return square, along[:, 0]

    def _eliminated(
        self, taxels: Array, contacts: Array, shared: Array
    ) -> tuple[Array, Array, Array, Array]:
        """A right-hand side with contacts, then taxels eliminated: solution of the contacts alone,
        right-hand side of the taxels and its solution, right-hand side of the global parameters."""
        coupling = self._coupling[0]
        pressed = self._inverse_contacts @ contacts
        right = taxels - self.pattern.to_taxels(self.taxel_contact, pressed)
        if "_by_taxel" in self.__dict__:
            by_taxel, y = self._by_taxel, self._solve_taxels(right)
        else:  # one factorization serves both
            both = self._solve_taxels(np.concatenate([coupling, right], axis=2))
            by_taxel, y = np.split(both, [coupling.shape[2]], axis=2)
            self.__dict__["_by_taxel"] = by_taxel
        rest = shared - inner(self.contact_shared, pressed) - inner(by_taxel, right)
        return pressed, right, y, rest

    def restrained(self, shared: Array, weight: Array) -> Array:
        """The solution `shared` (ks,) for the global parameters as it is with a further cost of
        weight (ks,) times the squares of their steps."""
        return np.asarray(np.linalg.solve(self._schur + np.diag(weight), self._schur @ shared))

    def following(self, shared: Array) -> Parts:
        """How taxels (n, D) and contacts (m, 3) follow a change (ks,) of the global parameters."""
        taxels = -self._by_taxel @ shared
        direct = (
            self.contact_shared @ shared
            + self.pattern.to_contacts(self.taxel_contact, taxels[..., None])[..., 0]
        )
        return taxels, -np.einsum("mij,mj->mi", self._inverse_contacts, direct), shared

    @cached_property
    def _coupling(self) -> tuple[Array, Array]:
        """Coupling of taxels and global parameters (n, D, ks), and matrix (ks, ks) of these, with
        the contacts eliminated."""
        shared, coupling = self.shared.copy(), self.taxel_shared.copy()
        for part in np.array_split(np.arange(len(shared)), -(-len(shared) // COLUMNS)):
            by_contact = self._inverse_contacts @ self.contact_shared[:, :, part]
            shared[:, part] -= inner(self.contact_shared, by_contact)
            coupling[:, :, part] -= self.pattern.to_taxels(self.taxel_contact, by_contact)
        return coupling, shared

    @cached_property
    def _by_taxel(self) -> Array:
        """S^-1 times the reduced coupling (n, D, ks)."""
        return self._solve_taxels(self._coupling[0])

    @cached_property
    def _schur(self) -> Array:
        """The matrix (ks, ks) of the global parameters with all others eliminated."""
        coupling, shared = self._coupling
        return shared - inner(coupling, self._by_taxel)

    def _solve_taxels(self, right: Array) -> Array:
        return np.asarray(self.pattern.cholesky.solve(self._reduced, right))

    def covariances(self) -> tuple[Array, Array]:
        """Covariances of the taxels (n, D, D) and of the global parameters (ks, ks)."""
        own = self.pattern.cholesky.diagonal_of_inverse(self._reduced, 0.0)
        by_taxel, shared = self._by_taxel, self.shared_covariance
        return own + by_taxel @ shared @ np.swapaxes(by_taxel, 1, 2), shared

    def log_determinant(self) -> float:
        """Logarithm of the determinant of H."""
        contacts, shared = (np.linalg.slogdet(m)[1].sum() for m in (self.contacts, self._schur))
        return float(contacts + self.pattern.cholesky.log_determinant(self._reduced) + shared)

    @property
    def shared_covariance(self) -> Array:
        """Covariance of the global parameters (ks, ks)."""
        return np.asarray(np.linalg.inv(self._schur))


def inner(a: Array, b: Array) -> Array:
    """Sums (p, q) of products over all but the last axis of a (., ., p) and b (., ., q)."""
    return np.asarray(a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2]))
