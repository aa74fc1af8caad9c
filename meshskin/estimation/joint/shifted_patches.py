"""Patches that the shape of the body displaces from the contact points, in the covariances.

Where the curvature of the body changes within a patch, as beside a fillet, the pressure leans to
the flatter side. Taxels there are displaced alike, so that residuals hardly show it. How far is
known from the body but for a factor: about 1 of a foundation of springs as wide as believed, less
of a deep layer, more of a softer one, and 0 of a patch about the contact point. The estimate is not
moved: the mean square of the displacements given the readings counts in the covariances.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit, logit

from .departures import FittedReadings
from .held_lags import of_single_taxels
from .small_effects import SmallEffects

SHIFTED = "patches displaced where the curvature of the body changes, held to first order"
SHIFTS = 0.2
"""Probability, before the readings, that the factor is not zero; its variance is then 1."""

MODEL_ERROR = 0.5
"""Error of the displacements by springs, relative to them, where the factor is estimated: 0.42 to
0.58 (rms of the contacts) from those of Drake's hydroelastic contact on a robot's forearm, with the
factor that was estimated, in three recordings."""


def shifted_patches(fitted: FittedReadings, factor: float = 0.0) -> SmallEffects:
    """What patches displaced by the shape of the body add to the tangential covariances; the taxels
    stay.

    factor: where it is estimated with the taxels; what a foundation of springs gets wrong is left.
    """
    data, n = fitted.data, len(fitted.points)
    column = fitted.moved(data.patch_shifts[:, :, None])
    if not column.any():
        return SmallEffects.none(n)
    if factor:
        moved = MODEL_ERROR * factor * of_single_taxels(fitted).displaced(column)[:, :, 0]
        return SmallEffects(0.0, np.zeros((n, 2)), moved[:, :, None] * moved[:, None])
    slope, information = (float(x.squeeze()) for x in fitted.shared(column))
    variance = 1 / (1 + information)
    mean = variance * slope
    evidence = (mean * slope + np.log(variance)) / 2
    square = float(expit(evidence + logit(SHIFTS))) * (variance + mean**2)
    moved = fitted.displaced(column)[:, :, 0]
    covariances = square * moved[:, :, None] * moved[:, None]
    return SmallEffects(max(2 * evidence, 0.0) ** 0.5, np.zeros((n, 2)), covariances)
