"""Lags of the readings behind the pressure, beyond those that the estimate has.

Covers and electronics relax with a distribution of time constants, and the loops of hysteresis are
those of a distribution of play operators. An estimate has one of each, and none where no single one
shows. A lag displaces the taxels along the motion of the contacts, which hardly shows in the
residuals: it shifts all taxels that are crossed in one direction alike. What is left of it is
therefore estimated at the end, to first order: creep with each of several time constants and play
of each of several widths (a Prony series and a Prandtl-Ishlinskii operator), of small shares that
are normal with one variance, that of the largest marginal likelihood. The taxels move by the mean
of the shares given the readings, and the covariance of the shares counts in theirs.

Sources: Visintin, Differential Models of Hysteresis (1994), section III.2; Robinson, "That BLUP is a
good thing: the estimation of random effects", Statistical Science 6 (1991).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..joint.departures import WIDTHS, FittedReadings
from ..joint.electronics import WIDTH, Electronics

SHARES = np.geomspace(1e-3, 0.3, 25)
"""Standard deviations of the shares that are tried: less displaces no taxel by a tenth of its
standard deviation, more is no small share. Neighbours differ by a factor of 1.27: the marginal
likelihood between them is flat."""
LEAST_SCORE = 4.0
"""Score, in standard deviations, from which taxels move: 3e-5 by chance."""
NAME = "lags of the readings beyond those that are estimated"
WORDS = (
    "lags of the readings with several time constants or widths, by what they displace the taxels"
)


@dataclass(frozen=True)
class Lags:
    """The most likely lags."""

    score: float
    """In standard deviations: the root of twice the gain in the logarithm of the likelihood."""
    displacements: Array
    """(n, 2), m, of the taxels along their tangents by lags that the estimate lacks; zeros below
    LEAST_SCORE."""
    covariances: Array
    """(n, 2, 2), m^2, of these."""

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by its name."""
        return {NAME: self.score}


def lags(fitted: FittedReadings) -> Lags:
    """The lags of the readings beyond those in `fitted`."""
    electronics = Electronics(fitted.data, fitted.readings, fitted.points)
    pressure = np.maximum(fitted.mu - fitted.offset, 0.0)
    halves = (np.full(len(pressure), width * WIDTH * electronics.peak) for width in WIDTHS)
    plays = [electronics.play(pressure, half)[0] - pressure for half in halves]
    columns = np.column_stack([fitted.creeps(electronics), *plays])
    gain, mean, covariance = _shares(*fitted.shared(columns))
    score, n = (2 * gain) ** 0.5, len(fitted.points)
    if score < LEAST_SCORE:
        return Lags(score, np.zeros((n, 2)), np.zeros((n, 2, 2)))
    moved = fitted.displaced(columns)
    return Lags(score, moved @ mean, moved @ covariance @ np.swapaxes(moved, 1, 2))


def _shares(slope: Array, information: Array) -> tuple[float, Array, Array]:
    """Gain in the logarithm of the marginal likelihood by normal shares (q,) of the most likely
    variance, and their mean (q,) and covariance (q, q) given the readings; slope (q,) and
    information (q, q): of the logarithm of the likelihood at zero."""
    value, vectors = np.linalg.eigh(information)
    value, along = np.maximum(value, 0.0), vectors.T @ slope
    variances = SHARES[:, None] ** 2
    narrower = 1 / (1 + variances * value)
    gains = np.sum(variances * narrower * along**2 + np.log(narrower), axis=1) / 2
    best = int(np.argmax(gains))
    covariance = (vectors * (variances * narrower)[best]) @ vectors.T
    return max(float(gains[best]), 0.0), covariance @ slope, covariance
