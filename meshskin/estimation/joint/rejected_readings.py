"""How far readings that were left out as outlying would displace their taxels.

Accidents strike all taxels alike. Where single taxels have many of the outlying readings, these are
rather what the model lacks, as crosstalk of one pair of taxels, and to leave them out moves the
taxel so that the others fit: their residuals no longer show it. The estimate with these readings,
as Huber would weigh them, differs from that without by about the error, which is how Hausman tests
a model. The square of the difference counts in the covariances.

Source: Hausman, "Specification tests in econometrics", Econometrica 46 (1978).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import pdtrc

from ...core.arrays import Array
from .departures import FittedReadings
from .fault_detection import outliers
from .pressure import OBSERVED

CHANCE = 0.01
"""Probability, by the fraction of outlying readings of all taxels, of as many as a taxel has, below
which they are not accidents: where accidents are independent, one taxel in 100 is wider."""
HUBER = 4.0
"""Residual, in standard deviations, from which the cost of a reading with a learned response grows
linearly, and to which that of an outlying one is cut: 6e-5 of the sound ones exceed it."""


def displacements(fitted: FittedReadings, weight: Array, spread: Array) -> Array:
    """Displacements (n, 2), m, of the taxels along their tangents by the readings that were left
    out; zeros where these are accidents. weight (k,): of the readings, as `fitted.curvature` of the
    others; spread (k,): their standard deviations."""
    readings, n = fitted.readings, len(fitted.points)
    read = readings.kind == OBSERVED
    out = read & outliers(readings)
    if not out.any():
        return np.zeros((n, 2))
    count, of = (np.bincount(readings.taxel[rows], minlength=n) for rows in (out, read))
    chance = np.where(count > 0, pdtrc(count - 1, of * out.sum() / read.sum()), 1.0)
    out &= chance[readings.taxel] < CHANCE
    off = readings.level / fitted.data.sigma - fitted.mu
    cut = np.where(out, np.clip(off, -HUBER * spread, HUBER * spread), 0.0)
    counted = replace(fitted, curvature=np.where(out, weight, fitted.curvature))
    return counted.displaced(cut[:, None])[:, :, 0]
