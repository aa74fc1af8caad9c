"""The contacts of a dense log that are calibrated: the steady ones, each once.

While the indenter comes to rest in a place, or leaves it, many frames follow each other. Those with
nearly the same contact share its errors and are averaged. Where the log has no force, those in
which the indenter is not yet as deep as a moment later in the same place are left out: the force
that is believed of all contacts is not theirs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ...recording.skin_log import SkinLog
from ...robot.contact_kinematics import AveragedPath, JointPath

ALIKE = 0.1
"""Distance of the indenter's centres, in contact radii, up to which frames are one contact: the
readings differ by less than a hundredth of their peak across the middle of a patch, and by a tenth
on its flank, of which the mean is kept."""
BESIDE = 0.5
"""Distance, in contact radii, up to which contacts of one touch are in the same place."""
SHALLOW = 0.3
"""Part of the depth by which a contact is higher than another one of the touch in the same place,
from which it is left out: its force is below 0.6 of that one's (Hertz)."""
FRAMES = "time", "joint_angles", "readings", "in_contact", "force"
"""Arrays of a log by frame."""
MAX_CONTACTS = 5000
"""Contacts that are kept, evenly chosen: with a thousand the log of `tests/estimation/kinematics/
test_bag.py` is not within 1.2 of its bound."""


def steady(
    log: SkinLog,
    path: JointPath,
    frames: np.ndarray,
    centres: Array,
    heights: Array,
    depth: float,
    radius: float,
) -> tuple[SkinLog, AveragedPath]:
    """The log of the steady contacts among the `frames` (m,), one frame each, and their path.

    path: of the joints in all frames; centres (m, 3), m, of the indenter in the body frame and its
    heights (m,), m, over the body; depth, m, of a contact, and radius, m, of the indenter.
    Readings, angles and forces are means.
    """
    radius = float(np.sqrt(radius * depth))  # of a contact (Hertz)
    group = _alike(log, frames, centres, ALIKE * radius)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    if log.force is None:
        touch = np.cumsum(np.diff(frames, prepend=-2) > 1)[first]
        count = np.diff(np.append(first, len(frames)))
        mean, at = (
            np.add.reduceat(values, first, axis=0) / count.reshape(-1, *[1] * (values.ndim - 1))
            for values in (heights, centres)
        )
        kept = ~_shallow(at, mean, touch, BESIDE * radius, SHALLOW * depth)
    else:
        kept = np.ones(len(first), dtype=bool)
    kept &= np.cumsum(kept) % -(-kept.sum() // MAX_CONTACTS) == 0
    return _means(log, path, frames, group, np.flatnonzero(kept))


def _alike(log: SkinLog, frames: np.ndarray, centres: Array, distance: float) -> np.ndarray:
    """Number (m,) of the contact of each frame: one for consecutive frames whose centres are within
    `distance`, m, of that of its first."""
    group = np.zeros(len(frames), dtype=int)
    begin = 0
    for k in range(1, len(frames)):
        apart = frames[k] != frames[k - 1] + 1
        if apart or np.sum((centres[k] - centres[begin]) ** 2) > distance**2:
            begin = k
        group[k] = group[k - 1] + (begin == k)
    return group


def _shallow(
    centres: Array, heights: Array, touch: np.ndarray, beside: float, least: float
) -> np.ndarray:
    """Contacts (c,) bool that are higher by `least`, m, than one of the same touch within
    `beside`, m, and less aside of it than higher: joints that err tilt the path of a slide, too."""
    pairs = cKDTree(centres).query_pairs(2 * (beside + least), output_type="ndarray")
    lower, upper = pairs.T
    turned = heights[lower] > heights[upper]
    lower, upper = np.where(turned, upper, lower), np.where(turned, lower, upper)
    rise = heights[upper] - heights[lower]
    gap = np.sum((centres[upper] - centres[lower]) ** 2, axis=1) - rise**2
    found = (touch[lower] == touch[upper]) & (rise > least) & (gap < np.minimum(beside, rise) ** 2)
    out = np.zeros(len(centres), dtype=bool)
    out[upper[found]] = True
    return out


def _means(
    log: SkinLog, path: JointPath, frames: np.ndarray, group: np.ndarray, kept: np.ndarray
) -> tuple[SkinLog, AveragedPath]:
    """The log of the groups `kept` of its frames (m,), each as one frame, and their path; `group`
    (m,)."""
    order = np.full(group[-1] + 1, -1)
    order[kept] = np.arange(len(kept))
    rows, row = frames[order[group] >= 0], order[group][order[group] >= 0]
    start = np.flatnonzero(np.diff(row, prepend=-1))

    def mean(values: NDArray[np.floating]) -> Array:
        """Means of what is known; NaN where less than half is: one reading over a threshold among
        silences is the noise of one frame."""
        known = np.isfinite(values[rows])
        total = np.add.reduceat(np.where(known, values[rows], 0.0), start, axis=0)
        count = np.add.reduceat(known.astype(int), start, axis=0)
        frames_of = np.diff(np.append(start, len(rows))).reshape(-1, *[1] * (values.ndim - 1))
        known_enough = 2 * count >= frames_of
        return np.asarray(np.where(known_enough, total / np.maximum(count, 1), np.nan))

    time = mean(log.time)
    means = replace(
        log,
        time=time,
        joint_angles=mean(log.joint_angles),
        readings=mean(log.readings),
        in_contact=np.ones(len(kept), dtype=bool),
        force=None if log.force is None else mean(log.force),
    )
    return means, AveragedPath(path.time, path.angles, log.time[rows] - time[row], start)


def taken(log: SkinLog, path: AveragedPath, kept: np.ndarray) -> tuple[SkinLog, AveragedPath]:
    """The log and the path of the contacts `kept` (m,) bool of those of `steady`."""
    count = np.diff(np.append(path.first, len(path.apart)))
    first = np.cumsum(count[kept]) - count[kept]
    arrays = {name: getattr(log, name)[kept] for name in FRAMES if getattr(log, name) is not None}
    frames = replace(path, apart=path.apart[np.repeat(kept, count)], first=first)
    return replace(log, **arrays), frames
