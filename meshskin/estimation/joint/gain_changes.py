"""Taxels whose gain changes in the course of a recording: at once, as of a contact that comes
loose.

One such taxel is displaced by its readings before and after: errors of the contacts, and costs that
grow linearly, hide what does not fit; where outlying readings are left out, those that remain may
be of both gains. It is tested by the score of a step of its gain, with its own unknowns estimated
beside it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...core.arrays import Array, sums_by_group
from .departures import FittedReadings
from .pressure import OBSERVED

GAIN_CHANGES = "its gain changes in the course of the recording"
"""Reason of a taxel that is not determined because its gain changes."""
PLACES = np.linspace(0.2, 0.8, 13)
"""Parts of a taxel's readings after which its gain may change."""
LEAST_SCORE = 5.0
"""Score, in standard deviations, from which a gain changes: 5e-4 by chance in a recording of 70
taxels. Sound ones had at most 3.6 in four recordings, a gain of 0.3 from halfway on 6.3 to 10."""
USUAL = 2.0
"""Largest score of the median taxel up to which LEAST_SCORE holds: the largest of all places is 1.2
to 1.7 without changes; where the response misfits it is as much larger for all taxels."""
LEAST_SHARE = 0.5
"""Part of a taxel's squared residuals beyond the noise that a step of its gain explains if it is
what they show: accidents, which no step explains, leave more."""


def gain_changes(fitted: FittedReadings) -> np.ndarray:
    """Taxels (n,) bool whose gain changes at one of PLACES."""
    largest = np.zeros(len(fitted.points))
    for step in _steps(fitted):
        slope, information = fitted.each(step)
        score = np.abs(slope) / np.sqrt(np.maximum(information, 1.0))  # none of a few readings
        largest = np.maximum(largest, score)
    return _significant(largest)


def displacements(whole: FittedReadings, noise: float) -> Array:
    """Displacements (n, 2), m, of the taxels whose gain changes by a step of it; zeros of others.

    whole: of all readings, those that were left out included; noise: factor of their standard
    deviations. Readings of both gains may be left out, so that the others fit a wrong place.
    """
    curvature, taxel, n = whole.curvature, whole.readings.taxel, len(whole.points)
    off = np.where(curvature > 0, -whole.rate / np.maximum(curvature, 1e-300), 0.0)
    left = whole.unexplained(off[:, None])[0][:, 0]
    beyond = sums_by_group(curvature * left**2 - noise**2 * (curvature > 0), taxel, n)
    largest, by_step = np.zeros(n), np.zeros(len(off))
    for step in _steps(whole):
        information = np.maximum(whole.each(step)[1], 1.0)
        slope = sums_by_group(curvature * step * left, taxel, n)
        score = np.abs(slope) / np.sqrt(information)
        by_step = np.where((score > largest)[taxel], (slope / information)[taxel] * step, by_step)
        largest = np.maximum(largest, score)
    shown = _significant(largest / noise) & (largest**2 > LEAST_SHARE * beyond)
    return np.where(shown[:, None], whole.displaced((off - by_step)[:, None])[:, :, 0], 0.0)


def _significant(score: Array) -> np.ndarray:
    """Whether the largest score of each taxel (n,) shows a change of its gain."""
    usual = float(np.median(score)) if len(score) else 0.0
    return np.asarray(score > LEAST_SCORE * max(usual / USUAL, 1.0))


def _steps(fitted: FittedReadings) -> Iterator[Array]:
    """Derivatives (k,) of the readings in a step of their taxel's gain, at each of PLACES."""
    readings, n = fitted.readings, len(fitted.points)
    observed = np.flatnonzero(readings.kind == OBSERVED)
    order = observed[np.lexsort((readings.contact[observed], readings.taxel[observed]))]
    count = np.bincount(readings.taxel[observed], minlength=n)
    taxel, part = readings.taxel[order], np.zeros(len(readings.taxel))
    part[order] = (np.arange(len(order)) - (np.cumsum(count) - count)[taxel]) / count[taxel]
    level = np.maximum(fitted.mu - fitted.offset, 0.0)
    for place in PLACES:
        yield np.where(part >= place, level, 0.0)
