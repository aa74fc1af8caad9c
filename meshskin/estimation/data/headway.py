"""The directions in which the contacts of a recording move.

On a path they are those from the contact before to the contact after, in which an error of the
contact's own point has no part. Contacts without passes, as at random places, have no direction but
that of the way to the next one: a reading that comes a part of a frame late is on that way, and
displaced by that part of it. All taxels then move towards the middle of the contacts, which
their own readings do not show; those that answer in the same contact do.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array

JUMPS = 1.5
"""Mean square of the ways to the second contact after each, relative to that of the ways to the
next, below which contacts have no passes: 4 on a line, 1 at random places."""


def headway(points: Array, normals: Array, time: Array) -> Array:
    """Tangents (m, 3) along which contacts at points (m, 3), m, with unit normals (m, 3) and times
    (m,), s, move: unit ones; zeros where there is no motion.

    Of contacts without passes, the velocities towards the next one, relative to the median speed.
    """
    way = np.diff(points, axis=0)
    if not len(way):
        return np.zeros_like(points)
    twice = way[1:] + way[:-1]
    jumps = len(twice) and np.sum(twice**2) / len(twice) < JUMPS * np.sum(way**2) / len(way)
    if jumps:
        speed = way / np.maximum(np.diff(time), 1e-9)[:, None]
        ahead = np.append(speed, np.zeros((1, 3)), axis=0)
    else:
        ahead = np.gradient(points, axis=0)
    ahead -= np.sum(ahead * normals, axis=1, keepdims=True) * normals
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    if jumps:
        length = np.full_like(length, np.median(length))
    return np.asarray(ahead / np.where(length > 0, length, 1.0))
