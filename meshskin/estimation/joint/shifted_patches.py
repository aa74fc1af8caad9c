"""Patches that the shape of the body displaces from the contact points, in the covariances.

Where the curvature of the body changes within a patch, as beside a fillet, the pressure leans to
the flatter side. Taxels there are displaced alike, so that residuals hardly show it. How far is
known from the body but for a factor: about 1 of a foundation of springs as wide as believed, less
of a deep layer, more of a softer one, and 0 of a patch about the contact point. The estimate is not
moved: the mean square of the displacements given the readings counts in the covariances.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import expit, logit

from ..data.patch_shape import patch_shifts
from .departures import FittedReadings
from .small_effects import SmallEffects

SHIFTED = "patches displaced where the curvature of the body changes, held to first order"
SHIFTS = 0.2
"""Probability, before the readings, that the factor is not zero; its variance is then 1."""


def shifted_patches(fitted: FittedReadings) -> SmallEffects:
    """What patches displaced by the shape of the body add to the tangential covariances; the taxels
    stay."""
    data, n = fitted.data, len(fitted.points)
    hit = replace(
        data.body.closest(data.points), curvature=data.curvature, direction=data.directions
    )
    shift = patch_shifts(data.belief, hit, data.radii)
    column = fitted.moved(shift[:, :, None])
    if not column.any():
        return SmallEffects.none(n)
    slope, information = (float(x.squeeze()) for x in fitted.shared(column))
    variance = 1 / (1 + information)
    mean = variance * slope
    evidence = (mean * slope + np.log(variance)) / 2
    square = float(expit(evidence + logit(SHIFTS))) * (variance + mean**2)
    moved = fitted.displaced(column)[:, :, 0]
    covariances = square * moved[:, :, None] * moved[:, None]
    return SmallEffects(max(2 * evidence, 0.0) ** 0.5, np.zeros((n, 2)), covariances)
