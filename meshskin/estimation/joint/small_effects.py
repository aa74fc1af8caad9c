"""Many small errors of the readings that no single parameter describes, as random effects.

An estimate that leaves them out is wrong where they pass for displacements of the taxels: its
residuals hardly show that. To first order the logarithm of the likelihood of the effects x is
slope x - x information x / 2 with all other unknowns at their best. In some of the blocks of
effects they are normal with one variance, in the others zero; variance and number of blocks are
those of the largest marginal likelihood, which near zero is that of the estimate without them.
Their mean given the readings tells how far the taxels move, and their covariance how well this is
known.

Sources: Robinson, "That BLUP is a good thing: the estimation of random effects", Statistical
Science 6 (1991); Mitchell, Beauchamp, "Bayesian variable selection in linear regression", Journal
of the American Statistical Association 83 (1988).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array

if TYPE_CHECKING:
    from .departures import FittedReadings

DEVIATIONS = np.geomspace(1e-3, 0.3, 25)
"""Standard deviations of the effects that are tried, shares of a reading: less displaces no taxel
by a tenth of its standard deviation, more is not small. Neighbours differ by a factor of 1.27:
between them the marginal likelihood is flat."""
PARTS = 15
"""Numbers of blocks with effects that are tried, from half a block to all."""

LEAST_SHARED = 4.0
"""Score, in standard deviations, from which effects that all taxels share move these: of lags, 0 to
2.2 in 92 recordings without lags, of 35 worlds; 4.3 to 9.8 with lags."""
SINGULAR = 1e-9
"""Information, relative to the largest of its block, up to which there is none: by rounding."""


@dataclass(frozen=True)
class SmallEffects:
    """What small errors displace the taxels by."""

    score: float
    """In standard deviations: the root of twice the gain in the logarithm of the likelihood."""
    displacements: Array
    """(n, 2), m, of the taxels along their tangents, by errors that the estimate lacks."""
    covariances: Array
    """(n, 2, 2), m^2, of these."""

    def held(self) -> SmallEffects:
        """These where it is not certain that they are what displaces the taxels: the taxels stay,
        and the squares of their displacements count in the covariances."""
        square = self.displacements[:, :, None] * self.displacements[:, None]
        return SmallEffects(
            self.score, np.zeros_like(self.displacements), self.covariances + square
        )

    @classmethod
    def none(cls, count: int, score: float = 0.0) -> SmallEffects:
        """None of `count` taxels."""
        return cls(score, np.zeros((count, 2)), np.zeros((count, 2, 2)))


def shared_effects(
    fitted: FittedReadings, columns: Array, slope: Array, information: Array
) -> SmallEffects:
    """Effects that all taxels share, with the derivatives `columns` (k, q) of the readings, and the
    slope (q,) and information (q, q) of the logarithm of the likelihood; none up to
    LEAST_SHARED."""
    score, mean, covariance = most_likely(slope[None], information[None])
    if score < LEAST_SHARED:
        return SmallEffects.none(len(fitted.points), score)
    moved = fitted.displaced(columns)
    across = moved @ covariance[0] @ np.swapaxes(moved, 1, 2)
    return SmallEffects(score, moved @ mean[0], across)


def most_likely(slope: Array, information: Array) -> tuple[float, Array, Array]:
    """Score of normal effects of the most likely variance in some of b blocks, and their mean
    (b, q) and covariance (b, q, q) given the readings; slope (b, q) and information (b, q, q): of
    the logarithm of the likelihood at zero."""
    value, vectors = np.linalg.eigh(information)
    seen = value > SINGULAR * value.max(axis=1, initial=0.0, keepdims=True)
    value = np.where(seen, value, 0.0)
    along = np.where(seen, np.einsum("bqe,bq->be", vectors, slope), 0.0)
    variance = DEVIATIONS[:, None, None] ** 2
    narrower = 1 / (1 + variance * value)
    gain = np.sum(variance * narrower * along**2 + np.log(narrower), axis=2) / 2
    part = np.geomspace(0.5 / len(slope), 1 - 1e-9, PARTS)[:, None, None]
    total = np.logaddexp(np.log1p(-part), np.log(part) + gain)
    best, at = np.unravel_index(np.argmax(total.sum(axis=2)), total.shape[:2])
    has = np.exp(np.log(part[best, 0]) + gain[at] - total[best, at])
    scaled = vectors * (variance * narrower)[at][:, None]
    mean, within = np.einsum("bqe,be->bq", scaled, along), scaled @ np.swapaxes(vectors, 1, 2)
    between = (has * (1 - has))[:, None, None] * mean[:, :, None] * mean[:, None]
    score = (2 * max(float(total[best, at].sum()), 0.0)) ** 0.5
    return score, has[:, None] * mean, has[:, None, None] * within + between
