"""Readings whose delay is another in some parts of the recording, as where frames were lost or
doubled, or where the clocks run at different rates.

The contacts that a taxel responds to spread least at the true delays. Of all parts of the recording
and all delays the one that lowers the spread of all taxels most is changed, again and again. A
constant delay, or patches that are dragged along, which look like one, lower it as much.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from .measurements import Measurements

LATE_FRAMES = 5
"""Delays of the readings, in frames, that are all looked at. Contacts of a taxel that are farther
apart belong to different passes over it."""
LAGS = range(-LATE_FRAMES, LATE_FRAMES + 1)
BLOCKS, LEAST_BLOCKS = 48, 4
"""Parts of the recording whose delays are estimated, and the least number of neighbouring ones that
have another delay than the rest."""
MAX_TAXELS, MAX_CHANGES = 100, 8
"""Taxels, evenly chosen, whose spreads count, and changes of the delay, at most."""
FLOOR = 0.25
"""Least variance of a taxel, in that of the median one: few readings have a small one by chance."""
LEAST_GAIN = 4.0
"""Increase of the logarithm of the likelihood, with normal distances of the contacts from their
taxels, from which a delay is another. Of simulated bodies with edges, at which passes end, the best
of the 10,000 changes that are tried has up to 0.31 (test_passes_that_end_at_edges_are_not_late);
where the delay changes in tests/estimation/data/test_measurements.py, it has 116 and more. Chosen
below the latter: spirals, whose passes have one direction, show less."""


def delay_course(data: Measurements, in_time: np.ndarray, level: Array) -> np.ndarray:
    """Delays (BLOCKS,), frames, of the readings by the parts of the recording that they are in;
    equal ones where they show no change.

    in_time (lags, k) bool: whether the contact LAGS before that of each reading exists, without a
    pause between them; level (k,): pressures above those at rest.
    """
    sums, size = _sums(data, in_time, level)
    floor = FLOOR * float(np.median(_spread(sums[LATE_FRAMES, :, -1]))) if len(size) else 0.0
    cost = np.array([_cost(total, size, floor) for total in sums[:, :, -1]])
    constant, start = int(np.argmin(cost)), LATE_FRAMES
    if cost[start] - cost[constant] >= LEAST_GAIN:  # changes would stand in for it
        start = constant
    lags, least = np.full(BLOCKS, start), float(cost[start])
    for _ in range(MAX_CHANGES):
        found, lag, begin, end = _best_change(sums, lags, size, floor)
        if least - found < LEAST_GAIN:
            break
        least, lags[begin:end] = found, lag
    changes = cost[constant] - least >= LEAST_GAIN
    return lags - LATE_FRAMES if changes else np.zeros(BLOCKS, dtype=int)


def _sums(data: Measurements, in_time: np.ndarray, level: Array) -> tuple[Array, Array]:
    """Sums (lags, 5, BLOCKS + 1, t) over the parts before each of the weights of t taxels'
    readings, of these times the contacts' positions, and times their squares; and the taxels'
    effective numbers of passes (t,) beyond the one that their means follow: a delay displaces the
    readings of one pass alike.
    """
    touched = np.flatnonzero(data.counts > 0)
    chosen = touched[:: -(-len(touched) // MAX_TAXELS)] if len(touched) else touched
    place = np.full(len(data.ids), -1)
    place[chosen] = np.arange(len(chosen))
    weight, t = level**2, len(chosen)
    rows = np.flatnonzero((place[data.taxel] >= 0) & (weight > 0))
    block = data.contact[rows] * BLOCKS // len(data.points)
    cell, weight = block * t + place[data.taxel[rows]], weight[rows]
    points = data.points - data.points.mean(axis=0)
    sums = np.zeros((len(LAGS), 5, BLOCKS + 1, t))
    for k, (lag, there) in enumerate(zip(LAGS, in_time[:, rows], strict=True)):
        at = points[data.contact[rows] - np.where(there, lag, 0)]  # to leave out spreads least
        values = np.column_stack([np.ones(len(at)), at, np.sum(at**2, axis=1)])
        for q, value in enumerate((weight[:, None] * values).T):
            sums[k, q, 1:] = np.bincount(cell, value, BLOCKS * t).reshape(BLOCKS, t)
    order = np.lexsort((data.contact[rows], data.taxel[rows]))
    begins = begins_pass(data.taxel[rows][order], data.contact[rows][order])
    passes = np.bincount(np.cumsum(begins) - 1, weight[order])
    square = np.bincount(place[data.taxel[rows][order][begins]], passes**2, t)
    sums = np.cumsum(sums, axis=2)
    return sums, np.maximum(sums[0, 0, -1] ** 2 / np.maximum(square, 1e-300) - 1, 0.0)


def begins_pass(taxel: np.ndarray, contact: np.ndarray) -> np.ndarray:
    """Whether (k,) a reading is the first of a pass over its taxel; by taxel and then contact."""
    return (np.diff(taxel, prepend=-1) != 0) | (np.diff(contact, prepend=0) > LATE_FRAMES)


def _spread(total: Array) -> Array:
    """Mean squares (..., t) of the contacts' distances from their taxels' means, by sums
    (5, ..., t)."""
    mean = total[1:] / np.maximum(total[0], 1e-300)
    return np.asarray(np.maximum(mean[3] - np.einsum("i...,i...", mean[:3], mean[:3]), 0.0))


def _cost(total: Array, size: Array, floor: float) -> Array:
    """Negative logarithm of the likelihood, by sums (5, ..., t): each taxel has its own variance,
    of which one that answers at two places has a large one, above a floor."""
    return np.asarray(np.log(_spread(total) + max(floor, 1e-300)) @ size)


def _best_change(
    sums: Array, lags: np.ndarray, size: Array, floor: float
) -> tuple[float, int, int, int]:
    """The least cost with another lag of the parts from one to before another, and these."""
    steps = np.diff(sums, axis=2)[lags, :, np.arange(BLOCKS)]
    present = np.zeros_like(sums[0])
    present[:, 1:] = np.cumsum(steps, axis=0).swapaxes(0, 1)
    begin, end = np.triu_indices(BLOCKS + 1, LEAST_BLOCKS)
    best = (np.inf, 0, 0, 0)
    for lag, other in enumerate(sums):
        change = other - present
        cost = _cost(present[:, -1:] + change[:, end] - change[:, begin], size, floor)
        k = int(np.argmin(cost))
        best = min(best, (float(cost[k]), lag, int(begin[k]), int(end[k])))
    return best
