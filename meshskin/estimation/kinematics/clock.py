"""A first offset of the clocks, by the contacts that each taxel responds to, and whose clock it is.

At another offset the contacts are displaced along their path, to both sides where the passes over a
taxel have two directions. They spread least at the true one, whatever the response is, and whatever
displaces all contacts alike. The estimate begins there: from an offset that is wrong by more than
the time in which a contact passes a taxel it finds no way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array, spreads_by_group
from ...geometry.body import Body
from ...recording.clock_offset import peak
from ...robot.contact_kinematics import JOINT_DELAY, JOINT_OFFSET, ContactKinematics, JointPath
from ..calibration import Calibration
from ..data.delay import CHANCE, MIN_USED, comparison

LARGEST = 6.0
"""Largest offset, s, that is looked for. Chosen: more than buffers and networks delay, and clocks
that were set by hand differ."""
MIN_CONTACT = 10.0
"""Time in contact, s, from which offsets beyond NEAR are looked for. In less, the contacts of each
taxel spread least where the robot hardly moves: of parts of five logs of simulated robots with
strokes of 1 s, 33 of 40 with two strokes, 4 of 24 with six and none of 12 with twelve gave a wrong
offset of seconds."""
STEP = 0.02
"""Distance, s, of the offsets that are tried: a contact slides by 1 mm in it at 50 mm/s, a fraction
of a patch."""
FAR_GAIN = 0.5
"""Mean spread, relative to that with no offset, from which it is not chance. The mean, not the
median, is compared: at an offset of seconds a few contacts lie on the way from one pass to the
next, far from all others."""
LATE_GAIN = 0.9
"""Mean spread, relative to that with no offset, below which one that chance does not explain is an
offset of the clocks."""
NEAR = 0.1
"""Offset, s, up to which the contacts of a pass stay beside their taxel (4 mm at 40 mm/s), so that
the spread is one valley about the true one: its bottom may be flat, but its side at half the way
shows the direction."""
MAX_CONTACTS = 2000
"""Contacts, evenly chosen, that are compared."""
FAINT = 0.1
"""Reading, relative to the largest one of its taxel, up to which it is left out: its weight is
below 1 %, and a log of all taxels has twenty times as many of them, mostly noise."""


def first_offset(
    kinematics: ContactKinematics, path: JointPath, time: Array, readings: Array, s: Array
) -> float:
    """By how much, s, the stamps `time` (m,) of the readings (m, n) are late, with the other
    unknowns s (K,); 0 where that is not declared unknown, or no offset makes the contacts of the
    taxels spread by less than now."""
    kept = np.arange(len(time))[:: 1 + len(time) // MAX_CONTACTS]
    level = np.nan_to_num(readings[kept])
    contact, taxel = np.nonzero(level > FAINT * level.max(axis=0, initial=0.0))
    if "clock_offset" not in kinematics.columns or not len(contact):
        return 0.0
    weight = readings[kept][contact, taxel] ** 2
    track = JointPath(path.time, kinematics.centres(path, path.time, s)[0])

    def centres(offset: float) -> Array:
        """Centres (m, 3), m, in the contacts that are kept; NaN where the path has none."""
        found, known = np.full((len(kept), 3), np.nan), path.covers(time[kept] - offset)
        found[known] = track.at(time[kept[known]] - offset)[0]
        return found

    present = centres(0.0)

    def compared(points: Array) -> np.ndarray:
        """Readings (k,) bool whose contacts are known with `points` (m, 3), and with no offset;
        none where these are few."""
        known = np.isfinite(points[contact, 0]) & np.isfinite(present[contact, 0])
        return known & (np.mean(known) >= MIN_USED)

    def spread(points: Array, used: np.ndarray) -> Array:
        """Spreads (t,) of the taxels, m^2, by contacts at `points` (m, 3) of the readings used."""
        if not used.any():
            return np.array([np.inf])
        return spreads_by_group(points[contact[used]], taxel[used], weight[used])

    def spread_at(offset: float) -> float:
        """Mean spread, m^2, of the taxels with the offset."""
        points = centres(offset)
        return float(np.mean(spread(points, compared(points))))

    def gain(offset: float) -> tuple[float, float]:
        """Mean spread relative to that with no offset, and the probability of it by chance."""
        points = centres(offset)
        used = compared(points)
        found, now = spread(points, used), spread(present, used)
        return float(np.mean(found) / np.mean(now)), comparison(found, now)[1]

    held = len(time) * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if held > MIN_CONTACT:
        best = float(min(_offsets(LARGEST), key=spread_at))
        ratio, chance = gain(best)
        if ratio < FAR_GAIN or (ratio < LATE_GAIN and chance < CHANCE):
            return best
    near = _offsets(NEAR)
    best = peak(near, -np.array([spread_at(offset) for offset in near]))
    return best if abs(best) < NEAR and gain(best / 2)[1] < CHANCE else 0.0


def timed_by_the_fastest(
    model: ContactKinematics, path: JointPath, time: Array, body: Body
) -> ContactKinematics:
    """The kinematics with delays of all joints but the one that moves the heights at times (m,), s,
    fastest: delays of the others and of the clock are relative to its stamps, which determine most.
    Unchanged where the joints that are delayed are given."""
    names = model.chain.joint_names
    if model.delayed is not None or JOINT_DELAY not in model.columns or len(names) < 2:
        return model
    offsets = replace(model, unknown={JOINT_OFFSET: 1.0})
    centres, slopes = offsets.centres(path, time, np.zeros(len(names)))
    by_joint = np.einsum("mi,mij->mj", body.closest(centres).normal, slopes)
    fastest = int(np.argmax(np.sum((by_joint * path.at(time)[1]) ** 2, axis=0)))
    return replace(model, delayed=names[:fastest] + names[fastest + 1 :])


def _offsets(largest: float) -> Array:
    """Offsets, s, from -largest to largest that are tried."""
    return np.asarray(STEP * np.arange(-round(largest / STEP), round(largest / STEP) + 1))


def with_clock(found: Calibration, clock: float) -> Calibration:
    """The calibration with the offset of the clocks, s, that its contacts were moved by before: the
    table of its belief is about that offset, too."""
    if not clock:
        return found
    name, belief = "clock_offset", found.belief
    assert belief is not None
    assert belief.contact_motion is not None
    value, sigma = found.unknowns[name]
    motion = belief.contact_motion
    mean = motion.mean + clock * (np.array(motion.labels) == name)
    belief = replace(belief, contact_motion=replace(motion, mean=mean))
    return replace(found, belief=belief, unknowns={**found.unknowns, name: (value + clock, sigma)})
