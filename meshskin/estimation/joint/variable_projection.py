"""Variable projection: the taxels' coordinates are eliminated from the global parameters.

For given global parameters s the coordinates z of every group of taxels are at their optimum z(s),
found by damped Gauss-Newton steps of all groups at once, each accepted or rejected by itself. The
reduced problem in s alone has

    F(s) = min_z f(z, s),   dF/ds = f_s - f_sz f_zz^-1 f_z,   d2F/ds2 = f_ss - f_sz f_zz^-1 f_zs

(Gauss-Newton). The work is linear in the readings, and groups that converge slowly do not delay the
others.

Source: Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
problems whose variables separate", SIAM J. Numer. Anal. 10 (1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array, ranges
from .contacts import LinearizedContacts
from .likelihood import Likelihood, Moments
from .parametrization import Parametrization

MAX_STEPS = 40
"""Largest number of steps of a group; two to five are usual."""
INNER_TOLERANCE = 1e-9
"""Newton decrement, in units of the cost, at which a group has converged: a tenth of
`reduced_nlp.NEWTON_TOLERANCE`."""
INNER_PART = 1e-3
"""Part of the Newton decrement of the global parameters to which the groups together are brought to
their optimum, where that is less exact: the cost that a step of s is judged by is then wrong by
that part of its expected change."""
LEAST_PART = 0.1
"""Least part of the time of an evaluation of all groups that a step of few takes: 0.4 of that of
100 taxels with 6,000 readings."""
LOOSE_SIGMA = 0.1
"""Standard deviation, m, of a move that no reading determines: it keeps the system of such a taxel
regular, and is far larger than any uncertainty that counts as an estimate."""


@dataclass
class State:
    """All unknowns at one point, and the moments of the cost there."""

    z: Array
    """Coordinates (G, D) of the groups, then nuisance parameters of their taxels."""
    s: Array
    """Global parameters (ks,)."""
    moments: Moments
    """Of the taxels."""
    decrement: Array
    """Newton decrement (G,) of each group."""


@dataclass(frozen=True)
class SchurComplement:
    """The reduced problem at one s: cost, gradient (ks,) and Hessian (ks, ks), with the priors."""

    cost: float
    gradient: Array
    hessian: Array

    @property
    def decrement(self) -> float:
        """Newton decrement: the expected decrease of the cost to the optimum."""
        if not len(self.gradient):
            return 0.0
        return float(self.gradient @ np.linalg.solve(self.hessian, self.gradient)) / 2


@dataclass(frozen=True)
class TaxelBlocks:
    """Normal equations of G groups: (D, D) of each, coupled with s."""

    cost: Array
    gradient: Array
    hessian: Array
    coupling: Array
    """(G, D, ks)."""

    @property
    def decrement(self) -> Array:
        """Newton decrement (G,) of each group."""
        return np.asarray(-np.einsum("gi,gi->g", self.steps(), self.gradient) / 2)

    def steps(self, damping: Array | float = 0.0) -> Array:
        """Steps (G, D) to the minimum of the quadratic, damped in proportion to the diagonal."""
        h = self.hessian.copy()
        i = np.arange(h.shape[1])
        h[:, i, i] *= 1.0 + np.reshape(damping, (-1, 1))
        return np.asarray(-np.linalg.solve(h, self.gradient[:, :, None])[:, :, 0])


@dataclass
class ReducedProblem:
    """A likelihood with its parametrization and contacts, and its reduction to s."""

    likelihood: Likelihood
    parametrization: Parametrization
    contacts: LinearizedContacts
    inner_tolerance: float = INNER_TOLERANCE
    """Newton decrement, in units of the cost, at which a group has converged."""
    resting: np.ndarray | None = None
    """Groups (G,) bool that stay where they are while s is optimized; None: none."""
    evaluations: float = 0.0
    """Evaluations of all groups in `solve_inner`; one of a group counts 1 / count, or LEAST_PART.
    """

    def __post_init__(self) -> None:
        group = self.parametrization.group
        self.first = np.searchsorted(group, np.arange(self.parametrization.count + 1))
        self.slot = np.arange(len(group)) - self.first[group]
        self.per_taxel = len(self.likelihood.data.parameters.nuisance_names)
        self.width = self.parametrization.size + self.per_taxel * int(np.diff(self.first).max())

    def start(self, s: Array, z: Array | None = None) -> State:
        """The state at z (G, D), zero by default, without optimization."""
        count, n = self.parametrization.count, len(self.parametrization.group)
        z = np.zeros((count, self.width)) if z is None else z.copy()
        size = 3 + self.per_taxel + self.likelihood.shared
        state = State(z, s, Moments.zeros(n, size), np.full(count, np.inf))
        groups = np.arange(count)
        rows, _ = self._taxels(groups)
        state.moments.put(rows, self._moments(z, s, groups))
        return state

    def tolerance(self, decrement: float) -> float:
        """Newton decrement to which a group is brought at a `decrement` of s (INNER_PART)."""
        return max(self.inner_tolerance, INNER_PART * decrement / self.parametrization.count)

    def solve_inner(
        self,
        state: State,
        groups: np.ndarray | None = None,
        most: int = MAX_STEPS,
        decrement: float = 0.0,
    ) -> None:
        """Bring the groups (all but the resting ones by default) to their optimum at the state's s,
        in place, in `most` steps or fewer; decrement: as of `tolerance`."""
        tolerance = self.tolerance(decrement)
        if groups is None:
            groups = np.arange(self.parametrization.count)
            groups = groups if self.resting is None else groups[~self.resting]
        damping = np.zeros(len(groups))
        for _ in range(most):
            blocks = self.blocks(state, groups)
            step = blocks.steps(damping)
            state.decrement[groups] = blocks.decrement
            active = state.decrement[groups] > tolerance
            groups, step, damping = groups[active], step[active], damping[active]
            if not len(groups):
                return
            self.evaluations += max(len(groups) / self.parametrization.count, LEAST_PART)
            z = state.z[groups] + self.parametrization.limit_step(step)
            moments = self._moments(z, state.s, groups)
            rows, owner = self._taxels(groups)
            cost = np.bincount(owner, moments.cost) + self.parametrization.prior(z, groups)[0]
            better = cost <= blocks.cost[active] * (1 + 1e-13)
            state.z[groups[better]] = z[better]
            keep = better[owner]
            state.moments.put(rows[keep], moments.take(keep))
            damping = np.where(better, np.where(damping > 1e-3, damping / 10, 0.0),
                               np.maximum(10 * damping, 1e-2))  # fmt: skip

    def blocks(self, state: State, groups: np.ndarray | None = None) -> TaxelBlocks:
        """The normal equations of `groups` (all by default) at the state."""
        groups = np.arange(self.parametrization.count) if groups is None else groups
        rows, owner = self._taxels(groups)
        local, count = 3 + self.per_taxel, len(groups)
        jacobian = self._jacobian(state.z[groups], groups)
        moments = state.moments.take(rows)
        half = np.einsum("rci,rcd->rid", jacobian, moments.hessian[:, :local])
        cost, gradient, hessian = self.parametrization.prior(state.z[groups], groups)
        hessian = hessian + np.eye(self.width) * self._regularization(groups)[:, None]
        return TaxelBlocks(
            cost=cost + np.bincount(owner, moments.cost, count),
            gradient=gradient
            + _sums(np.einsum("rci,rc->ri", jacobian, moments.gradient[:, :local]), owner, count),
            hessian=hessian + _sums(half[:, :, :local] @ jacobian, owner, count),
            coupling=_sums(half[:, :, local:], owner, count),
        )

    def reduce(self, state: State) -> SchurComplement:
        """The reduced problem, at a state whose groups are at their optimum, or rest."""
        blocks = self.blocks(state)
        local = 3 + self.per_taxel
        response = self._response(blocks)
        moments = state.moments
        data = moments.hessian[:, local:, local:].sum(axis=0)
        data -= np.einsum("gik,gil->kl", blocks.coupling, response)
        gradient = moments.gradient[:, local:].sum(axis=0)
        gradient -= np.einsum("gi,gik->k", blocks.gradient, response)
        weight = self.likelihood.data.parameters.sigma**-2
        return SchurComplement(
            cost=float(blocks.cost.sum() + weight @ state.s**2 / 2),
            gradient=gradient + weight * state.s,
            hessian=data + np.diag(weight),
        )

    def information(self, state: State) -> tuple[Array, Array | None]:
        """Information (ks, ks) of the readings on s, without priors on s and nuisance parameters;
        and the derivative (ks,) of the mean ln gain by s, where gains are declared.
        """
        blocks, names = self.blocks(state), self.likelihood.data.parameters.nuisance_names
        local = 3 + self.per_taxel
        bare, group = blocks.hessian.copy(), self.parametrization.group
        column = self.parametrization.size + self.per_taxel * self.slot
        for k, sigma in enumerate(self.likelihood.nuisance_sigma):
            bare[group, column + k, column + k] -= sigma**-2
        response = np.linalg.pinv(bare, rcond=1e-12, hermitian=True) @ blocks.coupling
        total = state.moments.hessian[:, local:, local:].sum(axis=0)
        gains = None
        if "gain" in names:
            gains = -response[group, column + names.index("gain")].mean(axis=0)
        return total - np.einsum("gik,gil->kl", blocks.coupling, response), gains

    def solved_at(self, state: State, s: Array, decrement: float = 0.0) -> State:
        """The state at other s (ks,) with the groups at their optimum, from a first-order guess;
        decrement: as of `solve_inner`."""
        shift = -self._response(self.blocks(state)) @ (s - state.s)
        there = self.start(s, state.z + self.parametrization.limit_step(shift))
        self.solve_inner(there, decrement=decrement)
        return there

    def _response(self, blocks: TaxelBlocks) -> Array:
        """Derivatives (G, D, ks) of the optima of all groups by s, negative; 0 of those that rest:
        a group that is not at its optimum has no derivative there."""
        response = np.linalg.solve(blocks.hessian, blocks.coupling)
        if self.resting is not None:
            response[self.resting] = 0.0
        return np.asarray(response)

    def covariances(self, state: State, reduced: SchurComplement) -> tuple[Array, Array]:
        """Covariances of the groups' unknowns (G, D, D), with s unknown, and of s (ks, ks)."""
        blocks = self.blocks(state)
        inverse = np.linalg.inv(blocks.hessian)
        response = inverse @ blocks.coupling
        shared = np.asarray(np.linalg.inv(reduced.hessian))
        return inverse + response @ shared @ np.swapaxes(response, 1, 2), shared

    def leverages(self, state: State, reduced: SchurComplement) -> Array:
        """The leverage (k,) of each reading on its own prediction: the variance of its residual is
        1 less this, in units of the noise."""
        full, contacts = self._taxel_covariances(state, reduced), self.contacts.at(state.s)
        return self.likelihood.leverages(self.points(state), self.nuisance(state.z), contacts, full)

    def difference_variances(
        self, state: State, reduced: SchurComplement, first: np.ndarray, second: np.ndarray
    ) -> Array:
        """Variances (p,) of the differences of residuals of the readings `first` and `second` (p,),
        each pair of one taxel, in units of the noise's: 2 less what the estimate follows of them.
        """
        read, points = self.likelihood.readings, self.points(state)
        nuisance = self.nuisance(state.z)
        own, contacts = read.taxel[first], self.contacts.at(state.s)
        group = self.likelihood.groups(own)
        one, other = (
            self.likelihood.predict(
                read.contact[rows], points[own], nuisance[own], contacts, group
            )[1]
            for rows in (first, second)
        )
        full, apart = self._taxel_covariances(state, reduced)[own], (one - other).T
        return np.asarray(np.maximum(2 - np.einsum("pi,pij,pj->p", apart, full, apart), 0.0))

    def _taxel_covariances(self, state: State, reduced: SchurComplement) -> Array:
        """Covariances (n, C, C) of each taxel's position, nuisance and global parameters."""
        blocks, groups = self.blocks(state), np.arange(self.parametrization.count)
        local = 3 + self.per_taxel
        inverse, shared = np.linalg.inv(blocks.hessian), np.linalg.inv(reduced.hessian)
        response = -inverse @ blocks.coupling
        jacobian, own = self._jacobian(state.z, groups), self.parametrization.group
        full = np.empty((len(own), local + len(shared), local + len(shared)))
        follows = jacobian @ response[own]
        full[:, :local, local:] = follows @ shared
        full[:, local:, :local] = np.swapaxes(full[:, :local, local:], 1, 2)
        full[:, local:, local:] = shared
        full[:, :local, :local] = jacobian @ inverse[own] @ np.swapaxes(jacobian, 1, 2)
        full[:, :local, :local] += full[:, :local, local:] @ np.swapaxes(follows, 1, 2)
        return full

    def points(self, state: State) -> Array:
        """Points (n, 3), m, of all taxels at the state."""
        group, size = self.parametrization.group, self.parametrization.size
        return self.parametrization.at(state.z[group, :size], group, np.arange(len(group)))[0]

    def nuisance(self, z: Array, groups: np.ndarray | None = None) -> Array:
        """Nuisance parameters (r, .) of the taxels of `groups`, by default all, with unknowns z
        (g, D)."""
        rows, owner = self._taxels(
            np.arange(self.parametrization.count) if groups is None else groups
        )
        first = self.parametrization.size + self.per_taxel * self.slot[rows, None]
        return np.asarray(z[owner[:, None], first + np.arange(self.per_taxel)])

    def _taxels(self, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Taxels (r,) of the groups, and the index in `groups` of each."""
        if self.parametrization.count == len(self.parametrization.group):  # one taxel a group
            return groups, np.arange(len(groups))
        count = self.first[groups + 1] - self.first[groups]
        return ranges(self.first[groups], count), np.repeat(np.arange(len(groups)), count)

    def _moments(self, z: Array, s: Array, groups: np.ndarray) -> Moments:
        """Moments of the taxels of `groups` at z (g, D) and s."""
        rows, owner = self._taxels(groups)
        points, _ = self.parametrization.at(
            z[owner, : self.parametrization.size], groups[owner], rows
        )
        contacts = self.contacts.at(s)
        return self.likelihood.moments(rows, points, self.nuisance(z, groups), contacts)

    def _jacobian(self, z: Array, groups: np.ndarray) -> Array:
        """Derivatives (r, 3 + nuisance, D) of the taxels' unknowns by those of their groups."""
        rows, owner = self._taxels(groups)
        size = self.parametrization.size
        jacobian = np.zeros((len(rows), 3 + self.per_taxel, self.width))
        jacobian[:, :3, :size] = self.parametrization.at(z[owner, :size], groups[owner], rows)[1]
        for k in range(self.per_taxel):
            jacobian[np.arange(len(rows)), 3 + k, size + self.per_taxel * self.slot[rows] + k] = 1.0
        return jacobian

    def _regularization(self, groups: np.ndarray) -> Array:
        """Weak information (g, D) that keeps the system of an undetermined group regular."""
        count = (self.first[groups + 1] - self.first[groups])[:, None]
        slot = (np.arange(self.width) - self.parametrization.size) // max(self.per_taxel, 1)
        extra = np.arange(self.width) >= self.parametrization.size
        return np.where(extra, np.where(slot >= count, 1.0, 0.0), LOOSE_SIGMA**-2)


def _sums(values: Array, owner: np.ndarray, count: int) -> Array:
    """Sums (count, ...) of values (r, ...) over rising owners that all occur."""
    if len(values) == count:
        return values
    return np.asarray(np.add.reduceat(values, np.searchsorted(owner, np.arange(count)), axis=0))
