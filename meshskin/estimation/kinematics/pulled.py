"""Unknowns of the robot that the readings move further than what was known before them allows.

    d = s - s0,    pull = max_k |d_k| / sqrt(C_kk)

s0 (K,) and C (K, K) are the unknowns by the heights of the contacts and by what was believed of
them. The readings may move the contacts along the body, as errors of forces and of the skin's
response that are alike over it look like such a motion. Where the pull is larger than chance
explains, no data tell which of the two is right: d is an error of the unknowns, and displaces all
taxels. Its share in their variances rises from 0 at a pull of USUAL to 1 at CONTRADICTED. The last
change of unknowns that do not come to rest displaces them likewise.

Where the model does not fit the readings, nothing is taken from what they tell of the unknowns: the
error is d and that of covariance C. The clock and delays, of which heights tell little, are
excepted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array, means_by_group
from ...recording.recording import Recording
from ...robot.contact_kinematics import JOINT_DELAY
from ...scene.contact_motion import ContactMotion
from ..calibration import Calibration
from ..trilateration.displacements import surface_motion
from ..uncertainty.observability import shape_operators

USUAL = 2.5
"""Pull up to which nothing is widened: sound logs had up to 2.1."""
TIMES = ("clock_offset", JOINT_DELAY)
"""Starts of the labels of unknowns that are times."""
CONTRADICTED = 3.5
"""Standard deviations before a measurement beyond which an unknown contradicts what was known: one
of 20 sound unknowns is with a probability of 1 %."""


def pulls(calibration: Calibration) -> tuple[Array, Array]:
    """Displacements d (K,) of a contact motion's unknowns by the readings, and their standard
    deviations (K,) before these."""
    motion = _motion(calibration)
    found = np.array([calibration.unknowns[label][0] for label in motion.labels])
    return found - motion.mean, np.linalg.norm(motion.root, axis=1)


def contradicted(calibration: Calibration) -> tuple[str, ...]:
    """The unknowns that the readings move too far, in words."""
    return tuple(
        f"the readings move {label} by {d:.3g}, {abs(d) / sigma:.2g} times the standard deviation "
        f"of {sigma:.3g} that the heights of the contacts and the belief leave to it (limit "
        f"{CONTRADICTED:g}): the displacement of the taxels by it is in their standard deviations; "
        "record forces, or more contacts in other postures"
        for label, d, sigma in zip(_motion(calibration).labels, *pulls(calibration), strict=True)
        if abs(d) > CONTRADICTED * sigma
    )


def widened(
    calibration: Calibration, recording: Recording, change: Array | float = 0.0
) -> Calibration:
    """The calibration of a recording with the outer products of d, and of the displacements of the
    taxels by d, added to the variances by their share, which is none up to a pull of USUAL; and
    those of the last `change` (K,) of the unknowns as a whole. With those of C, too, and all of d,
    where the readings do not fit."""
    (d, before), motion = pulls(calibration), _motion(calibration)
    share = np.clip((np.max(np.abs(d) / before) - USUAL) / (CONTRADICTED - USUAL), 0.0, 1.0)
    errors = [np.sqrt(share) * d, change * np.ones(len(d))]
    if calibration.fit is not None and calibration.fit.good is False:
        told = np.array([not label.startswith(TIMES) for label in motion.labels])
        errors += [np.sqrt(1 - share) * told * d, *(told * motion.root.T)]
    for error in errors:
        if error.any():
            calibration = _widened_by(calibration, recording, error)
    return calibration


def _widened_by(calibration: Calibration, recording: Recording, d: Array) -> Calibration:
    """The calibration with the outer products of an error d (K,) of the unknowns, and of the
    displacements of the taxels by it, added to the variances.

    A taxel is displaced as its contacts are in the mean, weighted by its readings.
    """
    motion, row = _motion(calibration), {taxel: k for k, taxel in enumerate(calibration.ids)}
    own = np.array([row.get(taxel, -1) for taxel in recording.reading_taxel])
    use = (own >= 0) & (recording.pressure > 0)
    moved = (motion.slopes @ d)[recording.reading_contact[use]]
    displaced = means_by_group(moved, own[use], len(row), recording.pressure[use])
    displaced[np.isnan(displaced[:, 0])] = moved.mean(axis=0)  # a taxel placed by its module alone
    found = np.isfinite(calibration.positions).all(axis=1)
    rotations = calibration.poses[found, :3, :3]
    assert calibration.belief is not None
    shape = shape_operators(calibration.belief.body, calibration.positions[found], rotations)
    along = np.einsum("nij,ni->nj", rotations[:, :, :2], displaced[found])
    pose = np.einsum("nij,nj->ni", surface_motion(shape), along)
    covariances = calibration.covariances.copy()
    covariances[found] += pose[:, :, None] * pose[:, None, :]
    unknowns = dict(calibration.unknowns)
    for label, pull in zip(motion.labels, d, strict=True):
        value, sigma = unknowns[label]
        unknowns[label] = value, float(np.hypot(sigma, pull))
    return replace(calibration, covariances=covariances, unknowns=unknowns)


def _motion(calibration: Calibration) -> ContactMotion:
    """The contact motion of the calibration's belief."""
    assert calibration.belief is not None
    assert calibration.belief.contact_motion is not None
    return calibration.belief.contact_motion
