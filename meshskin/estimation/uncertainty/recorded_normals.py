"""Recorded normals against those of the believed surface: wrong frames and mirrored axes."""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ...recording.recording import JOINT_ANGLES, Recording
from ..data.measurements import Measurements
from ..data.patch_shape import unevenness
from ..data.unit_checks import angles
from . import verdict
from .verdict import PASS, Finding, level_of

NORMAL_ANGLES = 20.0, 45.0
"""Median angle between recorded normals and those of the believed surface, degrees: a doubt, a
failure. With friction of 0.3 a force leans by 17 degrees."""
NORMAL_TURNS = -0.5, 0.0
"""Turn of the recorded normals over that of the surface, along the direction where it is least,
with the opposite sign, from which it is a doubt, and a failure: 1 in a sound log, -1 along a
mirrored axis, the cosine of the angle in a frame that is rotated about the normal."""
STRAYS = 0.05
"""Part of the contacts, those with normals farthest from the regression, that is left out of it: on
a patch where normals turn by 0.1 rad, 9 of 3,184 contacts over an edge, 80 degrees off, halved the
ratio."""
BESIDE_EDGE = 0.5e-3
"""Distance, m, from an edge of the body within which the normal of the surface does not count: an
error of the place, or of the body, of this order takes it from one face to the other."""
MIN_TURN = 0.03
"""Spread of the surface's normals along a direction, rad, from which turns along it count."""


def findings(recording: Recording, data: Measurements) -> list[Finding]:
    """Recorded normals against those of the believed surface: their angle, and how both turn from
    contact to contact, which on a small patch shows a mirrored axis better."""
    rows = np.flatnonzero((recording.force > 0) & np.isfinite(recording.normals).all(axis=1))
    computed = recording.metadata.get("source") == JOINT_ANGLES  # the normals are the surface's
    if computed or len(rows) < verdict.MIN_CONTACTS:
        return []
    hit = data.body.closest(recording.points[rows])
    apart = unevenness(data.belief, hit, BESIDE_EDGE) == 0
    if apart.sum() < verdict.MIN_CONTACTS:
        return []
    hit, normals = hit.take(apart), recording.normals[rows[apart]]
    typical = float(np.degrees(np.median(angles(hit, normals))))
    turn, axis = least_turn(hit.normal, normals)
    if (level := level_of(-turn, NORMAL_TURNS)) != PASS:
        words = (
            f"recorded normals turn {turn:.2g} times as much from contact to contact as those of "
            f"the believed surface, along ({', '.join(f'{x:.2g}' for x in axis)}) (limit "
            f"{-NORMAL_TURNS[0]:g}): check the signs and the order of the axes of contacts and body"
        )
    elif (level := level_of(typical, NORMAL_ANGLES)) != PASS:
        words = (
            f"recorded normals are {typical:.2g} degrees from those of the believed surface in the "
            f"median (limit {NORMAL_ANGLES[0]:g}): check the frame of the body and of the contacts"
        )
    return [] if level == PASS else [(level, words)]


def least_turn(surface: Array, normals: Array) -> tuple[float, Array]:
    """The least eigenvalue of the regression of recorded normals (m, 3) on those of the surface,
    without STRAYS, and its direction (3,); 1 where the normals of the surface hardly turn."""
    centred = surface - surface.mean(axis=0)
    value, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
    basis = vectors[:, value > MIN_TURN**2]
    if not basis.size:
        return 1.0, np.zeros(3)
    across, found = centred @ basis, (normals - normals.mean(axis=0)) @ basis
    slope = np.linalg.lstsq(across, found, rcond=None)[0]
    off = np.linalg.norm(found - across @ slope, axis=1)
    used = off <= np.quantile(off, 1 - STRAYS)
    slope = np.linalg.lstsq(across[used], found[used], rcond=None)[0]
    least, directions = np.linalg.eigh((slope + slope.T) / 2)
    return float(least[0]), basis @ directions[:, 0]
