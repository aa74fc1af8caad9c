"""Places of taxels by the readings that were left out as outlying.

Accidents fit no place. Where the outlying readings of many taxels fit one each, contacts, times or
ids were others in a part of the recording: taxels that were touched in both parts fit one of them
and lose the readings of the other, and those that were touched in one part have no outlying reading
and may be as far off. No reading shows which part is right.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...core.arrays import Array, means_by_group
from ..chart import tangential_square
from .fault_detection import CUTOFF, outliers
from .joint_estimator import JointEstimator
from .jump import DisplacedResiduals
from .parametrization import SurfaceParametrization
from .pressure import OBSERVED

LEAST_READINGS, EXPLAINED = 6, 0.75
"""Outlying readings of a taxel, at least, that are a second place, and the part of their squares,
each cut at CUTOFF, that it explains: what is left is 2.2 standard deviations, rms, at most."""
MIN_TAXELS, MIN_PART = 3, 0.5
"""Taxels with a second place, at least, and their part of those with LEAST_READINGS outlying ones,
from which they count for all: two that exchange their ids are at fault by themselves."""
ALONE = 0.25
"""Outlying part of a taxel's readings from which its own second place is in its covariance where
few taxels have one: its other readings do not tell which is right."""
MAX_TAXELS = 100
"""Taxels, evenly chosen, whose outlying readings are fitted: their mean square is then known to
about 10 %."""


@dataclass(frozen=True)
class SecondFits:
    """Second places of taxels by their outlying readings."""

    covariances: Array
    """What second places add to the tangential covariances (n, 2, 2), m^2."""
    departure: dict[str, float] = field(default_factory=dict)
    """Their score, by a name that says how many there are; empty where they are few."""


def second_fits(estimator: JointEstimator) -> SecondFits:
    """The second places of the taxels of an estimate; none for rigid modules, whose taxels fit
    together."""
    parametrization, readings = estimator.problem.parametrization, estimator.likelihood.readings
    n = len(estimator.live)
    apart, gains = np.zeros((n, 3)), np.zeros(n)
    out = (readings.kind == OBSERVED) & outliers(readings)
    many = np.flatnonzero(np.bincount(readings.taxel[out], minlength=n) >= LEAST_READINGS)
    if not isinstance(parametrization, SurfaceParametrization) or not len(many):
        return SecondFits(np.zeros((n, 2, 2)))
    where = estimator.contacts.data.points[readings.contact]
    weight = np.where(out, np.maximum(readings.level, 0.0) ** 2, 0.0)
    middles = means_by_group(where, readings.taxel, n, weight) - parametrization.points()
    chosen = many[:: -(-len(many) // MAX_TAXELS)]
    for taxel in chosen:
        rows = np.flatnonzero(out & (readings.taxel == taxel))
        residuals = DisplacedResiduals(estimator, rows, np.ones(len(rows)))
        starts = (np.zeros(3), np.nan_to_num(middles[taxel]))
        places = np.stack([np.zeros(3), *(residuals.least(start) for start in starts)])
        square = [np.sum(np.minimum(residuals.at(x)[0] ** 2, CUTOFF**2)) for x in places]
        best = int(np.argmin(square))
        if square[best] < (1 - EXPLAINED) * square[0]:
            apart[taxel], gains[taxel] = places[best], square[0] - square[best]
    tangents = parametrization.rotations()[:, :, :2]
    own, found = tangential_square(tangents, apart), gains > 0
    if found.sum() < max(MIN_TAXELS, MIN_PART * len(chosen)):
        read = np.bincount(readings.taxel[readings.kind == OBSERVED], minlength=n)
        often = np.bincount(readings.taxel[out], minlength=n) >= ALONE * read
        return SecondFits(own * (found & often)[:, None, None])
    size = np.linalg.norm(apart[found], axis=1)
    words = (
        f"a second place of {found.sum()} of the {len(chosen)} taxels with many outlying readings, "
        f"{1e3 * np.median(size):.2g} mm away, by these: contacts, times or ids are others in a "
        "part of the recording"
    )
    pooled = float(np.mean(size**2)) / 2 * np.eye(2)
    return SecondFits(
        np.where(found[:, None, None], own, pooled), {words: float(gains.sum()) ** 0.5}
    )
