"""The baseline: each taxel at the mean of the contact points that it responds to, on the surface.

Points are weighted by the readings, whatever their unit; no contact model is involved. The mean is
biased where contacts lie on one side of a taxel, and where readings linger far from it (offset,
drift, hysteresis). The stated covariance is that of a weighted mean of random points: contacts on a
regular path err less, biased ones more.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, sums_by_group
from . import chart
from .data.measurements import Measurements
from .result import SURFACE, EstimatorResult
from .trilateration.trilaterate import COLLINEAR, MIN_WIDTH, TOO_FEW, require_any

FACTORS = ("contact points, weighted by the readings; no contact model", SURFACE)
LEAST = 3
"""Readings of a taxel that give its mean a spread in two directions."""


def centroids(
    points: Array, taxel: np.ndarray, reading: Array, count: int
) -> tuple[Array, Array, Array]:
    """Weighted means of the contact points of `count` taxels.

    points (k, 3), m: contact point of each reading; taxel (k,): its row; reading (k,): the weight,
    of which negative ones count as zero. Returns the means (count, 3), m, not on the surface, the
    covariances (count, 3, 3), m^2, of the points about them, and those of the means; NaN where the
    weights of a taxel vanish or one reading has them all.
    """
    weight = np.maximum(reading, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = weight / np.bincount(taxel, weight, count)[taxel]
        mean = sums_by_group(share[:, None] * points, taxel, count)
        mean[np.bincount(taxel, weight, count) == 0] = np.nan
        off = points - mean[taxel]
        squares = off[:, :, None] * off[:, None, :]
        concentration = np.bincount(taxel, share**2, count)[:, None, None]
        spread = sums_by_group(share[:, None, None] * squares, taxel, count)
        spread = spread / (1 - concentration)
    return mean, spread, spread * concentration


def estimate(data: Measurements) -> EstimatorResult:
    """The centroid of each taxel with three readings whose contacts are not on a line.

    Raises CalibrationError if there is none.
    """
    n = len(data.ids)
    mean, spread, covariance = centroids(data.points[data.contact], data.taxel, data.pressure, n)
    reasons = np.where(data.counts < LEAST, TOO_FEW, "").astype(object)
    # a mean of no readings gets a place of its own until it is left out
    at = chart.charts_at(data.body, np.where(np.isfinite(mean), mean, data.points[0]))
    plane = np.einsum("nia,nij,njb->nab", at.tangents, spread, at.tangents)
    square = np.linalg.eigvalsh(np.where(np.isfinite(plane), plane, 0.0))
    narrow = ~(square[:, 0] > MIN_WIDTH**2 * square[:, 1])
    reasons[(reasons == "") & narrow] = COLLINEAR
    bad = reasons != ""
    stated = np.einsum("nia,nij,njb->nab", at.tangents, covariance, at.tangents)
    fit = EstimatorResult(
        points=np.where(bad[:, None], np.nan, at.points),
        rotations=at.rotations,
        covariance=np.where(bad[:, None, None], np.diag([np.inf, np.inf]), stated),
        chi2=np.full(n, np.nan),
        reasons=reasons,
        factors=FACTORS,
    )
    return require_any(fit)
