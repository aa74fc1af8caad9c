"""Whether the joint angles of a log bring the indenter to the body, before anything is estimated.

Where they do not, usual mistakes are tried, each alone: angles in degrees, a joint of the other
sign, two joints exchanged, the indenter in another unit, a joint's zero far off. The one that
brings the contacts to the body is named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...geometry.body import Body
from ...robot.contact_kinematics import JOINT_DELAY, ContactKinematics, JointPath

SAMPLES = 100
"""Contacts, evenly chosen, that are tried: enough for a median."""
MIN_DISTANCE = 0.02
"""Median distance from the body, m, up to which nothing is refused: `unit_checks.MAX_DISTANCE`."""
SIGMAS = 3.0
"""Median distance from the body, in the standard deviations that the declared unknowns explain, up
to which nothing is refused: a sound log exceeds it with a probability below 0.3 %."""
EXPLAINED = 0.25
"""Distance under a mistake, relative to that without, up to which it is named."""
NEAREST, FARTHEST = 0.01, 10.0
"""Distance of the indenter from the origin of its link, m, below and above which its unit is
tried: to the first links of an arm a place near the origin would fit, too."""
ZEROS = np.radians([sign * step for step in range(4, 31, 2) for sign in (1, -1)])
"""Offsets of a joint's zero that are tried, rad: those below are estimated, and beyond them a robot
does not look like its URDF."""


def check_on_body(
    model: ContactKinematics, path: JointPath, time: Array, body: Body, radius: float, named: bool
) -> None:
    """Refuse a log whose contacts at times (m,), s, are far off the body; named: only where a usual
    mistake explains it. radius: of the indenter, m. Raises CalibrationError."""
    rows = np.flatnonzero(path.covers(time))
    if len(rows) < 2:
        return
    some = time[rows[np.unique(np.linspace(0, len(rows) - 1, SAMPLES).astype(int))]]
    angles, s = path.at(some)[0], np.zeros(len(model.labels))

    def distance(model: ContactKinematics, angles: Array) -> float:
        centres = model.centres(JointPath(some, angles), some, s)[0]
        return float(np.median(np.abs(body.closest(centres).distance - radius)))

    centres, slopes = model.centres(JointPath(some, angles), some, s)
    by_unknown = np.einsum("mi,mik->mk", body.closest(centres).normal, slopes) * model.sigma
    timed = [model.columns[name] for name in (JOINT_DELAY, "clock_offset") if name in model.columns]
    for columns in timed:  # these move contacts by little; with angles in degrees by much
        by_unknown[:, columns] = 0.0
    expected = float(np.sqrt(np.mean(np.sum(by_unknown**2, axis=1))))
    found, limit = distance(model, angles), max(MIN_DISTANCE, SIGMAS * expected)
    if found <= limit:
        return
    tried = [(distance(other, moved), words) for words, other, moved in _mistakes(model, angles)]
    least, words = min(tried)
    explained = least < min(EXPLAINED * found, limit)
    if named and not explained:
        return
    remedy = "check the body's link and mount, the indenter's place, units and clocks"
    if explained:
        remedy = f"{words} may be the cause: it would bring them to {1e3 * least:.3g} mm"
    raise CalibrationError(
        "the contacts that follow from the joint angles are not on the body",
        value=f"{1e3 * found:.3g} mm off it in the median",
        limit=f"{1e3 * limit:.3g} mm",
        remedy=remedy,
    )


def _mistakes(
    model: ContactKinematics, angles: Array
) -> Iterator[tuple[str, ContactKinematics, Array]]:
    """Usual mistakes in words, with the robot and the angles (m, k), rad, without each."""
    names = model.chain.joint_names
    slides = {joint.column for joint in model.chain.joints if joint.slides}
    turning = np.array([k not in slides for k in range(len(names))])
    degrees = np.where(turning, np.radians(angles), angles)
    yield 'joint angles in degrees (unit = "deg" in the map)', model, degrees
    yield (
        'joint angles in rad (unit = "rad" in the map)',
        model,
        np.where(turning, np.degrees(angles), angles),
    )
    far = float(np.linalg.norm(model.indenter))
    scales = ((1e-3, "mm taken for m", far > FARTHEST), (1e3, "m taken for mm", far < NEAREST))
    for factor, words in (scale[:2] for scale in scales if scale[2]):
        moved = replace(model, indenter=factor * model.indenter)
        yield f"an indenter's place in {words}", moved, angles
    for k, name in enumerate(names):
        sign = np.where(np.arange(len(names)) == k, -1.0, 1.0)
        yield f"the other sign of the joint {name}", model, sign * angles
    for i, k in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, k]] = k, i
        yield f"{names[i]} and {names[k]} exchanged", model, angles[:, order]
    for k, name in enumerate(names):
        for zero in () if k in slides else ZEROS:
            moved = angles + zero * (np.arange(len(names)) == k)
            yield f"{np.degrees(zero):.0f} degrees added to the joint {name}", model, moved
