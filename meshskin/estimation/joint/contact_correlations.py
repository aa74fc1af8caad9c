"""Errors of contact points and forces that neighbouring contacts share, in an estimate with a
learned response; residual_correlations.py has those of the readings beside them.

The estimate takes displacements and force errors of the contacts as independent. Where those of
neighbouring contacts are alike, many contacts tell less than they seem to: over the facets of a
mesh, or where the stiffness of a skin varies over the body. How much less follows from variance
components, by the method of moments: correlograms of the errors that the estimate has found are
compared with those that it would find of white errors and of random fields over the body, which are
drawn and estimated by the same normal equations.

Source: Cressie, "Statistics for Spatial Data" (1993), 2.4 and 2.6; Rahimi and Recht, "Random
features for large-scale kernel machines" (2007), for the fields.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from ...core.arrays import Array
from .deviations import FLOOR
from .random_effects import RandomEffects

MAX_CORRELATION, LARGEST_CORRELATION = 0.4, 0.95
"""Correlation of the displacements of neighbouring contacts above which they are no scatter:
independent ones have -0.1 to 0.15, by the taxels that they share; and the largest one that tells
how many contacts they stand for."""
MIN_CONTACTS = 20
"""Contacts, at least, whose errors are compared."""
LENGTH = 0.25
"""Length over which a field is correlated, in reaches of a contact. Longer ones displace contacts
and taxels together, so that the correlograms hardly tell them: with further lengths of 0.4 to 0.8
variances were up to 4 times too large, on raw meshes."""
RINGS, FAR = 12, 1.5
"""Bins of a correlogram beside that of distance zero, and its end in reaches of a contact."""
CENTRES = 2000
"""Contacts, about, whose neighbours are compared: more change little."""
WAVES = 32
"""Cosines of a field: its sums over a correlogram are those of a Gaussian one to a few percent."""
MODEL_ERROR = 0.03
"""Error of a correlogram of Gaussian fields, relative to its value at distance zero: no field of
the world has exactly their correlations."""
MIN_GAIN = 20.0
"""Decrease of the misfit of the correlograms, as chi-square, from which fields are no chance: at
most 5 in 24 recordings of worlds without any, and 24 or more in 50 of uneven skins and raw meshes,
measured with fields of two lengths, 0.2 and 0.4, in place of `LENGTH`."""
FORCE_UNIT = 0.02
"""Deviation of ln force of the drawn force errors, at least: with less, an estimate that finds
none would take other errors for a great many of them."""
KINDS = ("contact points", "forces")
"""What errs, in the order of the correlograms."""


@dataclass(frozen=True)
class AlikeErrors:
    """Errors that neighbouring contacts share."""

    factor: float = 1.0
    """Factor of the taxels' variances by them."""
    parts: tuple[float, ...] = (0.0, 0.0)
    """What fields of each of KINDS have in it."""


def fewer_contacts(correlation: float) -> float:
    """Factor of the variances where displacements of neighbouring contacts correlate, for they are
    taken as independent: that of a mean in a first-order autoregressive sequence."""
    if correlation <= MAX_CORRELATION:
        return 1.0
    return (1 + correlation) / (1 - min(correlation, LARGEST_CORRELATION))


def neighbour_correlation(effects: RandomEffects) -> float:
    """Correlation of the displacements of contacts with those of their nearest neighbours.

    Errors of a kinematic model or of the clocks change slowly over the body or the path; scatter
    does not.
    """
    used = np.flatnonzero(effects.probes.touched)
    if len(used) < MIN_CONTACTS or effects.deviations.position <= FLOOR["position"]:
        return 0.0
    errors, points = effects.unknowns.errors[used, :2], effects.data.points[used]
    moved = np.einsum("mac,ma->mc", _tangents(effects)[used], errors)
    first, second = cKDTree(points).query(points, k=2)[1].T
    nearest = np.where(first == np.arange(len(points)), second, first)  # contacts may coincide
    power = float(np.sum(moved**2))
    return float(np.sum(moved * moved[nearest])) / power if power > 0 else 0.0


def alike_errors(effects: RandomEffects, covariances: Array) -> AlikeErrors:
    """What fields of errors, correlated over `LENGTH`, add to the variances of the taxels, whose
    covariances (n, 2, 2), m^2, are those of independent errors."""
    if int(effects.probes.touched.sum()) < MIN_CONTACTS:
        return AlikeErrors()
    correlograms = _Correlograms(effects, covariances)
    seen = correlograms.of(effects.unknowns.errors[..., None])[:, 0]
    mean, deviation, added = correlograms.drawn()
    at_zero = np.repeat(seen[:: RINGS + 1], RINGS + 1)
    believed = np.array([*correlograms.believed, 0.0, 0.0])
    weight, white = believed, slice(len(KINDS) + 1)
    for _ in range(3):  # the sampling errors depend on the weights, but little
        sigma = np.sqrt(deviation**2 @ weight**2 + (MODEL_ERROR * at_zero) ** 2 + 1e-20)
        weight, misfit = nnls(mean / sigma[:, None], seen / sigma)
    if nnls(mean[:, white] / sigma[:, None], seen / sigma)[1] ** 2 - misfit**2 < MIN_GAIN:
        return AlikeErrors()
    factor = 1.0 + float((weight - believed) @ added)
    return AlikeErrors(max(factor, 1.0), tuple(map(float, (weight * added)[len(KINDS) + 1 :])))


def _tangents(effects: RandomEffects) -> Array:
    """Unit tangents (m, 2, 3) along which the contacts' displacements are stated."""
    contacts = effects.linearized.at(effects.unknowns.s)
    return np.stack([contacts.directions, np.cross(contacts.normals, contacts.directions)], axis=1)


class _Correlograms:
    """Correlograms of the contacts' errors."""

    def __init__(self, effects: RandomEffects, covariances: Array) -> None:
        self.effects, self.covariances, d = effects, covariances, effects.deviations
        self.used = np.flatnonzero(effects.probes.touched)
        points, reach = effects.data.points, float(np.median(effects.data.reach()[self.used]))
        self.length, self.rng = LENGTH * reach, np.random.default_rng(0)
        self.units = max(d.position, 0.01 * reach), max(d.force, FORCE_UNIT)
        self.believed = 1.0, (d.position / self.units[0]) ** 2, (d.force / self.units[1]) ** 2
        """Variances that noise and errors are believed to have, in those of the drawn ones."""
        self.rings = _rings(points[self.used], FAR * reach)
        self.tangents = _tangents(effects)

    def of(self, errors: Array) -> Array:
        """The correlograms (2 (RINGS + 1), c) of contact errors (m, 3, c)."""
        moved = np.einsum("maj,mac->mjc", self.tangents, errors[:, :2])[self.used] / self.units[0]
        force = errors[self.used, 2] / self.units[1]
        points = sum(_products(self.rings, moved[:, j]) for j in range(3))
        return np.concatenate([points, _products(self.rings, force - force.mean(axis=0))])

    def drawn(self) -> tuple[Array, Array, Array]:
        """Of what the estimate finds of unit errors: noise of the readings, white errors of each of
        KINDS, and fields of them: mean and standard deviation (., 5) of the correlograms, and the
        mean square (5,) of what they displace a taxel by, in its standard deviations."""
        fitted, system = self.effects.fitted(), self.effects.system()
        points, contact = self.effects.data.points, fitted.readings.contact
        right, count = [], self.effects.probes.count
        for kind, length in ((None, 0.0), (0, 0.0), (1, 0.0), (0, self.length), (1, self.length)):
            if kind is None:
                off = self._field(contact, 0.0) * self.effects.spread[:, None]
            elif kind == 0:
                moved = np.stack([self._field(points, length) for _ in range(3)], axis=1)
                moved = self.units[0] * np.einsum("maj,mjc->mac", self.tangents, moved)
                off = np.einsum("ka,kac->kc", fitted.jacobian[:, -3:-1], moved[contact])
            else:
                off = self.units[1] * self._field(points, length)[contact]
                off *= fitted.jacobian[:, -1:]
            right.append(system.transposed(fitted.jacobian, fitted.curvature[:, None] * off))
        x = system.solve(*(np.concatenate(parts, axis=-1) for parts in zip(*right, strict=True)))
        found = self.of(x[1]).reshape(-1, len(right), count)
        places, information = x[0][:, :2], np.linalg.inv(self.covariances)
        square = np.einsum("nic,nij,njc->c", places, information, places)
        square = square.reshape(-1, count).sum(axis=1) / (2 * len(places) * count)
        return found.mean(axis=2), found.std(axis=2, ddof=1), square

    def _field(self, points: Array, length: float) -> Array:
        """Fields (m, c) of variance 1 at points (m, 3), m, correlated over `length`, m, or white
        ones."""
        count = self.effects.probes.count
        if not length:
            return self.rng.normal(size=(len(points), count))
        waves = self.rng.normal(size=(count, WAVES, 3)) / length
        phases = self.rng.uniform(0, 2 * np.pi, size=(count, WAVES))
        sums = [np.cos(points @ w.T + p).sum(axis=1) for w, p in zip(waves, phases, strict=True)]
        return np.stack(sums, axis=1) * np.sqrt(2 / WAVES)


def _rings(points: Array, far: float) -> list[sparse.csr_array]:
    """Matrices (n, n) whose forms are the mean products over pairs of points in each ring."""
    tree, count = cKDTree(points), len(points)
    centres = np.arange(count)[:: max(count // CENTRES, 1)]
    near = tree.query_ball_point(points[centres], far)
    first = np.repeat(centres, [len(rows) for rows in near])
    second = np.concatenate([np.asarray(rows, dtype=int) for rows in near])
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    ring = np.minimum((RINGS * distance / far).astype(int), RINGS - 1) + 1
    ring[first == second] = 0
    found = []
    for k in range(RINGS + 1):
        pair = first[ring == k], second[ring == k]
        mean = np.full(len(pair[0]), 1 / max(len(pair[0]), 1))
        found.append(sparse.csr_array((mean, pair), shape=(count, count)))
    return found


def _products(rings: list[sparse.csr_array], values: Array) -> Array:
    """Mean products (RINGS + 1, c) of values (n, c) over the pairs of each ring."""
    return np.array([np.sum(values * (ring @ values), axis=0) for ring in rings])
