"""Taxels whose gain changes in the course of a recording, as of a contact that comes loose.

One such taxel is displaced by its readings before and after: errors of the contacts, and costs that
grow linearly, hide what does not fit. It is tested by the score of a step of its gain, with its own
unknowns estimated beside it.
"""

from __future__ import annotations

import numpy as np

from ..joint.departures import FittedReadings
from ..joint.pressure import OBSERVED

GAIN_CHANGES = "its gain changes in the course of the recording"
"""Reason of a taxel that is not determined for it."""
PLACES = np.linspace(0.2, 0.8, 13)
"""Parts of a taxel's readings after which its gain may change."""
LEAST_SCORE = 5.0
"""Score, in standard deviations, from which a gain changes: 5e-4 by chance in a recording of 70
taxels. Sound ones had at most 3.6 in four recordings, a gain of 0.3 from halfway on 6.3 to 10."""
USUAL = 2.0
"""Largest score of the median taxel up to which LEAST_SCORE holds: the largest of all places is 1.2
to 1.7 without changes; where the response misfits it is as much larger for all taxels."""


def gain_changes(fitted: FittedReadings) -> np.ndarray:
    """Taxels (n,) bool whose gain changes at one of PLACES."""
    readings, largest = fitted.readings, np.zeros(len(fitted.points))
    observed = np.flatnonzero(readings.kind == OBSERVED)
    order = observed[np.lexsort((readings.contact[observed], readings.taxel[observed]))]
    count = np.bincount(readings.taxel[observed], minlength=len(largest))
    taxel, part = readings.taxel[order], np.zeros(len(readings.taxel))
    part[order] = (np.arange(len(order)) - (np.cumsum(count) - count)[taxel]) / count[taxel]
    level = np.maximum(fitted.mu - fitted.offset, 0.0)
    for place in PLACES:
        slope, information = fitted.each(np.where(part >= place, level, 0.0))
        score = np.abs(slope) / np.sqrt(np.maximum(information, 1.0))  # none of a few readings
        largest = np.maximum(largest, score)
    usual = float(np.median(largest)) if len(largest) else 0.0
    return np.asarray(largest > LEAST_SCORE * max(usual / USUAL, 1.0))
