"""Single readings that no contact explains, which are left out: numbers out of all range, values
that a taxel repeats, spikes of a taxel that nothing touches.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, spreads_by_group
from ...recording.recording import Recording

MIN_READINGS = 3
"""Readings of a taxel of which the strongest counts: with fewer, all may be at the patch's rim."""
CORRUPT_RATIO = 10.0
"""Pressure, relative to the typical strongest reading of a taxel, above which a reading is corrupt.
Peaks grow as F^(1/3), and gains differ by a factor of 2.5 at three standard deviations of their
prior: less than 10 together even at ten times the force."""
MAX_CORRUPT = 0.01
"""Fraction of corrupt readings up to which they are left out: more have a common cause, a
wrong unit or a broken sensor, which the test of fit shows."""
MIN_STUCK = 10
"""Equal readings in a row from which a taxel may be stuck."""
STUCK_SPREAD = 1.5
"""Spread of their contacts, relative to that of the contacts which a taxel senses, from which it
is: equal readings of a sound taxel lie within the latter."""
MIN_COPIED = 10, 0.9
"""Equal readings of two taxels, and their part of all readings of either, from which they are
copies: taxels side by side answer different contacts. Where readings are only 0 or 1, 0.9 are alike
at a distance of 0.16 of the radius at which a contact is answered."""
SPIKE_RATIO = 3.0
"""Reading, relative to those of its taxel in neighbouring contacts, from which these do not confirm
it: over half of its reach a patch falls to .7 of its peak, by Hertz."""
LEAST_SPIKE = 0.1
"""Least spike, relative to the typical second strongest reading of a taxel: less displaces a taxel
little."""
MAX_SPIKES = 0.1
"""Fraction of spikes from which they are none: readings that are late by some contacts are all at
wrong places."""
ABOVE_NOISE = 10.0
"""Least spike, relative to the median of readings far from the taxel's contacts, where these are
more than MAX_SPIKES: they are noise then, and the median of noise above zero is 0.67 sigma."""
NEIGHBOURS, STEPS = 6, (-2, -1, 1, 2)
"""Contacts that are nearest to that of a reading, and in time: what creep and hysteresis leave
follows a stronger reading."""
LEAST_NEIGHBOURS = 4
"""Neighbours within half of a taxel's reach, at least: where contacts are sparser a reading
cannot be compared."""
FAR = 2.0
"""Distance of a contact from those of the taxel, in reaches, from which its reading may be a spike:
tails of a response end before; at the border of what was touched contacts lack neighbours."""


def corrupt_readings(pressure: Array, taxel: np.ndarray) -> np.ndarray:
    """Readings (k,) bool of taxels (k,) that no contact explains: not finite, or CORRUPT_RATIO
    times what taxels read at most. None where they are more than MAX_CORRUPT.

    A taxel's largest reading may be the corrupt one: its second largest counts.
    """
    lost = ~np.isfinite(pressure)
    level = np.where(lost, 0.0, pressure)
    first, count, order = _strongest_first(level, taxel)
    many = count >= MIN_READINGS
    if not many.any():
        return lost
    first, count = first[many], count[many]
    typical = float(np.median(level[order[first + 1]]))
    bound = np.full(int(taxel.max()) + 1, typical)
    own = taxel[order[first]]
    bound[own] = np.maximum(typical, level[order[first + count // 2]])
    wild = level > CORRUPT_RATIO * bound[taxel]
    return lost if typical <= 0 or too_many_corrupt(wild) else lost | wild


def stuck_readings(pressure: Array, taxel: np.ndarray, points: Array, reach: float) -> np.ndarray:
    """Readings (k,) bool, in time order, of stretches in which a taxel (k,) repeats one value in
    contacts at `points` (k, 3), m, further apart than taxels sense: their rms distance from their
    middle is STUCK_SPREAD times that of the typical taxel's contacts, and `reach`, m, the distance
    to which a taxel responds by the belief, as few contacts of a taxel lie closer together.

    Readings at rest, which sound taxels repeat, must be left out before. None of taxels whose
    readings are all equal.
    """
    order = np.argsort(taxel, kind="stable")
    owner, value, at = taxel[order], pressure[order], points[order]
    begins = np.diff(owner, prepend=-1) != 0
    run = np.cumsum(begins | (np.diff(value, prepend=np.nan) != 0)) - 1
    by_taxel, by_run = (np.sqrt(spreads_by_group(at, g)) for g in (np.cumsum(begins) - 1, run))
    typical, count = float(np.median(by_taxel)) if len(owner) else 0.0, np.bincount(run)
    stuck = (count >= MIN_STUCK) & (by_run > STUCK_SPREAD * max(typical, reach))
    found = np.zeros(len(taxel), dtype=bool)
    found[order] = stuck[run] & (count[run] < np.bincount(owner)[owner])
    return found


def copied_readings(pressure: Array, taxel: np.ndarray, contact: np.ndarray) -> np.ndarray:
    """Pairs (q, 2) of taxels (k,) whose readings are equal in nearly all contacts (k,) that they
    answer, as where a driver fills a dead channel with that of its neighbour: noise and place make
    them differ. Readings at the end of a sensor's range must be left out before."""
    order = np.lexsort((taxel, pressure, contact))
    owner = taxel[order]
    equal = (np.diff(contact[order]) == 0) & (np.diff(pressure[order]) == 0)
    pairs = np.column_stack([owner[:-1], owner[1:]])[equal]
    pairs, common = np.unique(pairs, axis=0, return_counts=True)
    count = np.bincount(taxel, minlength=1)[pairs].max(axis=1, initial=0)
    return np.asarray(pairs[(common >= MIN_COPIED[0]) & (common >= MIN_COPIED[1] * count)])


def repeated_frames(recording: Recording) -> np.ndarray:
    """Contacts (m,) bool that repeat the one before in point, force and all readings, and all later
    copies of a log that was joined to itself: what is written twice tells nothing new.

    Single frames that are equal to earlier ones are not: while a robot holds still, coarse readings
    take few values, and those that occur often would count as often as others.
    """
    at, pressure, m = recording.reading_contact, recording.pressure, len(recording.time)
    sums = [np.bincount(at, values, m) for values in (pressure, pressure * recording.reading_taxel)]
    frames = np.column_stack([recording.points, recording.force, *sums])
    repeated = np.zeros(m, dtype=bool)
    repeated[1:] = (np.diff(frames, axis=0) == 0).all(axis=1)
    length = 1 + np.flatnonzero((frames[1:] == frames[:1]).all(axis=1))
    for k in length[m % length == 0]:
        if np.array_equal(frames[k:], frames[:-k]):
            repeated[k:] = True
            break
    return repeated


def too_many_corrupt(corrupt: np.ndarray) -> bool:
    """Whether more than MAX_CORRUPT of the readings (k,) are corrupt; a single one never is."""
    return bool(np.sum(corrupt) > max(1.0, MAX_CORRUPT * len(corrupt)))


def spikes(
    pressure: Array,
    taxel: np.ndarray,
    contact: np.ndarray,
    points: Array,
    threshold: float,
    reach: float,
) -> np.ndarray:
    """Readings (k,) bool of taxels (k,) far from the contacts that press them, which no contact
    that is a neighbour in place or time confirms: an interference, or something else that touches
    for a moment.

    contact (k,): rows of `points` (m, 3), m, of the contacts in time order, without those that
    have no force. threshold: below which a silent taxel reads. reach: distance, m, to which a taxel
    responds by the belief.
    """
    found = np.zeros(len(taxel), dtype=bool)
    if not len(taxel):
        return found
    centre = _weighted_medians(points[contact], taxel, pressure)
    apart = np.linalg.norm(points[contact] - centre[taxel], axis=1)
    away, least = apart > FAR * reach, LEAST_SPIKE * _typical(pressure, taxel)
    if away.mean() > MAX_SPIKES:
        least = max(least, ABOVE_NOISE * float(np.median(pressure[away])))
    far = np.flatnonzero(away & (pressure > least))
    if not len(far) or len(points) <= NEIGHBOURS:
        return found
    distance, near = cKDTree(points).query(points[contact[far]], NEIGHBOURS + 1)
    near[distance > reach / 2] = contact[far, None].repeat(NEIGHBOURS + 1, 1)[distance > reach / 2]
    enough = np.sum(near != contact[far, None], axis=1) >= LEAST_NEIGHBOURS
    in_time = np.clip(contact[far, None] + np.array(STEPS), 0, len(points) - 1)
    others = np.column_stack([near, in_time])
    key = contact * (int(taxel.max()) + 1) + taxel
    order = np.argsort(key)
    wanted = others * (int(taxel.max()) + 1) + taxel[far, None]
    at = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    level = np.where(key[order][at] == wanted, pressure[order][at], 0.0)
    level[others == contact[far, None]] = 0.0
    limit = SPIKE_RATIO * np.maximum(level.max(axis=1), threshold)
    found[far] = enough & (pressure[far] > limit)
    return found & (found.mean() <= MAX_SPIKES)


def _typical(level: Array, taxel: np.ndarray) -> float:
    """Median of the taxels' second strongest readings; 0 where none has MIN_READINGS."""
    first, count, order = _strongest_first(level, taxel)
    many = count >= MIN_READINGS
    return float(np.median(level[order[first[many] + 1]])) if many.any() else 0.0


def _strongest_first(level: Array, taxel: np.ndarray) -> tuple[np.ndarray, ...]:
    """First reading (n,) of each taxel that has any, their number (n,), in an order (k,) in which
    the strongest of a taxel come first."""
    order = np.lexsort((-level, taxel))
    first = np.flatnonzero(np.diff(taxel[order], prepend=-1))
    return first, np.diff(np.append(first, len(order))), order


def _weighted_medians(values: Array, group: np.ndarray, weight: Array) -> Array:
    """Medians (g, d) of the values (k, d) of each group (k,), by coordinate, with weights (k,)."""
    count = int(group.max()) + 1
    total = np.bincount(group, weight, count)
    medians = np.full((count, values.shape[1]), np.nan)
    for column, value in enumerate(values.T):
        order = np.lexsort((value, group))
        owner, passed = group[order], np.cumsum(weight[order])
        before = np.append(0.0, np.cumsum(total))[owner]
        half = passed - before >= total[owner] / 2
        first = np.flatnonzero(half & np.diff(owner * 2 + half, prepend=-1).astype(bool))
        medians[owner[first], column] = value[order][first]
    return medians
