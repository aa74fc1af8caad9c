"""Displacements of the contact points that change smoothly over the body.

A taxel moves with the contact points around it, so that a displacement shows in the readings only
where it changes within the reach of a contact: one taxel's readings tell little, those of all
taxels together do. The displacements are Gaussian random fields over the body, sums of cosines;
their variance is that of the largest restricted likelihood, with all other unknowns estimated.

Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal",
Biometrika 58 (1971); Rahimi and Recht, "Random features for large-scale kernel machines" (2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from .departures import FittedReadings
from .residual_correlations import LEAST_SCORE

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
    """The most likely field of displacements of the contact points."""
    data, k = fitted.data, max(len(fitted.mu), 1)
    rng, reach = np.random.default_rng(0), float(np.median(data.reach()))
    waves = int(np.clip(VALUES // k, MIN_WAVES, MAX_WAVES))
    best, chosen = ContactFields(0.0, 0.0, 0.0, np.zeros((len(fitted.points), 2, 2))), None
    for length in LENGTHS:
        number = rng.normal(size=(3, waves)) / (length * reach)
        phase = rng.uniform(0, 2 * np.pi, waves)
        shape = UNIT * reach * np.sqrt(2 / waves) * np.cos(data.points @ number + phase)
        columns = fitted.moved(shape[:, None, :] * rng.normal(size=(3, waves)))
        score, ratio = _most_likely(fitted, columns)
        if score > best.score:
            deviation = UNIT * reach * ratio
            best = ContactFields(score, length * reach, deviation, best.covariances)
            chosen = columns * ratio
    if chosen is None or best.score <= LEAST_SCORE:
        return best
    moved = fitted.displaced(chosen)
    covariances = np.einsum("niq,njq->nij", moved, moved)
    return ContactFields(best.score, best.length, best.deviation, covariances)


def _most_likely(fitted: FittedReadings, columns: Array) -> tuple[float, float]:
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
