"""Readings that come some frames later or earlier than their contacts: found, and moved back.

A delay displaces the contacts that a taxel responds to along their path, to both sides where the
passes over it have two directions. They spread least at the true delay, whatever the response is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array, sums_by_group
from .measurements import Measurements

LATE_FRAMES = 5
"""Delays of the readings, in frames, that are all looked at; larger ones while they fit better.
Contacts of a taxel that are farther apart belong to different passes over it."""
MIN_READINGS = 10
"""Readings that most taxels must have: fewer may spread less at a wrong delay by chance."""
LATE_GAIN = 0.9
"""Mean square distance of a taxel's contacts with the readings moved to other frames, relative to
the present one, below which they are late."""


def late_frames(data: Measurements) -> int:
    """Number of frames by which the readings come too late; negative: too early, 0: neither.

    The contacts that a taxel responds to, weighted by the square of its pressure above that at
    rest, spread least at the true delay. A few touches do not show it:
    the two or three readings of a taxel may spread less at others by chance.
    """
    if not data.counts.any() or np.median(data.counts[data.counts > 0]) < MIN_READINGS:
        return 0
    weight, n = np.maximum(data.pressure - data.rest[data.taxel], 0.0) ** 2, len(data.ids)

    def spread(frames: int) -> float:
        row = data.contact - frames
        inside = (row >= 0) & (row < len(data.points))
        points, w, own = data.points[row[inside]], weight[inside], data.taxel[inside]
        total = np.bincount(own, w, n)
        mean = sums_by_group(w[:, None] * points, own, n) / np.maximum(total, 1e-300)[:, None]
        square = np.bincount(own, w * np.sum((points - mean[own]) ** 2, axis=1), n)
        return float(np.median(square[total > 0] / total[total > 0])) if len(own) else np.inf

    at = {k: spread(k) for k in range(-LATE_FRAMES, LATE_FRAMES + 1)}
    best = min(at, key=lambda k: at[k])
    step, least = int(np.sign(best)), at[best]
    while abs(best) >= LATE_FRAMES and (beyond := spread(best + step)) < least:
        best, least = best + step, beyond
    return best if least < LATE_GAIN * at[0] else 0


def without_delay(data: Measurements) -> Measurements:
    """The measurements with late readings at the contacts that they belong to; `delay` says by how
    many frames they were moved.

    The contacts whose readings came after the last contact, or before the first, have none.
    """
    frames, m = late_frames(data), len(data.points)
    if not frames:
        return data
    inside = (data.contact >= frames) & (data.contact < m + frames)
    part = data.select(inside)
    corrupt = data.corrupt - [frames, 0]
    corrupt = corrupt[(corrupt[:, 0] >= 0) & (corrupt[:, 0] < m)]
    unread = np.arange(m)[-frames:] if frames > 0 else np.arange(-frames)
    part = replace(part, contact=part.contact - frames, corrupt=corrupt)
    return replace(part, delay=frames, unread=unread)


def displacements(data: Measurements, frames: int) -> tuple[Array, np.ndarray]:
    """How far (q, 3), m, the contact point moves in `frames` frames after that of each reading; and
    the readings (q,), rows, that have both contacts."""
    row = data.contact + frames
    inside = np.flatnonzero((row >= 0) & (row < len(data.points)))
    return data.points[row[inside]] - data.points[data.contact[inside]], inside
