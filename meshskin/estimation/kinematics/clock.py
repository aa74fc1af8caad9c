"""A first offset of the clocks, by the contacts that each taxel responds to.

At another offset the contacts are displaced along their path, to both sides where the passes over a
taxel have two directions. They spread least at the true one, whatever the response is, and whatever
displaces all contacts alike. The estimate begins there: from an offset that is wrong by more than
the time in which a contact passes a taxel it finds no way.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ...robot.contact_kinematics import ContactKinematics, JointPath
from ..data.delay import CHANCE, LATE_GAIN, comparison, spreads

LARGEST = 2.0
"""Largest offset, s, that is looked for. Chosen: more than buffers and networks delay."""
STEP = 0.02
"""Distance, s, of the offsets that are tried: a contact slides by 1 mm in it at 50 mm/s, a fraction
of a patch."""
MAX_CONTACTS = 2000
"""Contacts, evenly chosen, that are compared."""


def first_offset(
    kinematics: ContactKinematics, path: JointPath, time: Array, readings: Array
) -> float:
    """By how much, s, the stamps `time` (m,) of the readings (m, n) are late; 0 where that is not
    declared unknown, or no offset makes the contacts of the taxels spread by less than now."""
    s = np.zeros(len(kinematics.labels))
    inside = path.covers(time - LARGEST) & path.covers(time + LARGEST)
    kept = np.flatnonzero(inside)[:: 1 + int(inside.sum()) // MAX_CONTACTS]
    contact, taxel = np.nonzero(np.isfinite(readings[kept]))
    if "clock_offset" not in kinematics.columns or not len(contact):
        return 0.0
    weight = readings[kept][contact, taxel] ** 2

    def at(offset: float) -> Array:
        s[kinematics.columns["clock_offset"]] = offset
        points, _ = kinematics.centres(path, time[kept], s)
        return spreads(points[contact], weight, taxel)

    tried = STEP * np.arange(-round(LARGEST / STEP), round(LARGEST / STEP) + 1)
    best = min(tried, key=lambda offset: float(np.median(at(offset))))
    ratio, chance = comparison(at(best), at(0.0))
    return float(best) if ratio < LATE_GAIN and chance < CHANCE else 0.0
