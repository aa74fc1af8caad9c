"""Errors that the readings of a taxel share at contacts near one another, in time or in place.

An estimate takes the errors of readings as independent. Offsets that wander, patches or taxels that
are not round, and crosstalk between taxels that are not neighbours make those of neighbouring
contacts alike, and its covariances too small: (J' J)^-1 J' V J (J' J)^-1 for errors of covariance
V. V is that of independent errors and of Gaussian processes, in the order of the contacts or in
their place relative to the taxel; their variances and length are those of the largest restricted
likelihood of the residuals. An error that is even in the place relative to the taxel, as of a
patch that is too wide, displaces no taxel: even and odd ones have variances of their own. Readings
over edges of the body are left out: what they share is in their variance already
(`patch_shape.alike_contacts`).

Displacements of the contact points that change smoothly over the body are such errors, too.

Sources: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal",
Biometrika 58 (1971); Rahimi and Recht, "Random features for large-scale kernel machines" (2007).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtrtrs

from ...core.arrays import Array
from ..result import SHARED_ERRORS
from .departures import FittedReadings
from .fault_detection import even
from .noise import clear_of_limits
from .pressure import OBSERVED

SPANS = (10.0, 100.0, 1000.0)
"""Lengths in time that are tried, in contacts."""
WIDTHS = (0.25, 0.5, 1.0)
"""Lengths in place that are tried, in reaches of a contact."""
MAX_TAXELS, SCORED, FITTED = 100, 400, 60
"""Taxels, and readings of each, evenly chosen, whose scores count, and of whose errors variances
are estimated: errors of the size of the noise have scores of 20 and more with so many."""
LEAST_SCORE = 4.0
"""Score, in standard deviations, from which covariances are widened: 2e-4 by chance, of six lengths
that are tried here; 1e-4 of the three LENGTHS."""
HELD_SCORE, MAX_WIDENING = 10.0, 1.3
"""Score, and factor of the standard deviations, below which they hold the errors: elliptic patches
of a foam that is learned on a cylinder have 7 to 9.6 and 1.2, and errors as stated; lines of a
matrix that crosstalk, where that is not estimated, 13 and 1.2, and errors twice as large."""
SPARE = 3
"""Least number of readings of a taxel beyond its own unknowns: fewer leave hardly any residuals."""
START, MAX_RATIO = 0.3, 100.0
"""First and largest variance of shared errors, relative to that of independent ones."""
Sample = tuple[np.ndarray, Array, Array, Array]
"""A taxel's contacts (q,), their places (q, 2), orthonormal vectors (q, D) of what its own unknowns
explain, and its residuals (q,)."""
Kernel = Callable[[Array, Array], tuple[Array, ...]]
"""(rows of the contacts (q,), their places (q, 2) relative to the taxel, reaches) -> covariances
(q, q) of shared errors, each with a variance of its own."""
LENGTHS = (0.5, 1.0, 2.0)
"""Lengths over which a field is correlated that are tried, in reaches of a contact."""
MIN_WAVES, MAX_WAVES, VALUES = 8, 128, 2_000_000
"""Cosines of a field: as many as have about VALUES derivatives of the readings, within limits."""
UNIT, LARGEST = 0.01, 100.0
"""Deviation of the fields that are compared, in reaches, and the largest one, in these: a reach."""
EXPLAINED = 1e-3
"""Part of a wave's information that other unknowns leave, below which it is not used: errors of the
linearization are of that size."""
STEPS = 60
"""Deviations that are compared, at equal ratios."""


@dataclass(frozen=True)
class SharedErrors:
    """The shared errors that make the residuals most likely."""

    score: float
    """In standard deviations of independent errors."""
    where: str
    """"in time" or "in place"."""
    kernels: tuple[tuple[Kernel, Array], ...] = ()
    """Kernels, and the variances of their covariances relative to that of the noise, weighted by
    the likelihoods of the kernels: few readings hardly tell the length."""

    @property
    def departure(self) -> dict[str, float]:
        """The score by the name of the departure."""
        return {SHARED_ERRORS.format(self.where): self.score}

    def beyond(self, added: Array, covariances: Array) -> dict[str, float]:
        """`departure` where the covariances (n, 2, 2) are doubtful with what was `added` (n, 2, 2)
        for it; empty where small errors are held by them."""
        total, part = (np.trace(c, axis1=1, axis2=2) for c in (covariances + added, added))
        widened = float(np.median(part / np.maximum(total, 1e-300)))
        held = self.score < HELD_SCORE and widened < 1 - MAX_WIDENING**-2
        return {} if held else self.departure

    def covariances(self, fitted: FittedReadings) -> Array:
        """What shared errors add to the tangential covariances (n, 2, 2), m^2."""
        found = np.zeros((len(fitted.points), 2, 2))
        if self.score <= LEAST_SCORE:
            return found
        for taxel, rows, own in _taxels(fitted, np.arange(len(found))):
            inverse = np.linalg.pinv(own.T @ own + np.diag(fitted.prior))[:2]
            part = even(fitted.readings)[rows]
            rows, gain = rows[part], inverse @ own[part].T
            at = fitted.readings.contact[rows], _places(fitted, taxel, rows)
            total = sum(np.tensordot(v, kernel(*at), 1) for kernel, v in self.kernels)
            found[taxel] = gain @ total @ gain.T
        return found


def shared_errors(fitted: FittedReadings) -> SharedErrors:
    """The most likely shared errors of the residuals; of score 0 where nothing is compared."""
    kernels = [("in time", _in_time(span)) for span in SPANS]
    kernels += [("in place", _in_place(width)) for width in WIDTHS]
    samples, _ = _samples(fitted, SCORED)
    if not samples:
        return SharedErrors(0.0, kernels[0][0])
    score = max(_score(samples, kernel) for _, kernel in kernels)
    if score <= LEAST_SCORE:
        return SharedErrors(score, kernels[0][0])
    samples, noise = _samples(fitted, FITTED)
    found = [_most_likely(samples, kernel) for _, kernel in kernels]
    cost = np.array([part[0] for part in found])
    odds = np.exp(cost.min() - cost) / np.sum(np.exp(cost.min() - cost))
    weighted = [
        (kernel, odd * noise**2 * part[1])
        for (_, kernel), odd, part in zip(kernels, odds, found, strict=True)
    ]
    return SharedErrors(score, kernels[int(np.argmin(cost))][0], tuple(weighted))


def larger(first: Array, second: Array) -> Array:
    """Of two covariances (n, 2, 2) of each taxel the larger one: displacements of the contacts show
    in the residuals, too, and are not counted twice."""
    traces = (np.trace(x, axis1=1, axis2=2) for x in (first, second))
    return np.asarray(np.where(np.greater(*traces)[:, None, None], first, second))


def _samples(fitted: FittedReadings, most: int) -> tuple[list[Sample], float]:
    """MAX_TAXELS taxels and at most `most` readings of each, residuals in units of their standard
    deviation, and this; none where there are no residuals."""
    chosen = np.sort(np.random.default_rng(0).permutation(len(fitted.points))[:MAX_TAXELS])
    residuals = -fitted.rate / np.sqrt(np.maximum(fitted.curvature, 1e-300))
    found = list[Sample]()
    for taxel, rows, own in _taxels(fitted, chosen):
        part = even(fitted.readings)[rows]
        rows, own = rows[part], own[part]
        used = np.unique(np.linspace(0, len(rows) - 1, most).astype(int))
        if len(used) < own.shape[1] + SPARE:
            continue
        explained = np.linalg.qr(own[used])[0]
        left = residuals[rows[used]] - explained @ (explained.T @ residuals[rows[used]])
        contact, places = fitted.readings.contact[rows[used]], _places(fitted, taxel, rows[used])
        found.append((contact, places, explained, left))
    square = sum(float(np.sum(left**2)) for *_, left in found)
    if not square:
        return [], 0.0
    noise = (square / sum(len(left) - basis.shape[1] for *_, basis, left in found)) ** 0.5
    return [(contact, place, basis, left / noise) for contact, place, basis, left in found], noise


def _taxels(fitted: FittedReadings, taxels: np.ndarray) -> Iterator[tuple[int, np.ndarray, Array]]:
    """Each taxel with the rows (q,) of its readings that count, in the order of time, and the
    derivatives (q, D) of these, in standard deviations, in its own unknowns."""
    readings = fitted.readings
    counts = (readings.kind == OBSERVED) & (readings.weight > 0.5) & (fitted.curvature > 0)
    noise = 1 / np.sqrt(np.maximum(fitted.curvature, 1e-300))
    counts &= clear_of_limits(fitted.mu, fitted.data, noise)  # others are chosen by their errors
    for taxel in taxels:
        rows = np.arange(*readings.starts[taxel : taxel + 2])
        rows = rows[counts[rows]]
        rows = rows[np.argsort(readings.contact[rows], kind="stable")]
        yield taxel, rows, (fitted.own[:, rows] * np.sqrt(fitted.curvature[rows])).T


def _places(fitted: FittedReadings, taxel: int, rows: np.ndarray) -> Array:
    """Contact points (q, 2) of the readings in the taxel's tangent plane, in reaches."""
    off = fitted.data.points[fitted.readings.contact[rows]] - fitted.points[taxel]
    return np.asarray(off @ fitted.tangents[taxel] / np.median(fitted.data.reach()))


def _in_time(span: float) -> Kernel:
    """Errors that correlate over `span` contacts."""

    def kernel(contact: Array, place: Array) -> tuple[Array, ...]:
        return (np.exp(-np.abs(contact[:, None] - contact) / span),)

    return kernel


def _in_place(width: float) -> Kernel:
    """Errors that correlate over `width` reaches, even and odd in the place."""

    def kernel(contact: Array, place: Array) -> tuple[Array, ...]:
        x, y = place.T
        near, mirrored = (
            np.exp(-((x[:, None] - s * x) ** 2 + (y[:, None] - s * y) ** 2) / (2 * width**2))
            for s in (1.0, -1.0)
        )
        return (near + mirrored) / 2, (near - mirrored) / 2

    return kernel


def _score(samples: list[Sample], kernel: Kernel) -> float:
    """Score of the kernel's correlations at a variance of zero, of all of them or of the last ones,
    which are odd in the place; its own variances, which noise has, too, do not count."""
    slope = np.zeros(len(kernel(*samples[0][:2])))
    information = np.zeros_like(slope)
    for contact, place, basis, left in samples:
        parts = kernel(contact, place)
        for k, covariance in enumerate((np.sum(parts, axis=0), parts[-1])[: len(parts)]):
            np.fill_diagonal(covariance, 0.0)
            seen = covariance @ basis  # what the projection on the residuals takes away
            both = basis.T @ seen
            slope[k] += left @ covariance @ left + np.trace(both)
            squares = (np.vdot(matrix, matrix) for matrix in (covariance, seen, both))
            information[k] += 2 * np.dot((1, -2, 1), list(squares))
    return float(np.max(slope / np.maximum(information, 1e-300) ** 0.5))


def _most_likely(samples: list[Sample], kernel: Kernel) -> tuple[float, Array]:
    """Negative logarithm of the largest restricted likelihood, and the variances there."""
    from scipy.optimize import minimize

    size = max(len(left) - basis.shape[1] for *_, basis, left in samples)
    parts = len(kernel(*samples[0][:2]))
    shared, residuals = np.zeros((parts, len(samples), size, size)), np.zeros((len(samples), size))
    count = 0
    for k, (contact, place, basis, left) in enumerate(samples):
        free = np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :]
        count += (q := free.shape[1])
        residuals[k, :q] = free.T @ left
        for part, matrix in enumerate(kernel(contact, place)):
            shared[part, k, :q, :q] = free.T @ matrix @ free

    def cost(log_ratio: Array) -> tuple[float, float]:
        ratio = np.exp(np.minimum(log_ratio, np.log(MAX_RATIO)))
        root = np.linalg.cholesky(np.eye(size) + np.tensordot(ratio, shared, 1))
        white = [dtrtrs(r.T, left, trans=1)[0] for r, left in zip(root, residuals, strict=True)]
        noise = float(np.sum(np.square(white))) / count
        volume = float(np.log(np.diagonal(root, axis1=1, axis2=2)).sum())
        return volume + count * np.log(noise) / 2, noise

    found = minimize(
        lambda x: cost(x)[0], np.full(parts, np.log(START)), method="Nelder-Mead",
        options={"xatol": 0.1, "fatol": 0.1},
    )  # fmt: skip
    ratio = np.exp(np.minimum(found.x, np.log(MAX_RATIO)))
    return float(found.fun), ratio * cost(found.x)[1]


@dataclass(frozen=True)
class ContactFields:
    """The field of displacements that makes the readings most likely."""

    score: float
    """In standard deviations: the root of twice the gain of the log-likelihood."""
    length: float
    """Over which it is correlated, m."""
    deviation: float
    """Of the displacements along each direction, m."""
    covariances: Array
    """What it adds to the tangential covariances (n, 2, 2), m^2; zero where it is not significant.
    """

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by a name that says how large the displacements are."""
        words = (
            f"contact points that are {1e3 * self.deviation:.2g} mm off, alike within "
            f"{1e3 * self.length:.2g} mm as by an error of the kinematic model or of the surface"
        )
        return {words: self.score}


def contact_fields(fitted: FittedReadings) -> ContactFields:
    """The most likely field of displacements of the contact points.

    A taxel moves with the contact points around it, so that a displacement shows in the readings
    only where it changes within the reach of a contact: one taxel's readings tell little, those of
    all taxels together do. The displacements are Gaussian random fields over the body, sums of
    cosines; their variance is that of the largest restricted likelihood, with all other unknowns
    estimated.
    """
    data, k = fitted.data, max(len(fitted.mu), 1)
    rng, reach = np.random.default_rng(0), float(np.median(data.reach()))
    waves = int(np.clip(VALUES // k, MIN_WAVES, MAX_WAVES))
    best, chosen = ContactFields(0.0, 0.0, 0.0, np.zeros((len(fitted.points), 2, 2))), None
    for length in LENGTHS:
        number = rng.normal(size=(3, waves)) / (length * reach)
        phase = rng.uniform(0, 2 * np.pi, waves)
        shape = UNIT * reach * np.sqrt(2 / waves) * np.cos(data.points @ number + phase)
        columns = fitted.moved(shape[:, None, :] * rng.normal(size=(3, waves)))
        score, ratio = _likeliest_field(fitted, columns)
        if score > best.score:
            deviation = UNIT * reach * ratio
            best = ContactFields(score, length * reach, deviation, best.covariances)
            chosen = columns * ratio
    if chosen is None or best.score <= LEAST_SCORE:
        return best
    moved = fitted.displaced(chosen)
    covariances = np.einsum("niq,njq->nij", moved, moved)
    return ContactFields(best.score, best.length, best.deviation, covariances)


def _likeliest_field(fitted: FittedReadings, columns: Array) -> tuple[float, float]:
    """Score and deviation of independent normal factors of the `columns` (k, q)."""
    slope, information = fitted.shared(columns)
    value, vectors = np.linalg.eigh(information)
    whole = float(np.mean(fitted.curvature @ columns**2))
    seen = value > EXPLAINED * whole
    if not seen.any():
        return 0.0, 0.0
    value, square = value[seen], (vectors.T @ slope)[seen] ** 2
    ratio = np.concatenate([[0.0], np.geomspace(1 / LARGEST, LARGEST, STEPS)])
    variance = 1 + ratio[:, None] ** 2 * value
    cost = np.sum(np.log(variance) + square / value / variance, axis=1) / 2
    least = int(np.argmin(cost))
    return float(np.sqrt(2 * (cost[0] - cost[least]))), float(ratio[least])
