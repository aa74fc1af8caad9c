"""Readings that come some frames later or earlier than their contacts, all of them or from a part
of the recording on: found, and moved back.

A delay displaces the contacts that a taxel responds to along their path, to both sides where the
passes over it have two directions. They spread least at the true delay, whatever the response is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import bdtrc

from ...core.arrays import Array, spreads_by_group, sums_by_group
from .delay_changes import BLOCKS, FLOOR, LAGS, LATE_FRAMES, begins_pass, delay_course
from .measurements import Measurements

MIN_READINGS, FEW_READINGS = 10, 5
"""Readings that most taxels must have: to be crossed again, and to tell a delay at all."""
LATE_GAIN = 0.98
"""Mean square distance of a taxel's contacts with the readings moved to other frames, relative to
the present one, below which they are late: 0.945 three frames late along a spiral, whose passes
have one direction (test_late_readings_along_a_spiral_of_which_taxels_have_few)."""
FILTER_GAIN = 0.9
"""The same of readings without the effect of a low-pass filter, relative to those that are only
moved, below which there is such a filter."""
CHANCE = 1e-3
"""Probability by chance, below which so many taxels' contacts lie closer together with the readings
moved that they are late: 10 of 10 taxels, 55 of 80."""
PARTS = (-0.5, -0.25, 0.0, 0.25, 0.5)
"""Parts of a frame's path by which the distance that patches are dragged along may differ from that
of a whole number of frames."""
KEPT = (0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
"""Parts of the last reading that a low-pass filter keeps which are tried: time constants of 0.8 to
20 frames."""
SKEWED = 0.1
"""Sum of the cubed changes of readings from frame to frame, relative to that of their sizes, from
which readings rise faster than they fall, as behind a low-pass filter: 0.1 to 0.9 of filters whose
lag is that of a fifth of a patch and more, -0.07 to 0.13, of either sign, of contacts alone."""
MAX_BELOW = 0.03
"""Mean square by which readings fall below the part of the last one that a filter keeps, relative
to that by which they exceed it, up to which there can be such a filter: noise leaves 0.01 to 0.05.
"""
MIN_USED = 0.5
"""Least part of the readings that have a contact in time at a delay: fewer do not show it."""
WHOLE = 1 / 12
"""Mean square, frames^2, of a part of a frame with a uniform distribution."""
PAUSE = 3.0
"""Time between contacts, in typical frames times their difference, from which there is a pause."""


def late_frames(data: Measurements) -> int:
    """Number of frames by which the readings come too late; negative: too early, 0: neither.

    The contacts that a taxel responds to, weighted by the square of its pressure above that at
    rest, spread least at the true delay, those of most taxels. A few touches or taxels do not show
    it: they may spread less at others by chance. Readings that average the past by a low-pass
    filter lag, too: they are late only by what remains without its effect. None are where patches
    that friction drags a constant distance along the path explain it better.
    """
    typical = np.median(data.counts[data.counts > 0]) if data.counts.any() else 0
    if typical < FEW_READINGS:
        return 0
    level = np.maximum(data.pressure - data.rest[data.taxel], 0.0)
    before, last = _neighbours(data, level)

    def compare(frames: int, kept: float = 0.0) -> tuple[float, float]:
        """Of the readings moved and without a filter, and as they are: `comparison` of the spreads.

        kept: the part of the last reading that the filter keeps."""
        row, used = _moved(data, -frames)
        if np.mean(used) < MIN_USED:
            return np.inf, 1.0
        felt = np.maximum(level - kept * before, 0.0)
        moved = spreads_by_group(data.points[row[used]], data.taxel[used], felt[used] ** 2)
        at = data.points[data.contact[used]]
        present = spreads_by_group(at, data.taxel[used], level[used] ** 2)
        return comparison(moved, present)

    found = {k: compare(k)[0] for k in LAGS}
    late = min(found, key=lambda k: found[k])
    step = int(np.sign(late))
    while abs(late) >= LATE_FRAMES and (beyond := compare(late + step)[0]) < found[late]:
        late += step
        found[late] = beyond
    if found[late] >= LATE_GAIN or compare(late)[1] >= CHANCE:
        return 0
    parts = _possible_filters(data.taxel, level, before, last)
    filtered = {k: min((compare(k, kept)[0] for kept in parts), default=np.inf) for k in found}
    if (least := min(filtered.values())) >= FILTER_GAIN * found[late]:
        return 0 if late > 0 and _dragged(data, level, late) < found[late] else late
    return min((k for k in filtered if FILTER_GAIN * filtered[k] <= least), key=abs)


def _dragged(data: Measurements, level: Array, frames: int) -> float:
    """The least median spread of the contacts of levels (k,), relative to the present one, where
    patches lag behind them by about as far as they move in some frames."""
    path = np.linalg.norm(np.diff(data.points, axis=0), axis=1)
    there = _in_time(data, np.arange(len(path)), np.arange(1, len(path) + 1))
    lags = (frames + np.array(PARTS)) * float(np.median(path[there]))
    present = spreads_by_group(data.points[data.contact], data.taxel, level**2)
    found = []
    for lag in lags:
        points = data.points - lag * data.headway
        moved = spreads_by_group(points[data.contact], data.taxel, level**2)
        found.append(comparison(moved, present)[0])
    return min(found)


def _neighbours(data: Measurements, level: Array) -> tuple[Array, np.ndarray]:
    """The level (k,) of the same taxel in the contact before each reading's, 0 if it was silent;
    and whether it is silent in the contact after (k,) bool."""
    order = np.lexsort((data.contact, data.taxel))
    taxel, contact = data.taxel[order], data.contact[order]
    follows = (np.diff(taxel) == 0) & (np.diff(contact) == 1)
    before, last = np.zeros(len(level)), np.ones(len(level), dtype=bool)
    before[order[1:]] = np.where(follows, level[order[:-1]], 0.0)
    last[order[:-1]] = ~follows
    return before, last


def _possible_filters(
    taxel: np.ndarray, level: Array, before: Array, last: np.ndarray
) -> tuple[float, ...]:
    """Parts of KEPT that a low-pass filter of levels (k,) of taxels (k,) may have: most taxels'
    levels rise faster than they fall, and none falls below the part that is kept. before, last
    (k,): as `_neighbours`.

    Without this, the changes of levels that are only late pass for a filter's input: they come
    earlier, and from a smaller part of a patch, than the levels.
    """
    owner, falls = np.append(taxel, taxel[last]), level[last]  # to silence
    cubes = np.append(level - before, -falls) ** 3
    each = np.bincount(owner, cubes)[np.unique(owner)]
    chance = bdtrc(int(np.sum(each > 0)) - 1, len(each), 0.5)
    if cubes.sum() < SKEWED * np.abs(cubes).sum() or chance >= CHANCE:
        return ()
    possible = []
    for kept in KEPT:
        over = np.append(level - kept * before, -kept * falls)
        below = np.sum(np.minimum(over, 0.0) ** 2)
        if below <= MAX_BELOW * np.sum(np.maximum(over, 0.0) ** 2):
            possible.append(kept)
    return tuple(possible)


def comparison(moved: Array, present: Array) -> tuple[float, float]:
    """Geometric mean of the spreads `moved` (t,) relative to those at `present` (t,), each above a
    floor, and the probability that so many taxels have a smaller one by chance."""
    if not len(present) or np.median(present) == 0.0:
        return np.inf, 1.0
    better, least = int(np.sum(moved < present)), FLOOR * float(np.median(present))
    ratio = float(np.exp(np.mean(np.log((moved + least) / (present + least)))))
    return ratio, float(bdtrc(better - 1, len(present), 0.5))


def without_delay(data: Measurements) -> Measurements:
    """The measurements with late readings at the contacts that they belong to; `delay` says by how
    many frames they were moved, and `delays` by how many from which parts of the contacts on.

    Readings that a pause separates from their contacts are left out, as are those near a change of
    the delay. Contacts whose readings are left out, or came before the first contact or after the
    last, have none.
    """
    if frames := late_frames(data):
        data = replace(_moved_back(data, np.full(len(data.points), frames)), delay=frames)
    k, level = data.contact, np.maximum(data.pressure - data.rest[data.taxel], 0.0)
    course = np.zeros(BLOCKS, dtype=int)
    # a low-pass filter lags by another time in each part, as readings rise or fall
    filtered = _possible_filters(data.taxel, level, *_neighbours(data, level))
    if _crossed_again(data) and not filtered:
        in_time = np.stack([_in_time(data, k, k - late) for late in LAGS])
        course = delay_course(data, in_time, level)
    changes = np.flatnonzero(np.diff(course)) + 1
    if not len(changes):
        return data
    contacts, m = np.arange(len(data.points)), len(data.points)
    unclear = np.zeros(m, dtype=bool)
    for change in changes:
        size = abs(int(course[change] - course[change - 1])) + m / BLOCKS / 2
        unclear |= np.abs(contacts - change * m / BLOCKS + 0.5) < size
    moved = _moved_back(data, course[contacts * BLOCKS // m], unclear)
    steps = tuple((c / BLOCKS, frames + int(course[c])) for c in (0, *changes.tolist()))
    return replace(moved, delay=steps[0][1], delays=steps)


def _crossed_again(data: Measurements) -> bool:
    """Whether most taxels have MIN_READINGS and are crossed twice: parts of a single pass spread
    less where one is moved onto another."""
    order = np.lexsort((data.contact, data.taxel))
    taxel, contact = data.taxel[order], data.contact[order]
    begins, touched = begins_pass(taxel, contact), data.counts > 0
    passes = np.bincount(taxel[begins], minlength=len(data.ids))
    often = (data.counts[touched] >= MIN_READINGS) & (passes[touched] > 1)
    return bool(np.mean(often) > 0.5) if len(often) else False


def _moved_back(
    data: Measurements, frames: np.ndarray, unclear: np.ndarray | None = None
) -> Measurements:
    """The measurements with readings moved to the contacts `frames` (m,) before those that they are
    recorded at; without those recorded at the contacts (m,) bool that are `unclear`."""
    contacts = np.arange(len(data.points))
    row = contacts - frames
    there = _in_time(data, contacts, row) & ~np.isin(contacts, data.unread)
    if unclear is not None:
        there &= ~unclear
    part, (at, taxel) = data.select(there[data.contact]), data.corrupt.T
    corrupt = np.stack([row[at], taxel], axis=1)[there[at]]
    unread = np.setdiff1d(contacts, row[there])
    return replace(part, contact=row[part.contact], corrupt=corrupt, unread=unread)


def _moved(data: Measurements, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Contact (k,) of each reading `frames` later, and whether there is one in time (k,) bool."""
    row = data.contact + frames
    return row, _in_time(data, data.contact, row)


def _in_time(data: Measurements, row: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether contacts `other` (k,) exist, with no pause between them and the contacts `row`."""
    there = (other >= 0) & (other < len(data.points))
    time, frame = data.time, float(np.median(np.diff(data.time))) if len(data.time) > 1 else 0.0
    gap = np.abs(time[np.where(there, other, row)] - time[row])
    return np.asarray(there & (gap <= PAUSE * frame * np.maximum(np.abs(other - row), 1)))


def displacements(data: Measurements, frames: int) -> tuple[Array, np.ndarray]:
    """How far (q, 3), m, the contact point moves in `frames` frames after that of each reading; and
    the readings (q,), rows, that have both contacts."""
    row, inside = _moved(data, frames)
    rows = np.flatnonzero(inside)
    return data.points[row[rows]] - data.points[data.contact[rows]], rows


def remaining_squares(data: Measurements) -> Array:
    """Mean squares (n, 3, 3), m^2, of the taxels' displacements by what is left of the delay of
    readings that came too late: a part of a frame, which the spread of the contacts tells, too.

    A taxel is displaced by the mean of its contacts' displacements, which are alike in one pass
    over it and differ between passes: where these have two directions, it is found between them.
    """
    n = len(data.ids)
    if not (data.delay or data.delays):
        return np.zeros((n, 3, 3))
    moved, rows = displacements(data, 1)
    begins, frames = np.array(data.delays or ((0.0, data.delay),)).T
    part = (data.contact[rows] + 0.5) / len(data.points)
    late = frames[np.searchsorted(begins, part, side="right") - 1] != 0
    moved[~late] = 0.0
    order = np.lexsort((data.contact[rows], data.taxel[rows]))
    moved, rows, late = moved[order], rows[order], late[order]
    weight, own, at = data.pressure[rows] ** 2, data.taxel[rows], data.contact[rows]
    begins = begins_pass(own, at)
    number = np.cumsum(begins) - 1
    share = weight / np.maximum(np.bincount(own, weight, n), 1e-300)[own]
    mean = sums_by_group(share[:, None] * moved, own, n)
    apart = sums_by_group(share[:, None] * (moved - mean[own]), number)
    total = mean[:, :, None] * mean[:, None, :]
    total += sums_by_group(apart[:, :, None] * apart[:, None, :], own[begins], n)
    return np.asarray(_remaining_square(data, rows[late]) * total)


def _remaining_square(data: Measurements, rows: np.ndarray) -> float:
    """Mean square, frames^2, of what is left of the delay of the readings `rows`: of a part of a
    frame, by the curvature and the minimum of the spread's likelihood in the delay."""
    taxel, k = data.taxel[rows], data.contact[rows]
    weight = np.maximum(data.pressure[rows] - data.rest[taxel], 0.0) ** 2
    size = np.bincount(taxel, weight) ** 2 / np.maximum(np.bincount(taxel, weight**2), 1e-300)
    cost = []
    for lag in (-1, 0, 1):
        row = k - lag * _in_time(data, k, k - lag)
        spread = spreads_by_group(data.points[row], taxel, weight)
        cost.append(size[np.unique(taxel)] @ spread)
    early, here, late = np.log(np.maximum(cost, 1e-300)) * size.sum()
    curvature = max(early + late - 2 * here, 0.0)
    off = np.clip((early - late) / 2 / max(curvature, 1e-300), -0.5, 0.5)
    return float(min(WHOLE, off**2 + 1 / (1 / WHOLE + curvature)))
