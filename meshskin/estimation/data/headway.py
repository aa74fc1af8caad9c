"""The directions in which the contacts of a recording move.

On a path they are those from the contact before to the contact after, in which an error of the
contact's own point has no part. Contacts at random places have no direction but that of the way to
the next one: a reading that comes a part of a frame late is on that way, and displaced by that part
of it. All taxels then move towards the middle of the contacts, which their own readings do not
show; those that answer in the same contact do.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array

PREDICTED = 0.5
"""Share of the variance of the places that an affine map of the places before predicts, above which
contacts follow a path. By the ways to the next places a reading that is late would move all taxels
by that map, which no reading shows; of random places it predicts none."""


def headway(points: Array, normals: Array, time: Array) -> Array:
    """Tangents (m, 3) along which contacts at points (m, 3), m, with unit normals (m, 3) and times
    (m,), s, move: unit ones; zeros where there is no motion.

    Of contacts at random places, the velocities towards the next one, relative to the median speed.
    """
    if len(points) < 2:
        return np.zeros_like(points)
    centred, way = points - points.mean(axis=0), np.diff(points, axis=0)
    here = np.column_stack([np.ones(len(way)), centred[:-1]])
    off = centred[1:] - here @ np.linalg.lstsq(here, centred[1:], rcond=None)[0]
    random = bool(np.sum(off**2) > (1 - PREDICTED) * np.sum(centred**2))
    if random:
        speed = way / np.maximum(np.diff(time), 1e-9)[:, None]
        ahead = np.append(speed, np.zeros((1, 3)), axis=0)
    else:
        ahead = np.gradient(points, axis=0)
    ahead -= np.sum(ahead * normals, axis=1, keepdims=True) * normals
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    if random:
        length = np.full_like(length, np.median(length))
    return np.asarray(ahead / np.where(length > 0, length, 1.0))
