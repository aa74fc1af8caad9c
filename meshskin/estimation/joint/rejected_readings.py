"""How far readings that were left out as outlying would displace their taxels, and the second
places that they show.

Accidents strike all taxels alike. Where single taxels have many of the outlying readings, these are
rather what the model lacks, as crosstalk of one pair of taxels, and to leave them out moves the
taxel so that the others fit: their residuals no longer show it. The estimate with these readings,
as Huber would weigh them, differs from that without by about the error, which is how Hausman tests
a model. The square of the difference counts in the covariances.

Source: Hausman, "Specification tests in econometrics", Econometrica 46 (1978).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import pdtrc

from ...core.arrays import Array, means_by_group
from ..chart import tangential_square
from ..data.pairs import near_pairs
from .departures import FittedReadings
from .fault_detection import CUTOFF, outliers
from .joint_estimator import JointEstimator
from .jump import DisplacedResiduals
from .parametrization import SurfaceParametrization
from .pressure import CENSORED, OBSERVED

CHANCE = 0.01
"""Probability, by the fraction of outlying readings of all taxels, of as many as a taxel has, below
which they are not accidents: where accidents are independent, one taxel in 100 is wider."""
HUBER = 4.0
"""Residual, in standard deviations, from which the cost of a reading with a learned response grows
linearly, and to which that of an outlying one is cut: 6e-5 of the sound ones exceed it."""
LEAST_READINGS, LEAST_PART, EXPLAINED = 6, 0.15, 0.75
"""Outlying readings of a taxel, at least, that are a second place, and their part of its readings:
beside fillets, which a learned response knows less, a few in a hundred are. And the part of their
squares, each cut at CUTOFF, that it explains: what is left is 2.2 standard deviations, rms."""
MIN_TAXELS, MIN_PART = 3, 0.5
"""Taxels with a second place, at least, and their part of those with LEAST_READINGS outlying ones,
from which they count for all: two that exchange their ids are at fault by themselves."""
PRESSED, MAJORITY = 0.8, 2.0
"""Distance, in reaches of a contact, up to which it presses a taxel: there a point reads 0.6 of the
peak by Hertz. And the excess over half, in standard deviations by chance, of the part of these
contacts that a taxel answers, above which its place is its own whatever its outlying readings
say."""
MAX_TAXELS = 100
"""Taxels, evenly chosen, whose outlying readings are fitted: their mean square is then known to
about 10 %."""


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


@dataclass(frozen=True)
class SecondFits:
    """Second places of taxels by their outlying readings."""

    covariances: Array
    """What second places add to the tangential covariances (n, 2, 2), m^2."""
    departure: dict[str, float] = field(default_factory=dict)
    """Their score, by a name that says how many there are; empty where they are few."""


def second_fits(estimator: JointEstimator) -> SecondFits:
    """The second places of the taxels of an estimate; none for rigid modules, whose taxels fit
    together.

    Accidents fit no place. Where the outlying readings of many taxels fit one each, contacts, times
    or ids were others in a part of the recording: taxels that were touched in both parts fit one of
    them and lose the readings of the other, and those that were touched in one part have no
    outlying reading and may be as far off. No reading shows which part is right.
    """
    parametrization, readings = estimator.problem.parametrization, estimator.likelihood.readings
    n = len(estimator.live)
    apart, gains = np.zeros((n, 3)), np.zeros(n)
    out = (readings.kind == OBSERVED) & outliers(readings)
    read, left_out = (
        np.bincount(readings.taxel[rows], minlength=n) for rows in (readings.kind == OBSERVED, out)
    )
    many = np.flatnonzero(left_out >= np.maximum(LEAST_READINGS, LEAST_PART * read))
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
        doubtful = found & ~_confirmed(estimator, ~out & (readings.kind != CENSORED))
        return SecondFits(own * doubtful[:, None, None])
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


def _confirmed(estimator: JointEstimator, sound: np.ndarray) -> np.ndarray:
    """Whether (n,) a taxel answers most contacts that press it where it is placed; sound (k,) bool:
    the readings that are answers."""
    data, readings = estimator.contacts.data, estimator.likelihood.readings
    places, n = estimator.problem.parametrization, len(estimator.live)
    normals = places.rotations()[:, :, 2]
    contact, own = near_pairs(data, places.points(), normals, PRESSED * data.reach())
    answered = np.isin(contact * n + own, (readings.contact * n + readings.taxel)[sound])
    pressed, answers = np.bincount(own, minlength=n), np.bincount(own[answered], minlength=n)
    return np.asarray(answers - pressed / 2 > MAJORITY * np.sqrt(pressed) / 2)
