"""Errors that neighbouring contacts share, in an estimate with a learned response.

The estimate takes displacements and force errors of the contacts and the noise of the readings as
independent. Where those of neighbouring contacts are alike, many contacts tell less than they seem
to: over the facets of a mesh, or where the stiffness of a skin or the shape of patches varies over
the body. How much less follows from variance components, by the method of moments: correlograms of
what the estimate has found are compared with those that it would find of white errors and of random
fields over the body, which are drawn and estimated by the same normal equations.

Source: Cressie, "Statistics for Spatial Data" (1993), 2.4 and 2.6; Rahimi and Recht, "Random
features for large-scale kernel machines" (2007), for the fields.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ...core.arrays import Array
from .deviations import FLOOR
from .random_effects import RandomEffects

MAX_CORRELATION, LARGEST_CORRELATION = 0.4, 0.95
"""Correlation of the displacements of neighbouring contacts above which they are not scatter:
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
"""Contacts, and readings, about, whose neighbours are compared: more change little."""
WAVES = 32
"""Cosines of a field: its sums over a correlogram are those of a Gaussian one to a few percent."""
MODEL_ERROR = 0.03
"""Error of a correlogram of Gaussian fields, relative to its value at distance zero: no field of
the world has exactly their correlations."""
MIN_GAIN = 20.0
"""Decrease of the misfit of the correlograms, as chi-square, from which fields are not chance: at
most 12 in 20 recordings of worlds without any, and 25 or more in 8 of raw meshes (the bodies of
tests/estimation/joint/test_raw_meshes.py with four seeds)."""
FORCE_UNIT = 0.02
"""Deviation of ln force of the drawn force errors, at least: with less, an estimate that finds
none would take other errors for a great many of them."""
KINDS = ("contact points", "forces", "readings")
"""What errs, in the order of the correlograms."""


Rings = tuple[np.ndarray, np.ndarray, sparse.csr_array]
"""First and second points (p,) of pairs, and the matrix (RINGS + 1, p) of means over each ring."""


@dataclass(frozen=True)
class AlikeErrors:
    """Errors that neighbouring contacts share."""

    factor: float = 1.0
    """Factor of the taxels' variances by them."""
    parts: tuple[float, ...] = (0.0, 0.0, 0.0)
    """What fields of each of KINDS have in it."""


def fewer_contacts(correlation: float) -> float:
    """Factor of the variances where displacements of neighbouring contacts correlate, for they are
    taken as independent: that of a mean in a first-order autoregressive sequence."""
    if correlation <= MAX_CORRELATION:
        return 1.0
    return (1 + correlation) / (1 - min(correlation, LARGEST_CORRELATION))


def force_scatter(effects: RandomEffects) -> float:
    """Standard deviation of ln F of the contacts: that of the estimate, or that of the errors that
    it finds where the forces were not measured."""
    if effects.data.force_measured:
        return effects.deviations.force
    return float(np.sqrt(np.mean(effects.unknowns.errors[effects.probes.touched, 2] ** 2)))


def neighbour_correlation(effects: RandomEffects) -> float:
    """Correlation of the displacements of contacts with those of their nearest neighbours.

    Errors of a kinematic model or of the clocks change slowly over the body or the path; scatter
    does not.
    """
    used = np.flatnonzero(effects.probes.touched)
    if len(used) < MIN_CONTACTS or effects.deviations.position <= FLOOR["position"]:
        return 0.0
    errors, points = effects.unknowns.errors[used, :2], effects.data.points[used]
    moved = np.einsum("mac,ma->mc", tangents(effects)[used], errors)
    first, second = cKDTree(points).query(points, k=2)[1].T
    nearest = np.where(first == np.arange(len(points)), second, first)  # contacts may coincide
    power = float(np.sum(moved**2))
    return float(np.sum(moved * moved[nearest])) / power if power > 0 else 0.0


def alike_errors(effects: RandomEffects, covariances: Array) -> AlikeErrors:
    """What fields of errors, correlated over `LENGTH`, add to the variances of the taxels, whose
    covariances (n, 2, 2), m^2, are those of independent errors."""
    if int(effects.probes.touched.sum()) < MIN_CONTACTS:
        return AlikeErrors()
    if not effects.clear().any():
        return AlikeErrors()
    from scipy.optimize import nnls  # imports slowly

    correlograms = _Correlograms(effects, covariances)
    seen = correlograms.of(effects.unknowns.errors[..., None], effects.residuals()[:, None])[:, 0]
    mean, deviation, added = correlograms.drawn()
    at_zero = np.repeat(seen[:: RINGS + 1], RINGS + 1)
    believed = np.array([*correlograms.believed, 0.0, 0.0, 0.0])
    weight = believed
    for _ in range(3):  # the sampling errors depend on the weights, but little
        sigma = np.sqrt(deviation**2 @ weight**2 + (MODEL_ERROR * at_zero) ** 2 + 1e-20)
        if not effects.data.force_measured:  # they follow a stroke, like no field
            sigma[RINGS + 1 : 2 * (RINGS + 1)] = np.inf
        weight, misfit = nnls(mean / sigma[:, None], seen / sigma)
    white = nnls(mean[:, :3] / sigma[:, None], seen / sigma)[1]
    if white**2 - misfit**2 < MIN_GAIN:
        return AlikeErrors()
    parts = (weight * added)[3:]
    factor = 1.0 + float((weight - believed) @ added)
    return AlikeErrors(max(factor, 1.0), tuple(map(float, parts)))


def tangents(effects: RandomEffects) -> Array:
    """Unit tangents (m, 2, 3) along which the contacts' displacements are stated."""
    contacts = effects.linearized.at(effects.unknowns.s)
    return np.stack([contacts.directions, np.cross(contacts.normals, contacts.directions)], axis=1)


class _Correlograms:
    """Correlograms of the contacts' errors and of the residuals of single taxels."""

    def __init__(self, effects: RandomEffects, covariances: Array) -> None:
        self.effects, self.fitted, self.system = effects, effects.fitted(), effects.system()
        self.information = np.linalg.inv(covariances)
        data, readings, d = effects.data, effects.readings, effects.deviations
        self.used, self.count = np.flatnonzero(effects.probes.touched), effects.probes.count
        self.clear = np.flatnonzero(effects.clear())
        reach = float(np.median(data.reach()[self.used]))
        self.length, self.rng = LENGTH * reach, np.random.default_rng(0)
        force = force_scatter(effects)
        self.units = max(d.position, 0.01 * reach), max(force, FORCE_UNIT), 1.0
        self.believed = (d.position / self.units[0]) ** 2, (force / self.units[1]) ** 2, 1.0
        """Variances that the estimate finds the errors to have, in the drawn ones'."""
        far, own = FAR * reach, readings.taxel[self.clear]
        at = data.points[readings.contact[self.clear]]
        self.contacts = _rings(data.points[self.used], far)
        self.readings = _rings(np.column_stack([at, 10 * far * own]), far)
        self.tangents = tangents(effects)

    def of(self, errors: Array, residuals: Array) -> Array:
        """The correlograms (3 (RINGS + 1), c) of contact errors (m, 3, c) and residuals (k, c)."""
        moved = np.einsum("maj,mac->mjc", self.tangents, errors[:, :2])[self.used] / self.units[0]
        force = errors[self.used, 2] / self.units[1]
        points = sum(_products(self.contacts, moved[:, j]) for j in range(3))
        rest = _products(self.readings, residuals[self.clear])
        return np.concatenate([points, _products(self.contacts, force - force.mean(axis=0)), rest])

    def drawn(self) -> tuple[Array, Array, Array]:
        """Mean and standard deviation (3 (RINGS + 1), 6) of the correlograms of what the estimate
        finds of unit errors of each of KINDS, white ones, then fields; and the mean squares (6,) of
        what they displace a taxel by, in its stated standard deviations."""
        parts = zip(*(self._drawn(field) for field in (False, True)), strict=True)
        mean, deviation, square = (np.concatenate(part, axis=-1) for part in parts)
        return mean, deviation, square

    def _drawn(self, field: bool) -> tuple[Array, Array, Array]:
        """As `drawn`, of white errors or fields: those of all kinds are solved for together."""
        jacobian, system, weight = self.fitted.jacobian, self.system, self.fitted.curvature[:, None]
        off = np.concatenate([self._off(kind, field) for kind in range(len(KINDS))], axis=1)
        x = system.solve(*system.transposed(jacobian, weight * off))
        off -= system.forward(jacobian, x)
        off *= np.sqrt(weight)
        found = self.of(x[1], off).reshape(-1, len(KINDS), self.count)
        places = x[0][:, :2].reshape(len(x[0]), 2, -1, self.count)
        weighted = np.einsum("nij,njqc->niqc", self.information, places)
        square = np.einsum("niqc,niqc->q", places, weighted) / (2 * len(places) * self.count)
        return found.mean(axis=2), found.std(axis=2, ddof=1), square

    def _off(self, kind: int, field: bool) -> Array:
        """What unit errors of one of KINDS, white ones or fields, change the readings by (k, c)."""
        readings, jacobian = self.effects.readings, self.fitted.jacobian
        points, length = self.effects.data.points, self.length if field else 0.0
        if kind == 0:
            moved = np.stack([self._field(points, length) for _ in range(3)], axis=1)
            moved = self.units[0] * (self.tangents @ moved)
            off = jacobian[:, -3:-2] * moved[readings.contact, 0]
            return off + jacobian[:, -2:-1] * moved[readings.contact, 1]
        if kind == 1:
            force = self.units[1] * self._field(points, length)
            return np.asarray(jacobian[:, -1:] * force[readings.contact])
        off = self._field(points[readings.contact], length, readings.taxel)
        return np.asarray(off * self.effects.spread[:, None])

    def _field(self, points: Array, length: float, owner: np.ndarray | None = None) -> Array:
        """Fields (m, c) of variance 1 at points (m, 3), m, correlated over `length`, m, or white
        ones; a different one for each owner (m,)."""
        count = self.count
        if not length:
            return self.rng.normal(size=(len(points), count))
        if owner is None:
            owner = np.zeros(len(points), dtype=int)
        out = np.zeros((len(points), count))
        for c in range(count):
            for wave in self.rng.normal(size=(WAVES, 3)) / length:
                phase = self.rng.uniform(0, 2 * np.pi, int(owner.max(initial=0)) + 1)
                out[:, c] += np.cos(points @ wave + phase[owner])
        return out * np.sqrt(2 / WAVES)


def _rings(points: Array, far: float) -> Rings:
    """Pairs of points of which one is a centre, and means over those in each ring."""
    tree, count = cKDTree(points), len(points)
    centres = np.arange(count)[:: max(count // CENTRES, 1)]
    near = tree.query_ball_point(points[centres], far)
    first = np.repeat(centres, [len(rows) for rows in near])
    second = np.concatenate([np.asarray(rows, dtype=int) for rows in near])
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    ring = np.minimum((RINGS * distance / far).astype(int), RINGS - 1) + 1
    ring[first == second] = 0
    share = 1 / np.bincount(ring, minlength=RINGS + 1)[ring]
    place = ring, np.arange(len(ring))
    return first, second, sparse.csr_array((share, place), shape=(RINGS + 1, len(ring)))


def _products(rings: Rings, values: Array) -> Array:
    """Mean products (RINGS + 1, c) of values (n, c) over the pairs of each ring."""
    first, second, means = rings
    return np.stack([means @ (v[first] * v[second]) for v in values.T], axis=1)
